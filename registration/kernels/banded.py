"""Products of banded matrices with the axes of an array: splines, their adjoints and Gaussian filters are all this.

Written for bands of a few entries: no BLAS, whose threads cost more than they bring on matrices this small. Threads are
used from a million products on; below that, waking them takes longer than the work.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

import numpy as np
from numba import njit, prange

from registration.volume import Array

THREADS_FROM = 1_000_000
CHUNKS = 16


class Banded:
    """Matrix (rows, columns) kept as one contiguous run of entries per row."""

    def __init__(self, matrix: Array) -> None:
        filled = matrix != 0
        first = np.where(filled.any(axis=1), np.argmax(filled, axis=1), 0)
        last = np.where(filled.any(axis=1), matrix.shape[1] - np.argmax(filled[:, ::-1], axis=1), 1)
        width = int((last - first).max())
        first = np.minimum(first, matrix.shape[1] - width)
        taps = first[:, None] + np.arange(width)
        self.shape = (matrix.shape[0], matrix.shape[1])
        self.first = first
        self.weights = np.ascontiguousarray(np.take_along_axis(matrix, taps, axis=1), dtype=float)
        self._single = self.weights.astype(np.float32)

    def weights_like(self, values: Array) -> Array:
        """The entries in the precision of `values`."""
        return self._single if values.dtype == np.float32 else self.weights

    def diagonal(self) -> Array:
        """Entries (i, i), (rows,), of a square matrix."""
        return self.weights[np.arange(self.shape[0]), np.arange(self.shape[0]) - self.first]


def along_axes(values: Array, matrices: Sequence[Banded]) -> Array:
    """Multiply axes 1, 2, 3 of (q, ni, nj, nk) by their matrices, cheapest order: axes that shrink most first."""
    for axis in sorted(range(3), key=lambda m: matrices[m].shape[0] / matrices[m].shape[1]):
        values = along_axis(values, axis + 1, matrices[axis])
    return values


def along_axis(values: Array, axis: int, matrix: Banded) -> Array:
    """Multiply one axis of an array by a matrix."""
    s, rows = values.shape, matrix.shape[0]
    before, after = prod(s[:axis]), prod(s[axis + 1 :])
    out = np.empty((before, rows, after), dtype=values.dtype)
    flat = np.ascontiguousarray(values).reshape(before, s[axis], after)
    weights = matrix.weights_like(values)
    many = out.size * weights.shape[1] > THREADS_FROM
    if after == 1:
        (_last_axis_threads if many else _last_axis)(flat, matrix.first, weights, out, 0, before)
    else:
        (_inner_axis_threads if many else _inner_axis)(flat, matrix.first, weights, out, 0, before * rows)
    return out.reshape(*s[:axis], rows, *s[axis + 1 :])


@njit(cache=True)
def _inner_axis(values, first, weights, out, start, stop):
    rows, width = out.shape[1], out.shape[2]
    taps = weights.shape[1]
    for t in range(start, stop):
        p, r = t // rows, t % rows
        for q in range(width):
            out[p, r, q] = weights[r, 0] * values[p, first[r], q]
        for k in range(1, taps):
            w = weights[r, k]
            for q in range(width):
                out[p, r, q] += w * values[p, first[r] + k, q]


@njit(cache=True)
def _last_axis(values, first, weights, out, start, stop):
    rows, taps = weights.shape
    for p in range(start, stop):
        for r in range(rows):
            total = weights[r, 0] * values[p, first[r], 0]
            for k in range(1, taps):
                total += weights[r, k] * values[p, first[r] + k, 0]
            out[p, r, 0] = total


@njit(cache=True, parallel=True)
def _inner_axis_threads(values, first, weights, out, start, stop):
    for c in prange(CHUNKS):
        _inner_axis(values, first, weights, out, stop * c // CHUNKS, stop * (c + 1) // CHUNKS)


@njit(cache=True, parallel=True)
def _last_axis_threads(values, first, weights, out, start, stop):
    for c in prange(CHUNKS):
        _last_axis(values, first, weights, out, stop * c // CHUNKS, stop * (c + 1) // CHUNKS)
