"""Smooth maps of space as quadratic tensor-product splines, exact in value, gradient and inverse."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

Array = NDArray[Any]


@dataclass(frozen=True)
class SplineMap:
    """x = X + sum of coefficients times quadratic B-splines. coefficients: (nx, ny, nz, 3) mm; origin: (3,)
    mm, centre of the first basis function; spacing: mm."""

    coefficients: Array
    origin: Array
    spacing: float

    def __call__(self, points: Array) -> Array:
        """Mapped points (n, 3), RAS mm."""
        return self.with_gradient(points)[0]

    def with_gradient(self, points: Array) -> tuple[Array, Array]:
        """Mapped points (n, 3) and deformation gradients (n, 3, 3) at points (n, 3)."""
        p = np.ascontiguousarray(points, dtype=np.float64)
        out, f = np.empty_like(p), np.empty((len(p), 3, 3))
        _evaluate(self.coefficients, self.origin, self.spacing, p, out, f)
        return out, f

    def determinant(self, points: Array) -> Array:
        """Ratio of volumes det F at points (n, 3)."""
        return determinant(self.with_gradient(points)[1])

    def inverse(self, points: Array, samples: Array, tolerance_mm: float = 1e-4) -> tuple[Array, Array]:
        """Sources (n, 3) of `points` (n, 3) by Newton's method from the nearest mapped sample; what is left, (n,) mm.

        samples: (m, 3) points of the source domain, no more than half a `spacing` apart.
        """
        targets = np.ascontiguousarray(points, dtype=np.float64)
        mapped, f = self.with_gradient(samples)
        near = cKDTree(mapped).query(targets)[1]
        source = samples[near] + np.einsum("nij,nj->ni", np.linalg.inv(f)[near], targets - mapped[near])
        return self.follow(targets, source, tolerance_mm)

    def follow(self, points: Array, start: Array, tolerance_mm: float = 1e-4) -> tuple[Array, Array]:
        """Sources (n, 3) of `points` (n, 3) by Newton's method from `start` (n, 3); what is left, (n,) mm."""
        targets, source = np.ascontiguousarray(points, dtype=np.float64), np.array(start, dtype=np.float64)
        left = np.empty(len(targets))
        _newton(self.coefficients, self.origin, self.spacing, targets, source, left, tolerance_mm)
        return source, left


def basis(points: Array, origin: Array, spacing: float, shape: tuple[int, int, int]) -> list[sparse.csr_array]:
    """Matrices (n, nodes) of the basis' values and of its derivatives along x, y, z (1/mm) at points (n, 3)."""
    s = (points - origin) / spacing
    centre = np.clip(np.rint(s).astype(int), 1, np.array(shape) - 2)
    t = s - centre
    value = np.stack([0.5 * (0.5 - t) ** 2, 0.75 - t**2, 0.5 * (0.5 + t) ** 2], axis=-1)
    slope = np.stack([t - 0.5, -2 * t, t + 0.5], axis=-1) / spacing
    offset = np.arange(-1, 2)
    nodes = [centre[:, m, None] + offset for m in range(3)]
    column = (nodes[0][:, :, None, None] * shape[1] + nodes[1][:, None, :, None]) * shape[2] + nodes[2][
        :, None, None, :
    ]
    rows = np.arange(len(points) + 1) * 27
    size = (len(points), int(np.prod(shape)))
    matrices = []
    for d in (-1, 0, 1, 2):
        w = [(slope if m == d else value)[:, m] for m in range(3)]
        data = w[0][:, :, None, None] * w[1][:, None, :, None] * w[2][:, None, None, :]
        matrices.append(sparse.csr_array((data.ravel(), column.ravel(), rows), shape=size))
    return matrices


def cofactors(f: Array) -> Array:
    """Cofactor matrices det(F) F^-T of matrices F (n, 3, 3)."""
    out = np.empty_like(f)
    for m in range(3):
        p, q = f[:, (m + 1) % 3], f[:, (m + 2) % 3]
        for n in range(3):
            i, j = (n + 1) % 3, (n + 2) % 3
            out[:, m, n] = p[:, i] * q[:, j] - p[:, j] * q[:, i]
    return out


def determinant(f: Array) -> Array:
    """Determinants of matrices (n, 3, 3)."""
    return np.asarray((f[:, 0] * cofactors(f)[:, 0]).sum(axis=1))


@numba.njit(cache=True)
def _at(c, origin, h, point, x, f):
    """Value x (3,) and gradient f (3, 3) of the map at a point (3,)."""
    nx, ny, nz = c.shape[:3]
    px, py, pz = point[0], point[1], point[2]
    sx, sy, sz = (px - origin[0]) / h, (py - origin[1]) / h, (pz - origin[2]) / h
    i = min(max(int(np.floor(sx + 0.5)), 1), nx - 2)
    j = min(max(int(np.floor(sy + 0.5)), 1), ny - 2)
    k = min(max(int(np.floor(sz + 0.5)), 1), nz - 2)
    a = min(max(sx - i, -0.5), 0.5)
    b = min(max(sy - j, -0.5), 0.5)
    e = min(max(sz - k, -0.5), 0.5)
    wx = (0.5 * (0.5 - a) ** 2, 0.75 - a * a, 0.5 * (0.5 + a) ** 2)
    wy = (0.5 * (0.5 - b) ** 2, 0.75 - b * b, 0.5 * (0.5 + b) ** 2)
    wz = (0.5 * (0.5 - e) ** 2, 0.75 - e * e, 0.5 * (0.5 + e) ** 2)
    gx = ((a - 0.5) / h, -2 * a / h, (a + 0.5) / h)
    gy = ((b - 0.5) / h, -2 * b / h, (b + 0.5) / h)
    gz = ((e - 0.5) / h, -2 * e / h, (e + 0.5) / h)
    x[0], x[1], x[2] = px, py, pz
    for m in range(3):
        for n in range(3):
            f[m, n] = 1.0 if m == n else 0.0
    for p in range(3):
        for q in range(3):
            vxy, dxy, dyx = wx[p] * wy[q], gx[p] * wy[q], wx[p] * gy[q]
            for r in range(3):
                v, d0, d1, d2 = vxy * wz[r], dxy * wz[r], dyx * wz[r], vxy * gz[r]
                for m in range(3):
                    u = c[i + p - 1, j + q - 1, k + r - 1, m]
                    x[m] += v * u
                    f[m, 0] += d0 * u
                    f[m, 1] += d1 * u
                    f[m, 2] += d2 * u


@numba.njit(cache=True)
def _evaluate(c, origin, h, points, out, gradient):
    for n in range(len(points)):
        _at(c, origin, h, points[n], out[n], gradient[n])


@numba.njit(cache=True)
def _newton(c, origin, h, targets, source, left, tolerance):
    x, f = np.empty(3), np.empty((3, 3))
    for n in range(len(targets)):
        p = source[n]
        for _ in range(25):
            _at(c, origin, h, p, x, f)
            r0, r1, r2 = targets[n, 0] - x[0], targets[n, 1] - x[1], targets[n, 2] - x[2]
            left[n] = np.sqrt(r0 * r0 + r1 * r1 + r2 * r2)
            if left[n] < tolerance:
                break
            c00 = f[1, 1] * f[2, 2] - f[1, 2] * f[2, 1]
            c01 = f[1, 2] * f[2, 0] - f[1, 0] * f[2, 2]
            c02 = f[1, 0] * f[2, 1] - f[1, 1] * f[2, 0]
            det = f[0, 0] * c00 + f[0, 1] * c01 + f[0, 2] * c02
            if abs(det) < 1e-3:
                break
            d0 = (
                c00 * r0 + (f[0, 2] * f[2, 1] - f[0, 1] * f[2, 2]) * r1 + (f[0, 1] * f[1, 2] - f[0, 2] * f[1, 1]) * r2
            ) / det
            d1 = (
                c01 * r0 + (f[0, 0] * f[2, 2] - f[0, 2] * f[2, 0]) * r1 + (f[0, 2] * f[1, 0] - f[0, 0] * f[1, 2]) * r2
            ) / det
            d2 = (
                c02 * r0 + (f[0, 1] * f[2, 0] - f[0, 0] * f[2, 1]) * r1 + (f[0, 0] * f[1, 1] - f[0, 1] * f[1, 0]) * r2
            ) / det
            size = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
            scale = min(1.0, 0.6 * h / max(size, 1e-12))
            p[0] += scale * d0
            p[1] += scale * d1
            p[2] += scale * d2
