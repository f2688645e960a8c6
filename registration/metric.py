"""Similarity of sampled images: value, slope and curvature with respect to the moving image's values.

Each metric is a class whose `evaluate(m, w)` takes moving values m (n,) and weights w (n,) in [0, 1] at the samples.
The slope is exact; the curvature is a non-negative diagonal that bounds the Gauss-Newton Hessian, which is all an
optimizer needs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from registration.volume import Array


@dataclass(frozen=True)
class Similarity:
    """value: dissimilarity, 0 is best; slope, curvature: (n,) first and second derivatives by moving value."""

    value: float
    slope: Array
    curvature: Array


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
        ncc = float(np.dot(w * f, m)) / np.sqrt(mm * ff)
        slope = -w * (f / np.sqrt(mm * ff) - ncc * m / mm)
        return Similarity(1 - ncc, slope.astype(np.float32), (w / mm).astype(np.float32))


class LocalNcc:
    """1 - mean correlation coefficient over a cubic window around every sample.

    index: (n,) flat voxel indices of the samples on `shape`; radius: half the window's edge, voxels;
    floor: standard deviation in HU below which a window counts as noise (added to both variances).
    Ref: Cachier 2000; Avants 2008, eq. 6.
    """

    def __init__(self, fixed: Array, index: Array, shape: tuple[int, int, int], radius: int, floor: float) -> None:
        self.index, self.shape, self.radius, self.floor = index, shape, radius, floor
        self.fixed = fixed - fixed.dtype.type(fixed.mean())

    def evaluate(self, m: Array, w: Array) -> Similarity:
        """See the module's docstring."""
        f = self.fixed
        w, m = w.astype(f.dtype), (m - m.mean()).astype(f.dtype)
        sums = [self._gathered(v) for v in (w, w * f, w * m, w * f * f, w * m * m, w * f * m)]
        return self._from_sums(f, m, w, sums)

    def _from_sums(self, f: Array, m: Array, w: Array, sums: list[Array]) -> Similarity:
        n, sf, sm, sff, smm, sfm = sums
        n = np.maximum(n, n.dtype.type(1e-3))
        mean_f, mean_m = sf / n, sm / n
        noise = n * n.dtype.type(self.floor**2)
        vf = np.maximum(sff - sf * mean_f, 0) + noise
        vm = np.maximum(smm - sm * mean_m, 0) + noise
        vfm = sfm - sf * mean_m
        total = w.dtype.type(max(w.sum(), 1e-3))
        a = w / np.sqrt(vf * vm) / total
        cc = vfm * a
        b = cc / vm
        slope = -w * (f * self._gathered(a) - m * self._gathered(b) - self._gathered(a * mean_f - b * mean_m))
        curvature = w * self._gathered(w / vm / total)
        return Similarity(1 - float(cc.sum(dtype=np.float64)), slope, curvature)

    def _gathered(self, values: Array) -> Array:
        dense = np.zeros(self.shape, dtype=values.dtype)
        dense.reshape(-1)[self.index] = values
        return box_sum(dense, self.radius).reshape(-1)[self.index]


def box_sum(values: Array, radius: int) -> Array:
    """Sum over the (2 radius + 1)^3 voxels around each voxel of (ni, nj, nk); outside counts as zero."""
    out = np.empty_like(values)
    _sum_in_planes(values, radius, out)
    _sum_across_planes(out, radius)
    return out


@njit(cache=True, parallel=True, fastmath=True)
def _sum_in_planes(values, radius, out):
    ni, nj, nk = values.shape
    for i in prange(ni):
        rows = np.empty((nj, nk), dtype=values.dtype)
        for j in range(nj):
            run = 0.0
            for k in range(min(radius, nk)):
                run += values[i, j, k]
            for k in range(nk):
                if k + radius < nk:
                    run += values[i, j, k + radius]
                if k - radius - 1 >= 0:
                    run -= values[i, j, k - radius - 1]
                rows[j, k] = run
        run_j = np.zeros(nk)
        for j in range(min(radius, nj)):
            run_j += rows[j]
        for j in range(nj):
            if j + radius < nj:
                run_j += rows[j + radius]
            if j - radius - 1 >= 0:
                run_j -= rows[j - radius - 1]
            out[i, j] = run_j


@njit(cache=True, parallel=True, fastmath=True)
def _sum_across_planes(values, radius):
    ni, nj, nk = values.shape
    for j in prange(nj):
        column = values[:, j].copy()
        run = np.zeros(nk)
        for i in range(min(radius, ni)):
            run += column[i]
        for i in range(ni):
            if i + radius < ni:
                run += column[i + radius]
            if i - radius - 1 >= 0:
                run -= column[i - radius - 1]
            values[i, j] = run
