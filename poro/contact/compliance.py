"""Displacements of contact nodes under unit forces at contact nodes, computed when first asked for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit

from poro.arrays import Array
from poro.linalg.solver import LinearSolver, inverse_at

DOUBLE_UNKNOWNS = 3000
GROUPS = 128  # of contact nodes: about 2 cm of a lung's surface each


@dataclass(frozen=True)
class Groups:
    """Contact nodes taken together.

    label: (nc,) group; share: (g,) one over the nodes of a group; motion: (nc, 3, g, 3) displacements of all nodes
    under a unit force spread over a group, by direction of the force (last); mean: (g, 3, g, 3) of it over groups.
    """

    label: Array
    share: Array
    motion: Array
    mean: Array


class Compliance:
    """Compliance matrix of nc contact nodes; serves every load and every wall position of one lung.

    solver: of the free unknowns; unknowns: (nc, 3) rows of the contact nodes among them; size: how many there are.
    The matrix of more than `DOUBLE_UNKNOWNS` unknowns is kept in single precision, exact to about 4e-7 of its largest
    entry.
    """

    def __init__(self, solver: LinearSolver, unknowns: Array, size: int) -> None:
        self._solver = solver
        self._unknowns = unknowns
        self._size = size
        self._groups: Groups | None = None

    @cached_property
    def matrix(self) -> Array:
        """Symmetric (3 nc, 3 nc), mm per kPa mm2."""
        double = self._unknowns.size <= DOUBLE_UNKNOWNS
        return inverse_at(self._solver, self._unknowns.ravel(), self._size, np.float64 if double else np.float32)

    def groups(self, points: Array) -> Groups:
        """The nodes at points (nc, 3) in groups of neighbours; found once."""
        if self._groups is None:
            label = _bisect(points, GROUPS)
            share = 1 / np.bincount(label)
            sums = _group_sums(self.matrix, label, len(share)) * np.repeat(share, 3)[:, None]
            motion = sums.T.astype(self.matrix.dtype).reshape(len(label), 3, len(share), 3)
            mean = np.zeros((len(share), *motion.shape[1:]))
            np.add.at(mean, label, motion)
            self._groups = Groups(label, share, motion, mean * share[:, None, None, None])
        return self._groups

    def between(self, nodes: Array, along: Array) -> Array:
        """Motion (k, k) of contact nodes (k,) along directions (k, 3) under unit forces at them along these."""
        return _between(self.matrix, nodes, along)

    def apply(self, force: Array) -> Array:
        """Displacements (nc, 3) of all contact nodes under forces (nc, 3), most of them zero."""
        loaded = np.flatnonzero(force.any(axis=1))
        return _apply(self.matrix, loaded, force[loaded]).reshape(-1, 3)


def _bisect(points: Array, groups: int) -> Array:
    """Labels (n,) of points (n, 3) cut in two across the longest side again and again, into at most `groups`."""
    label = np.zeros(len(points), np.int64)
    pieces = [np.arange(len(points))]
    while 2 * len(pieces) <= groups and min(len(piece) for piece in pieces) > 1:
        halves = []
        for piece in pieces:
            order = piece[np.argsort(points[piece][:, np.argmax(np.ptp(points[piece], axis=0))], kind="stable")]
            halves += [order[: len(order) // 2], order[len(order) // 2 :]]
        pieces = halves
    for number, piece in enumerate(pieces):
        label[piece] = number
    return label


@njit(cache=True)
def _group_sums(matrix: Array, label: Array, groups: int) -> Array:
    """Sums (3 g, 3 nc) of the rows over the groups, or of the columns, the matrix being symmetric.

    In double precision: rounding here would load the geometric stiffness, and contact would not converge.
    """
    sums = np.zeros((3 * groups, matrix.shape[1]))
    for n in range(len(label)):
        for axis in range(3):
            total, row = sums[3 * label[n] + axis], matrix[3 * n + axis]
            for c in range(len(row)):
                total[c] += row[c]
    return sums


@njit(cache=True)
def _between(matrix: Array, nodes: Array, along: Array) -> Array:
    count, last, tile = len(nodes), 0, 32
    result = np.empty((count, count))
    row = np.empty(matrix.shape[1])
    for i in range(count):
        n = nodes[i]
        last = max(last, 3 * n + 3)
        x, y, z = along[i, 0], along[i, 1], along[i, 2]
        first, second, third = matrix[3 * n], matrix[3 * n + 1], matrix[3 * n + 2]
        for c in range(last):
            row[c] = x * first[c] + y * second[c] + z * third[c]
        for j in range(i + 1):
            c = 3 * nodes[j]
            result[i, j] = along[j, 0] * row[c] + along[j, 1] * row[c + 1] + along[j, 2] * row[c + 2]
    for start in range(0, count, tile):  # by tiles, which stay in the cache
        for i in range(start, count):
            for j in range(start, min(start + tile, i)):
                result[j, i] = result[i, j]
    return result


@njit(cache=True)
def _apply(matrix: Array, nodes: Array, force: Array) -> Array:
    size, width = matrix.shape[1], 1024
    u = np.zeros(size)
    for start in range(0, size, width):
        part = u[start : min(start + width, size)]
        for k in range(len(nodes)):
            n, x, y, z = 3 * nodes[k], force[k, 0], force[k, 1], force[k, 2]
            first, second, third = matrix[n, start:], matrix[n + 1, start:], matrix[n + 2, start:]
            for j in range(len(part)):
                part[j] += x * first[j] + y * second[j] + z * third[j]
    return u
