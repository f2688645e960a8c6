"""Cubic B-spline displacement fields on a uniform control grid; a dense field is three small matrix products.

Ref: Rueckert 1999, eq. 1 (free-form deformation) and eq. 8 (bending energy).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numba import njit
from scipy import sparse

from registration.kernels.banded import Banded, along_axes
from registration.kernels.threads import MANY_POINTS, in_parts
from registration.maps.field import DisplacementField
from registration.volume import Array, Grid


@dataclass(frozen=True, repr=False)
class BSplineField:
    """Map x -> x + u(x), u(x) = sum_k B3(x - k) c_k. coefficients: (ni, nj, nk, 3), mm, RAS.

    ras_from_ijk: (4, 4), places the control points. Beyond the box in which all four neighbours exist, the displacement
    of the nearest point of that box holds.
    """

    coefficients: Array
    ras_from_ijk: Array

    def __post_init__(self) -> None:
        shape = self.coefficients.shape
        if len(shape) != 4 or shape[3] != 3 or min(shape[:3]) < 4:
            raise ValueError(f"coefficients must be (ni, nj, nk, 3) with at least 4 along each axis, got {shape}")

    @cached_property
    def control(self) -> Grid:
        """The lattice of control points."""
        s = self.coefficients.shape
        return Grid((s[0], s[1], s[2]), self.ras_from_ijk)

    def __repr__(self) -> str:
        sp = " x ".join(f"{s:.1f}" for s in self.control.spacing)
        return f"BSplineField({' x '.join(map(str, self.control.shape))} control points every {sp} mm)"

    def displacement(self, points_ras: Array) -> Array:
        """u (n, 3) in mm at points (n, 3) in RAS mm."""
        points = np.ascontiguousarray(self.control.to_ijk(np.asarray(points_ras, dtype=float)))
        out = np.empty((len(points), 3))
        coefficients = np.ascontiguousarray(self.coefficients, dtype=float)
        in_parts(partial(_evaluate, coefficients, points, out), len(points), MANY_POINTS)
        return out

    def __call__(self, points_ras: Array) -> Array:
        """x + u(x), (n, 3), of points (n, 3) in RAS mm."""
        return np.asarray(points_ras, dtype=float) + self.displacement(points_ras)

    def dense(self, grid: Grid) -> DisplacementField:
        """u on the voxels of a grid whose axes are parallel to the control grid's."""
        c = np.moveaxis(self.coefficients, 3, 0).astype(np.float32)
        vectors = np.moveaxis(Lattice(self.control, grid).forward(c), 0, 3)
        return DisplacementField(np.ascontiguousarray(vectors), grid.ras_from_ijk)

    def refined(self) -> BSplineField:
        """The same map on a control grid of half the spacing (exact: Lane-Riesenfeld subdivision along each axis)."""
        c = self.coefficients
        for axis in range(3):
            c = _subdivided(c, axis)
        affine = self.ras_from_ijk.copy()
        affine[:3, :3] /= 2
        affine[:3, 3] = self.control.to_ras(np.full(3, 0.5))
        return BSplineField(c, affine)


def control_grid(grid: Grid, spacing_mm: float) -> Grid:
    """Control points about `spacing_mm` apart whose support covers `grid`; axes parallel to the grid's."""
    h = grid.spacing
    extent = (np.array(grid.shape) - 1) * h
    cells = np.maximum(np.ceil(extent / spacing_mm - 1e-9), 1).astype(int)
    margin = (cells * spacing_mm - extent) / 2
    affine = grid.ras_from_ijk.copy()
    affine[:3, :3] *= spacing_mm / h
    affine[:3, 3] = grid.to_ras(-(margin + spacing_mm) / h)
    n = cells + 3
    return Grid((int(n[0]), int(n[1]), int(n[2])), affine)


def parallel(control: Grid, grid: Grid) -> bool:
    """Whether each axis of one grid runs along the same axis of the other."""
    a = control.ijk_from_ras[:3, :3] @ grid.ras_from_ijk[:3, :3]
    return bool(np.abs(a - np.diag(np.diag(a))).max() <= 1e-6)


class Lattice:
    """Dense evaluation on a voxel grid, and its adjoint, as one small matrix per axis."""

    def __init__(self, control: Grid, grid: Grid) -> None:
        a = control.ijk_from_ras @ grid.ras_from_ijk
        if not parallel(control, grid):
            raise ValueError(
                "the control grid's axes must be parallel to the voxel grid's; use displacement(points) instead"
            )
        self.control, self.grid = control, grid
        dense = [basis_derivative(a[m, m] * np.arange(grid.shape[m]) + a[m, 3], control.shape[m], 0) for m in range(3)]
        self._forward = [Banded(m) for m in dense]
        self._adjoint = [Banded(m.T) for m in dense]
        self._squared = [Banded((m * m).T) for m in dense]

    def forward(self, coefficients: Array) -> Array:
        """Dense values (q, vi, vj, vk) of coefficients (q, ni, nj, nk)."""
        return along_axes(coefficients, self._forward)

    def adjoint(self, dense: Array) -> Array:
        """Transpose of `forward`: (q, vi, vj, vk) -> (q, ni, nj, nk)."""
        return along_axes(dense, self._adjoint)

    def adjoint_squared(self, dense: Array) -> Array:
        """Adjoint with squared weights: the diagonal of forward^T diag(dense) forward."""
        return along_axes(dense, self._squared)


def basis_derivative(x: Array, n: int, order: int) -> Array:
    """Weights (points, n) of cubic B-splines (order 0) or their first derivatives (order 1) at coordinates x.

    x: (points,) in control-grid units, clamped to [1, n - 2], so that derivatives beyond are zero; these are per
    control-grid unit.
    """
    beyond = (np.abs(x - (n - 1) / 2) > (n - 3) / 2 + 1e-9)[:, None]
    signed = np.clip(x, 1.0, n - 2.0)[:, None] - np.arange(n)[None, :]
    distance = np.abs(signed)
    if order == 0:
        near, far = (4 - 6 * distance**2 + 3 * distance**3) / 6, (2 - distance) ** 3 / 6
    else:
        inward = np.where(beyond, 0.0, np.sign(signed))
        near, far = inward * (1.5 * distance**2 - 2 * distance), -inward * (2 - distance) ** 2 / 2
    return np.where(distance < 1, near, np.where(distance < 2, far, 0.0))


def _subdivided(c: Array, axis: int) -> Array:
    """Coefficients at half the spacing along one axis; the new lattice starts half an old cell after the old one."""
    c = np.moveaxis(c, axis, 0)
    n = len(c)
    out = np.empty((2 * n - 3, *c.shape[1:]), dtype=c.dtype)
    out[0::2] = (c[:-1] + c[1:]) / 2
    out[1::2] = (c[:-2] + 6 * c[1:-1] + c[2:]) / 8
    return np.moveaxis(out, 0, axis)


@njit(cache=True, nogil=True)
def _evaluate(coefficients, points, out, first, end):
    ni, nj, nk, _ = coefficients.shape
    for n in range(first, end):
        x = min(max(points[n, 0], 1.0), ni - 2.0)
        y = min(max(points[n, 1], 1.0), nj - 2.0)
        z = min(max(points[n, 2], 1.0), nk - 2.0)
        i, j, k = min(int(x), ni - 3), min(int(y), nj - 3), min(int(z), nk - 3)
        w = np.empty((3, 4))
        for m in range(3):
            t = x - i if m == 0 else (y - j if m == 1 else z - k)
            w[m, 0] = (1 - t) ** 3 / 6
            w[m, 1] = (3 * t**3 - 6 * t**2 + 4) / 6
            w[m, 2] = (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6
            w[m, 3] = t**3 / 6
        u0, u1, u2 = 0.0, 0.0, 0.0
        for a in range(4):
            for b in range(4):
                for c in range(4):
                    weight = w[0, a] * w[1, b] * w[2, c]
                    u0 += weight * coefficients[i + a - 1, j + b - 1, k + c - 1, 0]
                    u1 += weight * coefficients[i + a - 1, j + b - 1, k + c - 1, 1]
                    u2 += weight * coefficients[i + a - 1, j + b - 1, k + c - 1, 2]
        out[n, 0], out[n, 1], out[n, 2] = u0, u1, u2


def basis_rows(control: Grid, points_ras: Array) -> sparse.csr_array:
    """Weights of the 64 control points around each point, sparse (n, control points in C order)."""
    x = control.to_ijk(np.asarray(points_ras, dtype=float))
    rows = [basis_derivative(x[:, m], control.shape[m], 0) for m in range(3)]
    first = [
        np.clip(np.floor(np.clip(x[:, m], 1, control.shape[m] - 2)), 1, control.shape[m] - 3).astype(int) - 1
        for m in range(3)
    ]
    n = len(x)
    weights, columns = np.ones((n, 1)), np.zeros((n, 1), dtype=int)
    for m in range(3):
        taken = first[m][:, None] + np.arange(4)
        weights = (weights[:, :, None] * np.take_along_axis(rows[m], taken, axis=1)[:, None, :]).reshape(n, -1)
        columns = (columns[:, :, None] * control.shape[m] + taken[:, None, :]).reshape(n, -1)
    indptr = np.arange(0, 64 * n + 1, 64)
    return sparse.csr_array((weights.ravel(), columns.ravel(), indptr), shape=(n, int(np.prod(control.shape))))
