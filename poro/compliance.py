"""Displacements of contact nodes under unit forces at contact nodes, computed when first asked for."""

from __future__ import annotations

import numpy as np
from numba import njit

from poro.mesh.tetmesh import Array
from poro.solver import LinearSolver


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

    def between(self, rows: Array, along: Array, columns: Array, push: Array) -> Array:
        """Motion (k, l) of contact nodes `rows` along (k, 3) under unit forces at nodes `columns` along push (l, 3)."""
        self.require(np.unique(columns))
        return _between(self._blocks, rows, along, self._place[columns], push)

    def apply(self, force: Array) -> Array:
        """Displacements (nc, 3) of all contact nodes under forces (nc, 3), most of them zero."""
        columns = np.flatnonzero(force.any(axis=1))
        self.require(columns)
        return _apply(self._blocks, self._place[columns], force[columns])


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
