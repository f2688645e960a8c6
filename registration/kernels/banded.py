"""Products of banded matrices with the axes of an array: splines, their adjoints and Gaussian filters are all this.

Written for bands of a few entries: no BLAS, whose threads cost more than they bring on matrices this small. Threads are
used from four million products on; below that, waking them takes longer than the work.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from math import prod

import numpy as np
from numba import njit

from registration.kernels.threads import in_parts
from registration.volume import Array

THREADS_FROM = 4_000_000
LINES = 64


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
    kernel, n = (_last_axis, before) if after == 1 else (_inner_axis, before * rows)
    few = out.size * weights.shape[1] <= THREADS_FROM
    in_parts(partial(kernel, flat, matrix.first, weights, out), n, n + 1 if few else 1)
    return out.reshape(*s[:axis], rows, *s[axis + 1 :])


@njit(cache=True, nogil=True)
def _inner_axis(values, first, weights, out, start, stop):
    """Rows are named before they are added up: with out[p, r, q] the compiler would not work on several at once."""
    rows, width = out.shape[1], out.shape[2]
    for t in range(start, stop):
        p, r = t // rows, t % rows
        row = out[p, r]
        source, w = values[p, first[r]], weights[r, 0]
        for q in range(width):
            row[q] = w * source[q]
        for k in range(1, weights.shape[1]):
            source, w = values[p, first[r] + k], weights[r, k]
            for q in range(width):
                row[q] += w * source[q]


@njit(cache=True, nogil=True)
def _last_axis(values, first, weights, out, start, stop):
    """LINES lines at a time are turned, so that they lie side by side as in `_inner_axis`."""
    rows, n = weights.shape[0], values.shape[1]
    turned, done = np.zeros((n, LINES), values.dtype), np.zeros((rows, LINES), values.dtype)
    for begin in range(start, stop, LINES):
        m = min(LINES, stop - begin)
        for i in range(m):
            line = values[begin + i]
            for j in range(n):
                turned[j, i] = line[j, 0]
        for r in range(rows):
            row, source, w = done[r], turned[first[r]], weights[r, 0]
            for i in range(LINES):
                row[i] = w * source[i]
            for k in range(1, weights.shape[1]):
                source, w = turned[first[r] + k], weights[r, k]
                for i in range(LINES):
                    row[i] += w * source[i]
        for i in range(m):
            line = out[begin + i]
            for r in range(rows):
                line[r, 0] = done[r, i]
