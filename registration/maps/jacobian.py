"""The Jacobian dT/dx of T(x) = P(x) + u(x) at block centres, its determinant and cofactors."""

from __future__ import annotations

import numpy as np

from registration.kernels.banded import Banded, along_axes
from registration.maps.bspline import basis_derivative
from registration.maps.composite import is_separable
from registration.maps.field import PointMap
from registration.volume import Array, Grid


class Jacobian:
    """F = dT/dx of the whole map on the centres of a block grid.

    control: control points of u; blocks: grid parallel to it; prior: P, whose own gradient is exact where it is made of
    splines, and else by central differences over 1 mm.
    """

    def __init__(self, control: Grid, blocks: Grid, prior: PointMap) -> None:
        a = control.ijk_from_ras @ blocks.ras_from_ijk
        x = [a[m, m] * np.arange(blocks.shape[m]) + a[m, 3] for m in range(3)]
        plain = [basis_derivative(x[m], control.shape[m], 0) for m in range(3)]
        slope = [basis_derivative(x[m], control.shape[m], 1) for m in range(3)]
        chosen = [[slope[m] if m == b else plain[m] for m in range(3)] for b in range(3)]
        self._matrices = [[Banded(m) for m in row] for row in chosen]
        self._transposed = [[Banded(m.T) for m in row] for row in chosen]
        self._ijk_from_ras = control.ijk_from_ras[:3, :3]
        self._prior = _gradient(prior, blocks)

    def gradient(self, c: Array) -> Array:
        """F[a, b] = dT_a / dx_b, (3, 3, bi, bj, bk), for coefficients c (3, ni, nj, nk)."""
        return self._prior + self.change(c)

    def change(self, d: Array) -> Array:
        """du_a / dx_b for coefficients d, (3, 3, bi, bj, bk): the linear part of `gradient`."""
        along = np.stack([along_axes(np.asarray(d, dtype=float), m) for m in self._matrices], axis=1)
        return np.einsum("amijk,mb->abijk", along, self._ijk_from_ras, optimize=True)

    def adjoint(self, p: Array) -> Array:
        """Transpose of `change`: (3, 3, bi, bj, bk) -> (3, ni, nj, nk)."""
        along = np.einsum("abijk,mb->amijk", p, self._ijk_from_ras, optimize=True)
        return np.sum([along_axes(along[:, m], self._transposed[m]) for m in range(3)], axis=0)


def _gradient(prior: PointMap, blocks: Grid) -> Array:
    """dP_a / dx_b, (3, 3, bi, bj, bk)."""
    if is_separable(prior, blocks):
        below = Jacobian(prior.field.control, blocks, prior.prior)
        return below.gradient(np.moveaxis(prior.field.coefficients, 3, 0))
    points = blocks.points().reshape(-1, 3)
    rows = [(prior(points + 0.5 * e) - prior(points - 0.5 * e)).T for e in np.eye(3)]
    return np.stack(rows, axis=1).reshape(3, 3, *blocks.shape)


def determinant(f: Array) -> Array:
    """det F, (bi, bj, bk), of F (3, 3, bi, bj, bk)."""
    return np.asarray(np.einsum("aijk,aijk->ijk", f[0], cofactor(f)[0]))


def cofactor(f: Array) -> Array:
    """Derivative of det F by F, (3, 3, bi, bj, bk)."""
    rows = [np.cross(f[1], f[2], axis=0), np.cross(f[2], f[0], axis=0), np.cross(f[0], f[1], axis=0)]
    return np.stack(rows)
