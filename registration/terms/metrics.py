"""Image metrics: dissimilarity of sampled images, with slope and curvature by the moving image's values.

Each metric is a class whose `evaluate` takes moving values m (n,) and weights w (n,) in [0, 1] at the samples. The
slope is exact; the curvature is a non-negative diagonal that bounds the Gauss-Newton Hessian, which is all an optimizer
needs. Both are worked out when they are first asked for: a line search asks for values alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from math import prod
from typing import NamedTuple, Protocol

import numpy as np
from numba import njit

from registration.kernels.box_sums import box_sums
from registration.kernels.threads import MANY_POINTS, in_parts
from registration.volume import Array


@dataclass(frozen=True)
class Dissimilarity:
    """value: 0 is best; derive: gives `slope` and `curvature`."""

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


class Metric(Protocol):
    """A dissimilarity of the samples; see the module's docstring."""

    def evaluate(self, m: Array, w: Array) -> Dissimilarity: ...


class _FixedSums(NamedTuple):
    """Weighted sums (n,) over the windows: of one, of the fixed values and of their squares."""

    n: Array
    f: Array
    ff: Array


class _MovingSums(NamedTuple):
    """Weighted sums (n,) over the windows: of the moving values, their squares and their products with the fixed."""

    m: Array
    mm: Array
    fm: Array


class GlobalNcc:
    """1 - normalized correlation coefficient over all samples."""

    def __init__(self, fixed: Array) -> None:
        self.fixed = fixed.astype(np.float64)

    def evaluate(self, m: Array, w: Array) -> Dissimilarity:
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

        return Dissimilarity(1 - ncc, derive)


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
        self._fixed_sums = _FixedSums(self.fixed, self.fixed, self.fixed)

    def evaluate(self, m: Array, w: Array) -> Dissimilarity:
        """See the module's docstring."""
        f = self.fixed
        if self._weights is None or not np.array_equal(self._weights, w):
            self._weights = w.copy()
            w = w.astype(f.dtype)
            self._fixed_sums = _FixedSums(*self._window_sums(w, w * f, w * f * f))
        w, m = w.astype(f.dtype), (m - m.mean()).astype(f.dtype)
        sums = _MovingSums(*self._window_sums(w * m, w * m * m, w * f * m))
        scaled = w * f.dtype.type(1 / max(float(w.sum(dtype=np.float64)), 1e-3))
        parts, cc = np.empty((4, len(f)), dtype=f.dtype), np.empty_like(f)
        noise = f.dtype.type(self.floor**2)
        in_parts(partial(_correlations, scaled, self._fixed_sums, sums, noise, parts, cc), len(f), MANY_POINTS)

        def derive() -> tuple[Array, Array]:
            sa, sb, sab, sh = self._window_sums(*parts)
            return -w * (f * sa - m * sb - sab), w * sh

        return Dissimilarity(1 - float(cc.sum(dtype=np.float64)), derive)

    def _window_sums(self, *values: Array) -> list[Array]:
        """Sums over each sample's window of values given at the samples, (n,) each."""
        dense = np.zeros((len(values), prod(self.shape)), dtype=values[0].dtype)
        for row, v in zip(dense, values, strict=True):
            row[self.index] = v
        sums = box_sums(dense.reshape(-1, *self.shape), self.radius).reshape(len(values), -1)
        return [row[self.index] for row in sums]


@njit(cache=True, nogil=True)
def _correlations(w, fixed, moving, noise, parts, cc, first, end):
    """Fill cc (n,) with the correlation coefficients weighted by w (n,), and parts (4, n), of which their derivatives
    are made, from `first` to `end`. They are summed elsewhere: a sum over parts depends on the number of threads.
    """
    n, sf, sff = fixed.n, fixed.f, fixed.ff
    sm, smm, sfm = moving.m, moving.mm, moving.fm
    for p in range(first, end):
        count = max(n[p], 1e-3)
        mean_f, mean_m = sf[p] / count, sm[p] / count
        vf = max(sff[p] - sf[p] * mean_f, 0.0) + count * noise
        vm = max(smm[p] - sm[p] * mean_m, 0.0) + count * noise
        parts[0, p] = w[p] / np.sqrt(vf * vm)
        cc[p] = (sfm[p] - sf[p] * mean_m) * parts[0, p]
        parts[1, p] = cc[p] / vm
        parts[2, p] = parts[0, p] * mean_f - parts[1, p] * mean_m
        parts[3, p] = w[p] / vm
