"""What holds a free-form deformation back: bending, departure from the prior, matched points, folding."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from registration.maps.bspline import Lattice, basis_rows
from registration.maps.field import PointMap
from registration.maps.jacobian import Stretch, barrier, cofactor, determinant
from registration.terms.bending import BendingEnergy
from registration.terms.objective import Model
from registration.volume import Array, Grid


class Bending:
    """weight times the bending energy of u; weight in mm^2."""

    def __init__(self, control: Grid, weight: float) -> None:
        self._energy, self._weight = BendingEnergy(control), weight
        self._diagonal = np.broadcast_to(2 * weight * self._energy.diagonal(), (3, *control.shape))

    def value(self, c: Array) -> float:
        """weight c^T R c."""
        return self._weight * float(np.vdot(c, self._energy.apply(c.astype(float))))

    def model(self, c: Array) -> Model:
        """Exact: the term is quadratic."""
        rc = self._energy.apply(c.astype(float))
        scale = 2 * self._weight
        return Model(
            self._weight * float(np.vdot(c, rc)),
            scale * rc,
            lambda d: d.dtype.type(scale) * self._energy.apply(d),
            self._diagonal,
        )


class Departure:
    """weight times the mean of |u|^2 over a block grid: how far the map leaves its prior; weight in 1/mm^2.

    trust: (bi, bj, bk) in [0, 1], how firmly the prior holds at each block.
    """

    def __init__(self, control: Grid, blocks: Grid, weight: float, trust: Array | None = None) -> None:
        trust = np.ones(blocks.shape) if trust is None else trust
        self._lattice = Lattice(control, blocks)
        self._scale = (2 * weight / max(float(trust.sum()), 1e-12) * trust).astype(np.float32)

    def value(self, c: Array) -> float:
        """Half of c^T H c."""
        return 0.5 * float(np.vdot(c, self._apply(c)))

    def model(self, c: Array) -> Model:
        """Exact: the term is quadratic."""
        diagonal = np.broadcast_to(self._lattice.adjoint_squared(self._scale[None]), c.shape)
        hc = self._apply(c)
        return Model(0.5 * float(np.vdot(c, hc)), hc, self._apply, diagonal)

    def _apply(self, d: Array) -> Array:
        return self._lattice.adjoint(self._scale * self._lattice.forward(d))


@dataclass(frozen=True)
class Keypoints:
    """Matched points. fixed, moving: (n, 3) RAS mm; weights: (n,) >= 0; scale_mm: residuals beyond it count less."""

    fixed: Array
    moving: Array
    weights: Array
    scale_mm: float = 4.0

    def __post_init__(self) -> None:
        n = len(self.fixed)
        if self.fixed.shape != (n, 3) or self.moving.shape != (n, 3) or self.weights.shape != (n,):
            got = (self.fixed.shape, self.moving.shape, self.weights.shape)
            raise ValueError(f"keypoints must be (n, 3), (n, 3) and (n,), got {got}")


class Matches:
    """weight (1/mm^2) times the weighted mean of s^2 log(1 + |r|^2 / s^2), r = P(x) + u(x) - y at keypoints."""

    def __init__(self, control: Grid, keypoints: Keypoints, prior: PointMap, weight: float) -> None:
        self._basis = basis_rows(control, keypoints.fixed)
        self._transposed = sparse.csr_array(self._basis.T)
        self._squared = self._transposed.multiply(self._transposed).tocsr()
        self._gap = prior(keypoints.fixed) - keypoints.moving
        self._w = weight * keypoints.weights / max(float(keypoints.weights.sum()), 1e-12)
        self._s2 = keypoints.scale_mm**2

    def value(self, c: Array) -> float:
        """The robust mean."""
        return float(np.sum(self._w * self._s2 * np.log1p(self._residual(c)[1])))

    def model(self, c: Array) -> Model:
        """Gauss-Newton with the residuals' weights held fixed, as in iterated reweighted least squares."""
        r, q = self._residual(c)
        k = 2 * self._w / (1 + q)
        gradient = (self._transposed @ (k[:, None] * r)).T.reshape(c.shape)
        diagonal = np.broadcast_to((self._squared @ k).reshape(c.shape[1:]), c.shape)
        value = float(np.sum(self._w * self._s2 * np.log1p(q)))

        def apply(d: Array) -> Array:
            along = k[:, None] * (self._basis @ d.reshape(3, -1).T)
            return (self._transposed @ along).T.reshape(d.shape).astype(d.dtype)

        return Model(value, gradient, apply, diagonal)

    def _residual(self, c: Array) -> tuple[Array, Array]:
        r = self._gap + self._basis @ c.reshape(3, -1).T.astype(float)
        return r, np.sum(r * r, axis=1) / self._s2


class Folding:
    """weight times the mean over blocks of a barrier on det(dT/dx); see `registration.maps.jacobian.barrier`."""

    def __init__(self, control: Grid, blocks: Grid, prior: PointMap, weight: float) -> None:
        self._stretch = Stretch(control, blocks, prior)
        self._weight = weight / float(np.prod(blocks.shape))

    def value(self, c: Array) -> float:
        """The barrier's mean."""
        return self._weight * float(barrier(determinant(self._stretch.gradient(c)))[0].sum())

    def model(self, c: Array) -> Model:
        """Gauss-Newton on det, which drops its own second derivative; nothing where no block nears folding."""
        f = self._stretch.gradient(c)
        value, slope, curvature = barrier(determinant(f))
        if not value.any():
            return Model(0.0, np.zeros(c.shape), np.zeros_like, np.zeros(c.shape))
        adjugate = cofactor(f)
        gradient = self._weight * self._stretch.adjoint(slope * adjugate)

        def apply(d: Array) -> Array:
            along = np.einsum("abijk,abijk->ijk", adjugate, self._stretch.change(d), optimize=True)
            return (self._weight * self._stretch.adjoint(curvature * along * adjugate)).astype(d.dtype)

        return Model(self._weight * float(value.sum()), gradient, apply, np.zeros(c.shape))
