"""Sums over a cubic window about every voxel, by running sums along each axis."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from registration.volume import Array


def box_sums(values: Array, radius: int) -> Array:
    """Sums over the (2 radius + 1)^3 voxels around each voxel of (q, ni, nj, nk); outside counts as zero."""
    out = np.empty_like(values)
    _sum_in_planes(values, radius, out)
    _sum_across_planes(out, radius)
    return out


@njit(cache=True, parallel=True)
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


@njit(cache=True, parallel=True)
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
