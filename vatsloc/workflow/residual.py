"""Residual registration: the modelled lung registered to the observed one, where both scans show it.

The model brings vessels near enough to be matched; without it the same registration diverges on a collapsed lung. A
node is moved where two registrations, forward and backward, agree on its position; all others follow elastically.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from poro.fem import Tissue, extrapolate
from poro.mesh import TetMesh
from registration.correspondences import Correspondences
from registration.ffd import FfdSettings, Weights, register_ffd
from registration.images.morphology import dilate, erode
from registration.kernels.threads import ahead
from registration.maps.inversion import invert_at
from registration.volume import Array, Mask
from vatsloc.imaging.surface import Border, SurfacePoints
from vatsloc.maps import MeshMap
from vatsloc.workflow.prepare import Prepared
from vatsloc.workflow.settings import ResidualSettings
from vatsloc.workflow.warped_pair import warped_pair

BORDER_MM = 2.0
NEAR_REGION_MM = 4.0
LEAST_NODES = 30
REACH_MM = 15.0


@dataclass(frozen=True)
class Residual:
    """Correction of the modelled lung.

    displacement: (n, 3) mm at the lung's nodes; compared: (n,) nodes where both images show lung; seen: (n,) those of
    them whose correction is believed, all others follow elastically; disagreement_mm: (n,) between where the
    registrations there and back put a node; min_det: least det of both maps' gradients.
    """

    displacement: Array
    compared: Array
    seen: Array
    disagreement_mm: Array
    min_det: float

    @property
    def agreed_share(self) -> float:
        """Share of the compared nodes on whose position both registrations agree."""
        return float(self.seen.sum() / max(self.compared.sum(), 1))

    @property
    def model_error_mm(self) -> float:
        """Root mean square, per axis, of what the model was corrected by: how far off it is where nothing is seen."""
        return float(np.sqrt(np.mean(self.displacement[self.seen] ** 2)))


def residual_registration(
    prepared: Prepared,
    lung_def: Mask,
    def_from_inf: MeshMap,
    mesh_before: TetMesh,
    surface: SurfacePoints,
    settings: ResidualSettings,
    keypoints: Correspondences,
) -> Residual | None:
    """Displacements that take the modelled nodes to where the images show their tissue; None where too little is seen.

    lung_def: the collapsed lung as it was segmented; def_from_inf: the model's map; mesh_before: its undeformed mesh in
    the deflated CBCT's frame; surface: observed points, which move the border where the images inside do not;
    keypoints: correspondences in the frames of the inflated and the deflated CBCT, a term of both registrations.
    """
    nodes = def_from_inf.moved
    modelled = TetMesh(nodes, def_from_inf.mesh.tets)
    scans = warped_pair(prepared, lung_def, def_from_inf, settings.voxel_mm)
    observed, expected = _inner(scans.lung), _inner(scans.modelled)
    if not (observed.inside.any() and expected.inside.any()):
        return None
    ffd = FfdSettings(
        spacing_mm=settings.grid_mm,
        levels=settings.levels,
        voxel_mm=settings.voxel_mm,
        weights=Weights(bending=settings.bending, keypoints=settings.keypoints),
    )
    expected_at = keypoints.mapped(moving=def_from_inf)
    forth, homeward = (expected_at, expected_at.swapped()) if len(keypoints) else (None, None)
    register = partial(register_ffd, settings=ffd, moving_mask=scans.both_see)
    returning = ahead(partial(register, scans.warped, scans.deflated, fixed_mask=expected, matches=homeward))
    there = register(scans.deflated, scans.warped, fixed_mask=observed, matches=forth)
    back = returning()
    inverse = invert_at(there.moving_from_fixed, nodes, nodes)
    placed, other = inverse.points_fixed, back.moving_from_fixed(nodes)
    disagreement = np.linalg.norm(placed - other, axis=1)
    compared = _near(observed, placed) & _near(expected, nodes)
    seen = compared & (inverse.residual_mm < 0.5) & (disagreement < settings.max_disagreement_mm)
    if seen.sum() < LEAST_NODES:
        return None
    wanted = (placed + other) / 2 - nodes
    chosen = np.flatnonzero(seen)
    field = extrapolate(mesh_before, chosen, wanted[chosen], Tissue()).u
    border, offset = _border_offsets(TetMesh(nodes + field, modelled.tets), surface, ~seen)
    if len(border):
        imposed = np.concatenate([chosen, border])
        motion = np.concatenate([wanted[chosen], field[border] + offset])
        field = extrapolate(mesh_before, imposed, motion, Tissue()).u
    return Residual(field, compared, seen, disagreement, min(there.min_det, back.min_det))


def _border_offsets(lung: TetMesh, surface: SurfacePoints, free: Array) -> tuple[Array, Array]:
    """Free border nodes (k,) that face observed pleural air, and the moves (k, 3) mm that put them there.

    Moves go along the nodes' normals.

    An observed point counts for the node nearest to it, within REACH_MM, where both normals agree; a node takes their
    mean.
    """
    border, air = lung.boundary, surface.only(Border.AIR)
    if len(air) == 0:
        return np.zeros(0, dtype=int), np.zeros((0, 3))
    far, nearest = cKDTree(border.points).query(air.points)
    normals = border.node_normals[nearest]
    agree = (np.einsum("nd,nd->n", normals, air.normals) > 0.5) & (far < REACH_MM)
    along = np.einsum("nd,nd->n", air.points - border.points[nearest], normals)[agree]
    count = np.bincount(nearest[agree], minlength=len(border.nodes))
    mean = np.bincount(nearest[agree], along, len(border.nodes)) / np.maximum(count, 1)
    chosen = np.flatnonzero((count > 0) & free[border.nodes])
    return border.nodes[chosen], mean[chosen, None] * border.node_normals[chosen]


def _inner(lung: Mask) -> Mask:
    """Where lungs are compared: a little inside their border, which air and wall blur."""
    return Mask(erode(lung.inside, BORDER_MM, lung.grid.spacing), lung.ras_from_ijk)


def _near(region: Mask, points_ras: Array) -> Array:
    """Which points (n, 3) lie in the region or just beside it."""
    wide = dilate(region.inside, NEAR_REGION_MM, region.grid.spacing)
    ijk = region.grid.to_ijk(points_ras).T
    return np.asarray(ndimage.map_coordinates(wide.astype(np.uint8), ijk, order=0, mode="constant") > 0)
