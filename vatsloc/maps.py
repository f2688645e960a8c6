"""Maps between the images of a case that a mesh in several shapes carries."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from poro.mesh import TetMesh, interpolate, locate, rasterize
from registration.keypoints.aligned_matching import Linearized
from registration.maps.field import DisplacementField, sample_map
from registration.maps.rigid import RigidTransform
from registration.volume import Array, Grid, Mask


@dataclass(frozen=True)
class MeshMap:
    """Where nodes that move from `mesh` to `moved` (n, 3) mm carry a point, linear in each tetrahedron.

    around: rigid motion of everything that the mesh does not hold; a point outside moves with it, and besides as far
    relative to it as the nearest point of the mesh's surface does.
    """

    mesh: TetMesh
    moved: Array
    around: RigidTransform

    def __call__(self, points_ras: Array) -> Array:
        """Moved points (q, 3) mm."""
        points = np.asarray(points_ras, dtype=float)
        return self.around(points) + interpolate(locate(self.mesh, points), self.relative)

    def linearized(self, points_ras: Array) -> Linearized:
        """Moved points and the map's gradient at points (q, 3) mm; outside the mesh the rigid motion's gradient."""
        points = np.asarray(points_ras, dtype=float)
        at = locate(self.mesh, points)
        gradients = np.broadcast_to(self.around.matrix[:3, :3], (len(points), 3, 3)).copy()
        inside, corners = at.inside, at.nodes[at.inside]
        before, after = (x[corners[:, 1:]] - x[corners[:, :1]] for x in (self.mesh.points, self.moved))
        gradients[inside] = np.linalg.solve(before, after).transpose(0, 2, 1)
        return Linearized(self.around(points) + interpolate(at, self.relative), gradients)

    @property
    def relative(self) -> Array:
        """Displacement of the nodes beyond the rigid motion, (n, 3) mm."""
        return self.moved - self.around(self.mesh.points)

    def inverse(self) -> MeshMap:
        """The map back, exact inside the mesh."""
        return MeshMap(TetMesh(self.moved, self.mesh.tets), self.mesh.points, self.around.inverse())


def sampled(mapping: MeshMap, grid: Grid, beyond_mm: float = np.inf) -> DisplacementField:
    """A mesh's map on voxels, (ni, nj, nk, 3) float32.

    Outside the mesh a voxel moves relative to the rigid motion as the nearest voxel inside does, up to `beyond_mm` from
    that, and farther off not at all; either is far cheaper than the nearest point of the surface.
    """
    rigid = sample_map(mapping.around, grid).vectors
    box, cut = box_of(mapping.mesh, grid)
    relative = np.zeros((*grid.shape, 3), dtype=np.float32)
    relative[cut], inside = rasterize(mapping.mesh, mapping.relative, box.ijk_from_ras, box.shape)
    if beyond_mm > 0 and inside.any():
        outside = np.ones(grid.shape, dtype=bool)
        outside[cut] = ~inside
        far, nearest = ndimage.distance_transform_edt(outside, sampling=grid.spacing, return_indices=True)
        relative = relative[tuple(nearest)]
        relative[far > beyond_mm] = 0
    return DisplacementField(rigid + relative, grid.ras_from_ijk)


def covered(mesh: TetMesh, grid: Grid) -> Mask:
    """Voxels whose centres lie in a mesh."""
    box, cut = box_of(mesh, grid)
    inside = np.zeros(grid.shape, dtype=bool)
    inside[cut] = rasterize(mesh, np.zeros((len(mesh.points), 0)), box.ijk_from_ras, box.shape)[1]
    return Mask(inside, grid.ras_from_ijk)


def box_of(mesh: TetMesh, grid: Grid) -> tuple[Grid, tuple[slice, slice, slice]]:
    """The part of a grid that a mesh can reach, and where it lies in the grid."""
    ijk = grid.to_ijk(mesh.points)
    lower, upper = ijk.min(axis=0) - 1, ijk.max(axis=0) + 2
    return grid.box(lower, upper), grid.cut(lower, upper)
