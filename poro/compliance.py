"""Displacements of contact nodes under unit forces at contact nodes, computed when first asked for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from poro.mesh.tetmesh import Array
from poro.solver import LinearSolver

GROUPS = 128  # of contact nodes: about 2 cm of a lung's surface each


@dataclass(frozen=True)
class Groups:
    """Contact nodes taken together.

    label: (nc,) group; share: (g,) one over the nodes of a group; motion: (g, nc, 3, 3) displacements of all nodes
    under a unit force spread over a group, by direction of the force (last).
    """

    label: Array
    share: Array
    motion: Array


class Compliance:
    """Lazy columns of the compliance matrix of nc nodes; serves every load and every wall position of one lung.

    solver: of the free unknowns; unknowns: (nc, 3) rows of the contact nodes among them; size: how many there are.
    """

    def __init__(self, solver: LinearSolver, unknowns: Array, size: int) -> None:
        self._solver = solver
        self._unknowns = unknowns
        self._size = size
        self._place = np.full(len(unknowns), -1)
        self._blocks = np.zeros((0, len(unknowns), 3, 3))
        self._known = 0
        self._groups: Groups | None = None

    @property
    def columns(self) -> int:
        """Number of nodes whose columns are known."""
        return self._known

    def require(self, nodes: Array, batch: int = 128) -> None:
        """Solve for the columns of contact nodes (k,) that are not known yet."""
        missing = nodes[self._place[nodes] < 0]
        if len(missing) == 0:
            return
        needed = self._known + len(missing)
        if needed > len(self._blocks):
            grown = np.zeros((min(max(needed, 3 * needed // 2), len(self._unknowns)), *self._blocks.shape[1:]))
            grown[: self._known] = self._blocks[: self._known]
            self._blocks = grown
        for first in range(0, len(missing), batch):
            chunk = missing[first : first + batch]
            right = np.zeros((self._size, 3 * len(chunk)))
            right[self._unknowns[chunk].ravel(), np.arange(3 * len(chunk))] = 1
            u = self._solver.solve(right)[self._unknowns].reshape(len(self._unknowns), 3, len(chunk), 3)
            self._blocks[self._known : self._known + len(chunk)] = u.transpose(2, 0, 1, 3)
            self._place[chunk] = self._known + np.arange(len(chunk))
            self._known += len(chunk)

    def groups(self, points: Array) -> Groups:
        """The nodes at points (nc, 3) in groups of neighbours; solved for once."""
        if self._groups is None:
            label = _bisect(points, GROUPS)
            count = np.bincount(label)
            right = np.zeros((self._size, len(count), 3))
            for axis in range(3):
                right[self._unknowns[:, axis], label, axis] = 1 / count[label]
            u = self._solver.solve(right.reshape(self._size, -1))[self._unknowns]
            motion = u.reshape(len(label), 3, len(count), 3).transpose(2, 0, 1, 3)
            self._groups = Groups(label, 1 / count, np.ascontiguousarray(motion))
        return self._groups

    def between(self, rows: Array, along: Array, columns: Array, push: Array) -> Array:
        """Motion (k, l) of contact nodes `rows` along (k, 3) under unit forces at nodes `columns` along push (l, 3)."""
        self.require(np.unique(columns))
        return _between(self._blocks, rows, along, self._place[columns], push)

    def apply(self, force: Array) -> Array:
        """Displacements (nc, 3) of all contact nodes under forces (nc, 3), most of them zero."""
        columns = np.flatnonzero(force.any(axis=1))
        self.require(columns)
        return _apply(self._blocks, self._place[columns], force[columns])


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
def _between(blocks: Array, rows: Array, along: Array, columns: Array, push: Array) -> Array:
    result = np.empty((len(columns), len(rows)))
    for j in range(len(columns)):
        block = blocks[columns[j]]
        for i in range(len(rows)):
            c = block[rows[i]]
            total = 0.0
            for a in range(3):
                total += along[i, a] * (c[a, 0] * push[j, 0] + c[a, 1] * push[j, 1] + c[a, 2] * push[j, 2])
            result[j, i] = total
    return result.T


@njit(cache=True)
def _apply(blocks: Array, columns: Array, force: Array) -> Array:
    u = np.zeros((blocks.shape[1], 3))
    width = 128
    for chunk in range((blocks.shape[1] + width - 1) // width):
        last = min((chunk + 1) * width, blocks.shape[1])
        for j in range(len(columns)):
            x, y, z = force[j, 0], force[j, 1], force[j, 2]
            block = blocks[columns[j]]
            for i in range(chunk * width, last):
                c = block[i]
                for a in range(3):
                    u[i, a] += c[a, 0] * x + c[a, 1] * y + c[a, 2] * z
    return u
