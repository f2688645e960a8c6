"""Uncertainty of where tissue lies after the collapse, at the nodule and everywhere else in the lung."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from poro.fit import ellipsoid95, point_covariance
from poro.fit.covariance import CHI2_95_3D
from poro.mesh import interpolate, locate
from registration.correspondences import Correspondences
from registration.maps.rigid import RigidTransform
from registration.verification import LeftOver
from registration.volume import Array
from vatsloc.maps import MeshMap
from vatsloc.workflow.pneumothorax import Collapse
from vatsloc.workflow.pose import ChangeOfPose

REGISTRATION_MM = 0.5
"""Standard deviation per axis of one registration where it holds: a quarter of its finest voxel."""
LEAST_MM = 0.25
"""The same where small blocks were followed."""
MODEL_ALONE_MM = 4.0
"""The same of the model without images inside the lung: 1.7 to 6.9 mm on twins and phantoms."""
NEAREST, PER_MISFIT, REACH_MM, PER_MM = 6, 1.5, 8.0, 0.15
"""The same near matched keypoints: PER_MISFIT for every millimetre by which the result misses the six nearest ones on
average, and PER_MM for every millimetre beyond REACH_MM from the nearest one. Quantile regression (95 %) of the
chain's errors at 16,000 tissue points of the three twins and of five phantoms outside the suite (adhesion 205,
near-total-collapse 206, part-solid 207, base 208, poor-dose 209)."""
NEAREST_BLOCKS, PER_BLOCK_MISFIT, BLOCK_REACH_MM, PER_BLOCK_MM = 12, 0.7, 4.0, 0.3
"""The same where the lung followed small blocks and was smoothed: PER_BLOCK_MISFIT for every millimetre by which it
misses the twelve nearest ones on average, PER_BLOCK_MM for every millimetre beyond BLOCK_REACH_MM from their middle,
which is far where all lie to one side."""
KEYPOINT_MM, PER_CONTRADICTION = 1.5, 2.5
"""What is added to that, as independent errors are, where such a lung misses the keypoints about it: PER_CONTRADICTION
for every millimetre beyond KEYPOINT_MM, which they are off by themselves. One of both is wrong there. The constants
make the smallest radius that holds 93 % of the tissue in every class of depth of each of ten phantoms outside the
suite, with a margin (docs/method.md)."""
SHEET_MM, SHEET_FACTOR = 8.0, 1.4
"""How far from a cut tissue may belong to the other piece, since a bowed sheet is not where the fissure is everywhere,
and by how much the ellipsoid reaches beyond where that went: it holds 96 % of the tissue beside the cuts of base 505
and near-total-collapse 506."""
WITHOUT_INFLATED = 1.1
"""Factor on the standard deviation where no inflated scan was taken: what holds 95 % of the tissue within 10 mm of the
pleura of a phantom outside the suite (right 300; 93 % without it)."""
CHECK_REACH_MM = 30.0
"""An error that the run's check of itself found counts for tissue within this distance."""


def covariance(
    pose: ChangeOfPose, collapse: Collapse, inflated: Array, deflated: Array, left: LeftOver | None = None
) -> Array:
    """Covariance (n, 3, 3) mm2 of where points (n, 3) of the inflated CBCT lie in the deflated one, given with where
    the run puts them (n, 3).

    Where the images placed the tissue around a point, it holds the registrations' errors and their disagreement; where
    they did not, the fit's covariance and the scatter of the ensemble. Either way its standard deviation is at least
    that of the nearest keypoints: from their distance, and from how well the result follows them. Where the lung
    followed small blocks, these say it, and keypoints that it misses all the same; beside a cut, so does where the
    other piece went. left: the error of the chain that the run's check of itself found; where it lies outside the
    ellipsoid, the covariance is widened.
    """
    own = _covariance(pose, collapse, inflated, deflated)
    if pose.rigid is None:
        own = own * WITHOUT_INFLATED**2
    return own if left is None else widened(own, left.near(deflated, CHECK_REACH_MM))


def widened(covariance: Array, vectors: Array) -> Array:
    """Covariances (n, 3, 3) mm2 with the outer product of vectors (n, 3) mm added where their ellipsoids (95 %) do not
    hold these; a vector that is not known (NaN) widens nothing.
    """
    known: Array = np.asarray(np.isfinite(vectors).all(axis=1))
    v = np.where(known[:, None], vectors, 0.0)
    against = np.linalg.solve(covariance, v[..., None])[..., 0]
    beyond: Array = np.asarray((v * against).sum(axis=1) > CHI2_95_3D)
    return np.asarray(covariance + np.where(beyond[:, None, None], v[:, :, None] * v[:, None, :], 0.0))


def _covariance(pose: ChangeOfPose, collapse: Collapse, inflated: Array, deflated: Array) -> Array:
    blocks = None if collapse.refinement is None else collapse.refinement.followed
    if blocks is None:
        return _of_fit(pose, collapse, inflated, deflated)
    variance = block_sigma_mm(*nearest_blocks(pose, collapse, blocks, inflated, deflated)) ** 2
    if collapse.model.refinements:
        missed = nearest_correspondences(collapse, deflated)[1]
        variance = variance + (PER_CONTRADICTION * np.maximum(missed - KEYPOINT_MM, 0.0)) ** 2
    return np.asarray(variance[:, None, None] * np.eye(3) + _beside_cut(pose, collapse, inflated))


def _beside_cut(pose: ChangeOfPose, collapse: Collapse, inflated: Array) -> Array:
    """What is added (n, 3, 3) mm2 beside a cut, so that the ellipsoid holds where the other piece went."""
    added: Array = np.zeros((len(inflated), 3, 3))
    if collapse.parted is None:
        return added
    pieces, sheet = collapse.parted.pieces, collapse.parted.fissure.sheet
    of_node = pieces.node_piece()
    around = collapse.def_from_inf_rigid @ pose.inf_from_ct_rigid
    motion = collapse.points_after - around(pose.mesh_ct.points)
    points = interpolate(locate(pose.mesh_inf, inflated), pose.mesh_ct.points)
    beside = np.flatnonzero(np.abs(sheet.distance(points)) < SHEET_MM)
    moved = []
    for number in (0, 1):
        mine = np.flatnonzero(of_node == number)
        moved.append(motion[mine[cKDTree(pose.mesh_ct.points[mine]).query(points[beside])[1]]])
    apart = SHEET_FACTOR * (moved[1] - moved[0])
    added[beside] = apart[:, :, None] * apart[:, None, :] / CHI2_95_3D
    return added


def _of_fit(pose: ChangeOfPose, collapse: Collapse, inflated: Array, deflated: Array) -> Array:
    points = collapse.def_from_inf_rigid(inflated)
    residual = collapse.residual
    least_mm, model_mm = np.zeros(len(points)), np.full(len(points), MODEL_ALONE_MM)
    if collapse.model.refinements:
        least_mm = model_mm = correspondence_sigma_mm(*nearest_correspondences(collapse, deflated))
    modelled = point_covariance(collapse.fit, collapse.system, points, model_mm) + scatter(collapse, points)
    if residual is None:
        return modelled
    at = locate(pose.mesh_inf, inflated)
    trust = interpolate(at, residual.seen.astype(float))
    disagreement = interpolate(at, np.where(residual.seen, residual.disagreement_mm, 0.0))
    known = np.maximum(2 * REGISTRATION_MM**2 + (disagreement / 2) ** 2, least_mm**2)
    return np.asarray((trust * known)[:, None, None] * np.eye(3) + (1 - trust)[:, None, None] * modelled)


def radius95(pose: ChangeOfPose, collapse: Collapse, left: LeftOver | None = None) -> Array:
    """Longest semi-axis (n,) mm of the ellipsoid that holds the tissue of each of the lung's nodes with 95 %."""
    return ellipsoid95(covariance(pose, collapse, pose.points_inf, collapse.mesh_after.points, left))[0][:, 0]


def scatter(collapse: Collapse, points: Array) -> Array:
    """Second moment (n, 3, 3) mm2 of the ensemble about the result, at points (n, 3) before the collapse."""
    ensemble = collapse.model.ensemble
    if not len(ensemble):
        return np.zeros((len(points), 3, 3))
    at = locate(collapse.system.mesh, points)
    off = np.array([interpolate(at, difference) for difference in ensemble])
    return np.asarray(np.einsum("oni,onj->nij", off, off) / len(off))


def nearest_correspondences(collapse: Collapse, deflated: Array) -> tuple[Array, Array]:
    """Distance (n,) mm from points (n, 3) of the deflated CBCT to the nearest keypoint, and by how many mm (n,) the
    result misses the nearest few of them on average.
    """
    found, before, after = collapse.model.correspondences, collapse.mesh_before, collapse.mesh_after.points
    distance, number, missed = _nearest(MeshMap(before, after, RigidTransform.identity()), found, deflated, NEAREST)
    return distance[:, 0], missed[number].mean(axis=1)


def nearest_blocks(
    pose: ChangeOfPose, collapse: Collapse, blocks: Correspondences, inflated: Array, deflated: Array
) -> tuple[Array, Array]:
    """Distance (n,) mm from points (n, 3) of the deflated CBCT, given with where they lie in the inflated one, to the
    middle of the nearest blocks, from the CT (`moving`) to there (`fixed`), and by how many mm (n,) the result misses
    these on average.

    Where a lung came apart along a sheet, but too little is known of a piece to cut it, a block tells nothing of tissue
    on the other side of the sheet.
    """
    around = collapse.def_from_inf_rigid @ pose.inf_from_ct_rigid
    moved = MeshMap(pose.mesh_ct, collapse.points_after, around)
    distance, misfit = np.zeros(len(deflated)), np.zeros(len(deflated))
    for mine, own in _by_side(pose, collapse, blocks, inflated):
        _, number, missed = _nearest(moved, own, deflated[mine], NEAREST_BLOCKS)
        distance[mine] = np.linalg.norm(deflated[mine] - own.fixed[number].mean(axis=1), axis=1)
        misfit[mine] = missed[number].mean(axis=1)
    return distance, misfit


def _by_side(
    pose: ChangeOfPose, collapse: Collapse, blocks: Correspondences, inflated: Array
) -> list[tuple[Array, Correspondences]]:
    """Which points (n,) of the inflated CBCT are told by which blocks."""
    fissure = collapse.fissure
    if fissure is None or not fissure.is_bare or collapse.parted is not None:
        return [(np.ones(len(inflated), dtype=bool), blocks)]
    points = interpolate(locate(pose.mesh_inf, inflated), pose.mesh_ct.points)
    above, of_block = fissure.sheet.distance(points) > 0, fissure.sheet.distance(blocks.moving) > 0
    if of_block.all() or not of_block.any():
        return [(np.ones(len(inflated), dtype=bool), blocks)]
    return [(above, blocks.only(of_block)), (~above, blocks.only(~of_block))]


def _nearest(moved: MeshMap, found: Correspondences, points: Array, count: int) -> tuple[Array, Array, Array]:
    """Distances and numbers (n, count) of the places `fixed` nearest to points (n, 3), and by how many mm (k,) a map of
    `moving` misses each place.
    """
    distance, number = cKDTree(found.fixed).query(points, range(1, min(count, len(found)) + 1))
    return distance, number, np.linalg.norm(moved(found.moving) - found.fixed, axis=1)


def block_sigma_mm(distance_mm: Array, misfit_mm: Array) -> Array:
    """Standard deviation (n,) mm per axis of tissue at a distance (n,) from the middle of the nearest blocks that the
    lung followed, where it misses these by a misfit (n,).
    """
    told = PER_BLOCK_MISFIT * misfit_mm + PER_BLOCK_MM * np.maximum(distance_mm - BLOCK_REACH_MM, 0.0)
    return np.maximum(told, LEAST_MM)


def correspondence_sigma_mm(distance_mm: Array, misfit_mm: Array) -> Array:
    """Standard deviation (n,) mm per axis of tissue at a distance (n,) from the nearest keypoint, where the result
    misses the nearest keypoints by a misfit (n,). At least that of the registration that matches keypoints.
    """
    told = PER_MISFIT * misfit_mm + PER_MM * np.maximum(distance_mm - REACH_MM, 0.0)
    return np.maximum(told, REGISTRATION_MM)
