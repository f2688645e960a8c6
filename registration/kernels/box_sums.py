"""Sums over a cubic window about every voxel, by running sums along each axis."""

from __future__ import annotations

from functools import partial

import numpy as np
from numba import njit

from registration.kernels.threads import in_parts
from registration.volume import Array

THREADS_FROM = 32
"""Planes: waking threads for fewer takes longer than they do."""


def box_sums(values: Array, radius: int) -> Array:
    """Sums over the (2 radius + 1)^3 voxels around each voxel of (q, ni, nj, nk); outside counts as zero."""
    out = np.empty_like(values)
    nq, ni, nj, _ = values.shape
    in_parts(partial(_sum_in_planes, values, radius, out), nq * ni, THREADS_FROM)
    in_parts(partial(_sum_across_planes, out, radius), nq * nj, THREADS_FROM)
    return out


@njit(cache=True)
def _add(sums, row, sign):
    for k in range(len(sums)):
        sums[k] += sign * row[k]


@njit(cache=True, nogil=True)
def _sum_in_planes(values, radius, out, first, end):
    _, ni, nj, nk = values.shape
    for t in range(first, end):
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
        _run_down(rows, radius, out[t // ni, t % ni])


@njit(cache=True, nogil=True)
def _sum_across_planes(values, radius, first, end):
    nj = values.shape[2]
    for t in range(first, end):
        column = values[t // nj, :, t % nj]
        _run_down(column.copy(), radius, column)


@njit(cache=True)
def _run_down(rows, radius, out):
    """Sums of the 2 radius + 1 rows about every row."""
    n, run = len(rows), np.zeros(rows.shape[1])
    for j in range(min(radius, n)):
        _add(run, rows[j], 1)
    for j in range(n):
        if j + radius < n:
            _add(run, rows[j + radius], 1)
        if j - radius - 1 >= 0:
            _add(run, rows[j - radius - 1], -1)
        for k in range(len(run)):
            out[j, k] = run[k]
