"""Maps between the images of a case that a mesh in several shapes carries."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from poro.mesh import TetMesh, interpolate, locate
from registration.rigid import RigidTransform
from registration.volume import Array

PointMap = Callable[[Array], Array]


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

    @property
    def relative(self) -> Array:
        """Displacement of the nodes beyond the rigid motion, (n, 3) mm."""
        return self.moved - self.around(self.mesh.points)

    def inverse(self) -> MeshMap:
        """The map back, exact inside the mesh."""
        return MeshMap(TetMesh(self.moved, self.mesh.tets), self.mesh.points, self.around.inverse())


@dataclass(frozen=True)
class BlendedMap:
    """x -> far(x) + w(x) (near(x) - far(x)): a map known well where w is 1, and its continuation elsewhere.

    weight: points (n, 3) -> (n,) in [0, 1]; near is asked only where the weight is positive.
    """

    near: PointMap
    far: PointMap
    weight: Callable[[Array], Array]

    def __call__(self, points_ras: Array) -> Array:
        """Mapped points (n, 3) mm."""
        out = self.far(points_ras)
        w = self.weight(points_ras)
        here = w > 0
        if here.any():
            out[here] += w[here, None] * (self.near(points_ras[here]) - out[here])
        return out
