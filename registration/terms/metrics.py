"""Similarity of sampled images: value, slope and curvature with respect to the moving image's values.

Each metric is a class whose `evaluate` takes moving values m (n,) and weights w (n,) in [0, 1] at the samples. The
slope is exact; the curvature is a non-negative diagonal that bounds the Gauss-Newton Hessian, which is all an optimizer
needs. Both are worked out when they are first asked for: a line search asks for values alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from math import prod

import numpy as np
from numba import njit, prange

from registration.volume import Array


@dataclass(frozen=True)
class Similarity:
    """value: dissimilarity, 0 is best; derive: gives `slope` and `curvature`."""

    value: float
    derive: Callable[[], tuple[Array, Array]]

    @property
    def slope(self) -> Array:
        """First derivatives by the samples' moving values, (n,)."""
        return self._derivatives[0]

    @property
    def curvature(self) -> Array:
        """Second derivatives by the samples' moving values, (n,)."""
        return self._derivatives[1]

    @cached_property
    def _derivatives(self) -> tuple[Array, Array]:
        return self.derive()


class GlobalNcc:
    """1 - normalized correlation coefficient over all samples."""

    def __init__(self, fixed: Array) -> None:
        self.fixed = fixed.astype(np.float64)

    def evaluate(self, m: Array, w: Array) -> Similarity:
        """See the module's docstring."""
        m, w = m.astype(np.float64), w.astype(np.float64)
        f = self.fixed - np.average(self.fixed, weights=w)
        m = m - np.average(m, weights=w)
        mm = max(float(np.dot(w * m, m)), 1e-12)
        ff = max(float(np.dot(w * f, f)), 1e-12)
        ncc = float(np.dot(w * f, m) / np.sqrt(mm * ff))

        def derive() -> tuple[Array, Array]:
            slope = -w * (f / np.sqrt(mm * ff) - ncc * m / mm)
            return slope.astype(np.float32), (w / mm).astype(np.float32)

        return Similarity(1 - ncc, derive)


class LocalNcc:
    """1 - mean correlation coefficient over a cubic window around every sample.

    index: (n,) flat voxel indices of the samples on `shape`; radius: half the window's edge, voxels;
    floor: standard deviation in HU below which a window counts as noise (added to both variances).
    Ref: Cachier 2000; Avants 2008, eq. 6.
    """

    def __init__(self, fixed: Array, index: Array, shape: tuple[int, int, int], radius: int, floor: float) -> None:
        self.index, self.shape, self.radius, self.floor = index, shape, radius, floor
        self.fixed = fixed - fixed.dtype.type(fixed.mean())
        self._weights: Array | None = None
        self._fixed_sums: list[Array] = []

    def evaluate(self, m: Array, w: Array) -> Similarity:
        """See the module's docstring."""
        f = self.fixed
        if self._weights is None or not np.array_equal(self._weights, w):
            self._weights = w.copy()
            w = w.astype(f.dtype)
            self._fixed_sums = self._window_sums(w, w * f, w * f * f)
        w, m = w.astype(f.dtype), (m - m.mean()).astype(f.dtype)
        n, sf, sff = self._fixed_sums
        sm, smm, sfm = self._window_sums(w * m, w * m * m, w * f * m)
        scale = f.dtype.type(1 / max(float(w.sum(dtype=np.float64)), 1e-3))
        a, b, ab, h = (np.empty_like(f) for _ in range(4))
        noise = f.dtype.type(self.floor**2)
        cc = _correlations(w, n, sf, sff, sm, smm, sfm, noise, scale, a, b, ab, h)

        def derive() -> tuple[Array, Array]:
            sa, sb, sab, sh = self._window_sums(a, b, ab, h)
            return -w * (f * sa - m * sb - sab), w * sh

        return Similarity(1 - float(cc), derive)

    def _window_sums(self, *values: Array) -> list[Array]:
        """Sums over each sample's window of values given at the samples, (n,) each."""
        dense = np.zeros((len(values), prod(self.shape)), dtype=values[0].dtype)
        for row, v in zip(dense, values, strict=True):
            row[self.index] = v
        sums = box_sums(dense.reshape(-1, *self.shape), self.radius).reshape(len(values), -1)
        return [row[self.index] for row in sums]


@njit(cache=True, parallel=True)
def _correlations(w, n, sf, sff, sm, smm, sfm, noise, scale, a, b, ab, h):
    """Sum of the weighted correlation coefficients; fills what their derivatives are made of."""
    total = 0.0
    for p in prange(len(w)):
        count = max(n[p], 1e-3)
        mean_f, mean_m = sf[p] / count, sm[p] / count
        vf = max(sff[p] - sf[p] * mean_f, 0.0) + count * noise
        vm = max(smm[p] - sm[p] * mean_m, 0.0) + count * noise
        a[p] = w[p] * scale / np.sqrt(vf * vm)
        cc = (sfm[p] - sf[p] * mean_m) * a[p]
        b[p] = cc / vm
        ab[p] = a[p] * mean_f - b[p] * mean_m
        h[p] = w[p] * scale / vm
        total += cc
    return total


def box_sums(values: Array, radius: int) -> Array:
    """Sums over the (2 radius + 1)^3 voxels around each voxel of (q, ni, nj, nk); outside counts as zero."""
    out = np.empty_like(values)
    _sum_in_planes(values, radius, out)
    _sum_across_planes(out, radius)
    return out


@njit(cache=True, parallel=True, fastmath=True)
def _sum_in_planes(values, radius, out):
    nq, ni, nj, nk = values.shape
    for t in prange(nq * ni):
        plane, rows = values[t // ni, t % ni], np.empty((nj, nk), dtype=values.dtype)
        for j in range(nj):
            run = 0.0
            for k in range(min(radius, nk)):
                run += plane[j, k]
            for k in range(nk):
                if k + radius < nk:
                    run += plane[j, k + radius]
                if k - radius - 1 >= 0:
                    run -= plane[j, k - radius - 1]
                rows[j, k] = run
        run_j = np.zeros(nk)
        for j in range(min(radius, nj)):
            run_j += rows[j]
        for j in range(nj):
            if j + radius < nj:
                run_j += rows[j + radius]
            if j - radius - 1 >= 0:
                run_j -= rows[j - radius - 1]
            out[t // ni, t % ni, j] = run_j


@njit(cache=True, parallel=True, fastmath=True)
def _sum_across_planes(values, radius):
    nq, ni, nj, nk = values.shape
    for t in prange(nq * nj):
        q, j = t // nj, t % nj
        column = values[q, :, j].copy()
        run = np.zeros(nk)
        for i in range(min(radius, ni)):
            run += column[i]
        for i in range(ni):
            if i + radius < ni:
                run += column[i + radius]
            if i - radius - 1 >= 0:
                run -= column[i - radius - 1]
            values[q, i, j] = run
