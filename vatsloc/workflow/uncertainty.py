"""How sure a run is of where tissue went, at the nodule and everywhere else in the lung."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from poro.fit import ellipsoid95, point_covariance
from poro.fit.covariance import CHI2_95_3D
from poro.mesh import interpolate, locate
from registration.verification import LeftOver
from registration.volume import Array
from vatsloc.workflow.pneumothorax import Collapse
from vatsloc.workflow.pose import ChangeOfPose

REGISTRATION_MM = 0.5
"""Standard deviation per axis of one registration where it holds: a quarter of its finest voxel."""
MODEL_ALONE_MM = 4.0
"""The same of the model without images inside the lung: 1.7 to 6.9 mm on twins and phantoms."""
PLACES, PER_MISFIT, REACH_MM, PER_MM = 6, 1.5, 8.0, 0.15
"""The same near places that were found again: so much per millimetre by which the answer misses the nearest six of them
on average, and per millimetre of distance to the nearest one beyond its reach. Quantile regression (95 %) of the
chain's errors at 16,000 tissue points of the three twins and of five phantoms outside the suite (adhesion 205,
near-total-collapse 206, part-solid 207, base 208, poor-dose 209)."""


CHECK_REACH_MM = 30.0
"""What the run's check of itself found left over counts for tissue within this distance."""


def covariance(
    pose: ChangeOfPose, collapse: Collapse, inflated: Array, deflated: Array, left: LeftOver | None = None
) -> Array:
    """Covariance (n, 3, 3) mm2 of where points (n, 3) of the inflated CBCT lie in the deflated one, given with where
    the run puts them (n, 3).

    Where the images placed the tissue around a point, their registrations' errors and disagreement count; where they
    did not, the fit's covariance and the scatter of other answers. Either way it is no surer than the places
    found again about it allow: how far they are, and how well the answer follows them. left: what the run's check of
    itself found left over of the chain; where that is more than the rest allows, the covariance holds it too.
    """
    own = _covariance(pose, collapse, inflated, deflated)
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
    """Second moment (n, 3, 3) mm2 of other answers about the one given, at points (n, 3) before the collapse."""
    others = collapse.model.others
    if not len(others):
        return np.zeros((len(points), 3, 3))
    at = locate(collapse.system.mesh, points)
    off = np.array([interpolate(at, other) for other in others])
    return np.asarray(np.einsum("oni,onj->nij", off, off) / len(off))


def nearest_correspondences(collapse: Collapse, deflated: Array) -> tuple[Array, Array]:
    """Distance (n,) mm from points (n, 3) of the deflated CBCT to the nearest place found again, and by how many mm
    (n,) the answer misses the nearest few of them on average.
    """
    pairs, before = collapse.model.pairs, collapse.mesh_before
    moved = interpolate(locate(before, pairs.moving), collapse.mesh_after.points - before.points)
    missed = np.linalg.norm(pairs.moving + moved - pairs.fixed, axis=1)
    distance, number = cKDTree(pairs.fixed).query(deflated, min(PLACES, len(pairs)))
    return distance[:, 0], missed[number].mean(axis=1)


def correspondence_sigma_mm(distance_mm: Array, misfit_mm: Array) -> Array:
    """Standard deviation (n,) per axis of tissue so far (n,) from a place found again, of an answer that misses the
    places about it by so much (n,).
    """
    return PER_MISFIT * misfit_mm + PER_MM * np.maximum(distance_mm - REACH_MM, 0.0)
