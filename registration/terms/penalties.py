"""Penalties of a free-form deformation: bending, distance of corresponding points, folding.

Ref: Rueckert 1999 (bending); Modat 2012 (penalty on the Jacobian determinant); the barrier's shape is our own.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from registration.correspondences import Correspondences
from registration.maps.bspline import basis_rows
from registration.maps.field import PointMap
from registration.maps.jacobian import Jacobian, cofactor, determinant
from registration.terms.bending import BendingEnergy
from registration.terms.objective import QuadraticModel
from registration.volume import Array, Grid

KNEE = 0.3
FLOOR = 0.02
"""Determinants at which the barrier begins, and below which it goes on as a straight line."""


class Bending:
    """weight times the bending energy of u; weight in mm^2."""

    def __init__(self, control: Grid, weight: float) -> None:
        self._energy, self._weight = BendingEnergy(control), weight
        self._diagonal = np.broadcast_to(2 * weight * self._energy.diagonal(), (3, *control.shape))

    def value(self, c: Array) -> float:
        """weight c^T R c."""
        return self._weight * float(np.vdot(c, self._energy.apply(c.astype(float))))

    def model(self, c: Array) -> QuadraticModel:
        """Exact: the term is quadratic."""
        rc = self._energy.apply(c.astype(float))
        scale = 2 * self._weight
        return QuadraticModel(
            self._weight * float(np.vdot(c, rc)),
            scale * rc,
            lambda d: d.dtype.type(scale) * self._energy.apply(d),
            self._diagonal,
        )


class CorrespondingPoints:
    """weight (1/mm^2) times the weighted mean of s^2 log(1 + |r|^2 / s^2), r = P(x) + u(x) - y at correspondences.

    scale_mm: s, beyond which residuals count less.
    """

    def __init__(
        self, control: Grid, matches: Correspondences, prior: PointMap, weight: float, scale_mm: float
    ) -> None:
        self._basis = basis_rows(control, matches.fixed)
        self._transposed = sparse.csr_array(self._basis.T)
        self._squared = self._transposed.multiply(self._transposed).tocsr()
        self._gap = prior(matches.fixed) - matches.moving
        self._w = weight * matches.weights / max(float(matches.weights.sum()), 1e-12)
        self._s2 = scale_mm**2

    def value(self, c: Array) -> float:
        """The robust mean."""
        return float(np.sum(self._w * self._s2 * np.log1p(self._residual(c)[1])))

    def model(self, c: Array) -> QuadraticModel:
        """Gauss-Newton with the residuals' weights held fixed, as in iterated reweighted least squares."""
        r, q = self._residual(c)
        k = 2 * self._w / (1 + q)
        gradient = (self._transposed @ (k[:, None] * r)).T.reshape(c.shape)
        diagonal = np.broadcast_to((self._squared @ k).reshape(c.shape[1:]), c.shape)
        value = float(np.sum(self._w * self._s2 * np.log1p(q)))

        def apply(d: Array) -> Array:
            along = k[:, None] * (self._basis @ d.reshape(3, -1).T)
            return (self._transposed @ along).T.reshape(d.shape).astype(d.dtype)

        return QuadraticModel(value, gradient, apply, diagonal)

    def _residual(self, c: Array) -> tuple[Array, Array]:
        r = self._gap + self._basis @ c.reshape(3, -1).T.astype(float)
        return r, np.sum(r * r, axis=1) / self._s2


class Folding:
    """weight times the mean over blocks of a barrier on det(dT/dx); see `barrier`."""

    def __init__(self, control: Grid, blocks: Grid, prior: PointMap, weight: float) -> None:
        self._jacobian = Jacobian(control, blocks, prior)
        self._weight = weight / float(np.prod(blocks.shape))

    def value(self, c: Array) -> float:
        """The barrier's mean."""
        return self._weight * float(barrier(determinant(self._jacobian.gradient(c)))[0].sum())

    def model(self, c: Array) -> QuadraticModel:
        """Gauss-Newton on det, which drops its own second derivative; nothing where no block nears folding."""
        f = self._jacobian.gradient(c)
        value, slope, curvature = barrier(determinant(f))
        if not value.any():
            return QuadraticModel(0.0, np.zeros(c.shape), np.zeros_like, np.zeros(c.shape))
        adjugate = cofactor(f)
        gradient = self._weight * self._jacobian.adjoint(slope * adjugate)

        def apply(d: Array) -> Array:
            along = np.einsum("abijk,abijk->ijk", adjugate, self._jacobian.change(d), optimize=True)
            return (self._weight * self._jacobian.adjoint(curvature * along * adjugate)).astype(d.dtype)

        return QuadraticModel(self._weight * float(value.sum()), gradient, apply, np.zeros(c.shape))


def barrier(det: Array) -> tuple[Array, Array, Array]:
    """Barrier (0.3 / det - 1)^2 where det < 0.3, else zero; its slope and a non-negative curvature, each like det.

    Below det = 0.02 it goes on as a straight line, so that a folded start can still be mended.
    """
    d = np.maximum(det, FLOOR)
    excess = np.maximum(KNEE / d - 1, 0)
    slope = -2 * excess * KNEE / d**2
    value = excess**2 + slope * (det - d)
    curvature = np.where(excess > 0, 2 * (KNEE / d**2) ** 2, 0)
    return value, slope, curvature
