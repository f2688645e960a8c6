"""A grid over the tetrahedra of a mesh, in which those about a point are found at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from poro.arrays import Array


class Cells(NamedTuple):
    """Uniform grid of cubes of `width` mm from `origin` (3,), and the tetrahedra in each, as compressed rows."""

    origin: Array
    width: float
    shape: Array
    start: Array
    members: Array


def cells_of(points: Array, tets: Array, volumes: Array) -> Cells:
    """Cells of the tetrahedra (m, 4) between points (n, 3) mm, about as wide as these are; volumes: (m,) mm3."""
    x = points[tets]
    lower, upper = x.min(axis=1), x.max(axis=1)
    origin = points.min(axis=0)
    width = float(np.cbrt(np.abs(volumes).mean() * 6))
    shape = np.floor((points.max(axis=0) - origin) / width).astype(np.int64) + 1
    first = np.clip(((lower - origin) / width).astype(np.int64), 0, shape - 1)
    last = np.clip(((upper - origin) / width).astype(np.int64), 0, shape - 1)
    return Cells(origin, width, shape, *_bins(first, last, shape))


@njit(cache=True)
def _bins(first: Array, last: Array, shape: Array) -> tuple[Array, Array]:
    """Tetrahedra whose boxes touch each cell of a uniform grid, as compressed rows."""
    start = np.zeros(shape[0] * shape[1] * shape[2] + 1, np.int64)
    for t in range(len(first)):
        for i in range(first[t, 0], last[t, 0] + 1):
            for j in range(first[t, 1], last[t, 1] + 1):
                for k in range(first[t, 2], last[t, 2] + 1):
                    start[(i * shape[1] + j) * shape[2] + k + 1] += 1
    start = np.cumsum(start)
    members = np.empty(start[-1], np.int64)
    fill = start[:-1].copy()
    for t in range(len(first)):
        for i in range(first[t, 0], last[t, 0] + 1):
            for j in range(first[t, 1], last[t, 1] + 1):
                for k in range(first[t, 2], last[t, 2] + 1):
                    cell = (i * shape[1] + j) * shape[2] + k
                    members[fill[cell]] = t
                    fill[cell] += 1
    return start, members
