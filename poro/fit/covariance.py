"""How well a fit knows its parameters, and where points go."""

from __future__ import annotations

import numpy as np

from poro.arrays import Array
from poro.collapse.model import PoroSystem
from poro.fit.collapse_fit import Fit
from poro.mesh.locate import interpolate, locate

CHI2_95_3D = 7.814728  # 95 % quantile of chi-squared with three degrees of freedom


def point_covariance(
    result: Fit, system: PoroSystem, points: Array, unexplained_mm: float | Array | None = None
) -> Array:
    """Covariance (k, 3, 3) mm2 of where points (k, 3) lie after the collapse.

    The parameters' covariance carried to the points, plus the standard deviation per axis, one or (k,), of what no
    parameter explains: by default what the fit leaves at the points it sees; after a correction give its held-out
    misfit.
    """
    du = interpolate(locate(system.mesh, np.atleast_2d(points)), result.sensitivity)
    left = max(result.surface_rms_mm, result.keypoint_rms_mm / np.sqrt(3))
    unexplained = np.atleast_1d(left if unexplained_mm is None else unexplained_mm)
    carried = np.einsum("kip,pq,kjq->kij", du, result.covariance, du, optimize=True)
    return np.asarray(carried + unexplained[:, None, None] ** 2 * np.eye(3))


def ellipsoid95(covariance: Array) -> tuple[Array, Array]:
    """Semi-axes (k, 3) mm, longest first, and their directions (k, 3, 3) in rows, of the ellipsoids that hold points of
    covariance (k, 3, 3) mm2 with 95 %.
    """
    values, vectors = np.linalg.eigh(covariance)
    return np.sqrt(CHI2_95_3D * values[:, ::-1]), vectors[:, :, ::-1].swapaxes(1, 2)
