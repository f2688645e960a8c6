"""Multifrontal Cholesky factorization of node-blocked matrices, dense products throughout. Ref: Duff & Reid 1983."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack
from scipy.sparse import csr_matrix

from poro.dissection import Front, Tree
from poro.mesh.tetmesh import Array


@dataclass(frozen=True)
class Cholesky:
    """Factor of a symmetric positive definite matrix whose unknowns come in blocks per node."""

    tree: Tree
    block: int
    diagonal_inverse: tuple[Array, ...]
    below: tuple[Array, ...]

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(self.tree.order) * self.block

    def solve(self, right: Array) -> Array:
        """Solutions for one (n,) or many (n, k) right-hand sides."""
        if len(right) != self.size:
            raise ValueError(f"right-hand side must have {self.size} rows, got {len(right)}")
        order = _unknowns(self.tree.order, self.block)
        y = np.asarray(right, float)[order]
        rows = [_unknowns(f.border, self.block) for f in self.tree.fronts]
        spans = [slice(f.first * self.block, f.last * self.block) for f in self.tree.fronts]
        for span, border, inverse, below in zip(spans, rows, self.diagonal_inverse, self.below, strict=True):
            y[span] = inverse @ y[span]
            if len(border):
                y[border] -= below @ y[span]
        for span, border, inverse, below in zip(
            spans[::-1], rows[::-1], self.diagonal_inverse[::-1], self.below[::-1], strict=True
        ):
            if len(border):
                y[span] -= below.T @ y[border]
            y[span] = inverse.T @ y[span]
        solution = np.empty_like(y)
        solution[order] = y
        return solution


def cholesky(matrix: csr_matrix, tree: Tree, block: int) -> Cholesky:
    """Factor a symmetric positive definite matrix (n * block, n * block) along an elimination tree.

    Raises ValueError when a pivot is not positive, that is when the body can still move freely.
    """
    order = _unknowns(tree.order, block)
    permuted = csr_matrix(matrix)[order][:, order]
    pending: list[Array | None] = []
    inverses, belows = [], []
    for front in tree.fronts:
        dense = _assemble(permuted, tree, front, block, pending)
        n = (front.last - front.first) * block
        lower, info = lapack.dpotrf(dense[:n, :n], lower=1)
        if info:
            raise ValueError("matrix is not positive definite; the body can move freely, fix at least three nodes")
        inverse, _ = lapack.dtrtri(lower, lower=1)
        inverse = np.ascontiguousarray(np.tril(inverse))
        below = dense[n:, :n] @ inverse.T
        inverses.append(inverse)
        belows.append(below)
        pending.append(dense[n:, n:] - below @ below.T)
        for child in front.children:
            pending[child] = None
    return Cholesky(tree, block, tuple(inverses), tuple(belows))


def _assemble(permuted: csr_matrix, tree: Tree, front: Front, block: int, pending: list[Array | None]) -> Array:
    """The front's dense matrix: its own rows of the matrix plus what its children left over."""
    start, stop = front.first * block, front.last * block
    border = _unknowns(front.border, block)
    unknowns = np.concatenate([np.arange(start, stop), border])
    dense = np.zeros((len(unknowns), len(unknowns)))
    span = slice(permuted.indptr[start], permuted.indptr[stop])
    column, value = permuted.indices[span], permuted.data[span]
    row = np.repeat(np.arange(stop - start), np.diff(permuted.indptr[start : stop + 1]))
    later = column >= start
    local = np.searchsorted(unknowns, column[later])
    dense[local, row[later]] = value[later]
    for child in front.children:
        update = pending[child]
        if update is not None and len(update):
            place = np.searchsorted(unknowns, _unknowns(tree.fronts[child].border, block))
            dense[np.ix_(place, place)] += update
    return dense


def _unknowns(nodes: Array, block: int) -> Array:
    return (np.asarray(nodes)[:, None] * block + np.arange(block)).ravel()
