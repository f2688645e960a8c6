"""Multifrontal Cholesky factorization of node-blocked matrices, dense products throughout. Ref: Duff & Reid 1983."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from scipy.linalg import blas, lapack
from scipy.sparse import csr_matrix

from poro.arrays import Array
from poro.errors import SolverError
from poro.linalg.dissection import Front, Tree

STRIP = 512  # rows of an inverse that are added at a time, to keep what is in between small


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
        order, spans, rows = self._order, self._spans, self._borders
        y = np.asarray(right, self.diagonal_inverse[0].dtype)[order]
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

    def inverse_at(self, unknowns: Array, dtype: type = np.float64) -> Array:
        """The inverse's rows and columns of distinct unknowns (k,), (k, k), computed and kept as `dtype`.

        A unit load reaches only the fronts above it, so that it costs a fraction of k solutions.
        """
        place = np.empty(self.size, np.int64)
        place[self._order] = np.arange(self.size)
        rank = np.argsort(place[unknowns])
        inner = place[unknowns][rank]
        result: Array = np.zeros((len(inner), len(inner)), dtype)
        spread: list[tuple[int, Array]] = []  # first column and rows below the front of the forward solution
        for front, span, border, inverse, below in zip(
            self.tree.fronts, self._spans, self._borders, self.diagonal_inverse, self.below, strict=True
        ):
            own = span.stop - span.start
            first, last = np.searchsorted(inner, [span.start, span.stop])
            start = min([first, *(spread[c][0] for c in front.children)])
            x = np.zeros((own + len(border), last - start), dtype)
            x[inner[first:last] - span.start, np.arange(first, last) - start] = 1
            rows = np.concatenate([np.arange(span.start, span.stop), border])
            for child in front.children:
                column, update = spread[child]
                x[np.searchsorted(rows, self._borders[child]), column - start : column - start + update.shape[1]] += (
                    update
                )
                spread[child] = (column, np.empty((0, 0), dtype))
            w: Array = inverse.astype(dtype, copy=False) @ x[:own]
            for top in range(start, last, STRIP):
                end = min(top + STRIP, last)
                result[top:end, start:end] += w[:, top - start : end - start].T @ w[:, : end - start]
            spread.append((start, x[own:] - below.astype(dtype, copy=False) @ w))
        back = np.empty_like(rank)
        back[rank] = np.arange(len(rank))
        _mirror(result)
        _reorder(result, back)
        return result

    @cached_property
    def _order(self) -> Array:
        return _unknowns(self.tree.order, self.block)

    @cached_property
    def _spans(self) -> list[slice]:
        return [slice(f.first * self.block, f.last * self.block) for f in self.tree.fronts]

    @cached_property
    def _borders(self) -> list[Array]:
        return [_unknowns(f.border, self.block) for f in self.tree.fronts]


def cholesky(matrix: csr_matrix, tree: Tree, block: int, dtype: type = np.float64) -> Cholesky:
    """Factor a symmetric positive definite matrix (n * block, n * block) along an elimination tree, in double or single
    precision.

    Raises SolverError when a pivot is not positive, that is when the body can still move freely.
    """
    order = _unknowns(tree.order, block)
    permuted = csr_matrix(matrix, dtype=dtype)[order][:, order]
    potrf, trtri = lapack.get_lapack_funcs(("potrf", "trtri"), dtype=dtype)
    syrk = blas.get_blas_funcs("syrk", dtype=dtype)
    pending: list[Array | None] = []
    inverses, belows = [], []
    for front in tree.fronts:
        dense = _assemble(permuted, tree, front, block, pending)
        n = (front.last - front.first) * block
        lower, info = potrf(dense[:n, :n], lower=1)
        if info:
            raise SolverError("matrix is not positive definite; the body can move freely, fix at least three nodes")
        inverse, _ = trtri(lower, lower=1)
        inverse = np.ascontiguousarray(np.tril(inverse))
        below = dense[n:, :n] @ inverse.T
        inverses.append(inverse)
        belows.append(below)
        rest = dense[n:, n:].copy()
        if len(rest):
            syrk(-1, below.T, beta=1, c=rest.T, trans=1, overwrite_c=1)
        pending.append(rest)
        for child in front.children:
            pending[child] = None
    return Cholesky(tree, block, tuple(inverses), tuple(belows))


def _assemble(permuted: csr_matrix, tree: Tree, front: Front, block: int, pending: list[Array | None]) -> Array:
    """The front's dense matrix, lower triangle: its own rows of the matrix plus what its children left over."""
    start, stop = front.first * block, front.last * block
    border = _unknowns(front.border, block)
    unknowns = np.concatenate([np.arange(start, stop), border])
    dense = np.zeros((len(unknowns), len(unknowns)), permuted.dtype)
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
            _add_lower(dense, update, place)
    return dense


@njit(cache=True)
def _add_lower(dense: Array, update: Array, place: Array) -> None:
    """Add the lower triangle of an update at increasing places."""
    for i in range(len(place)):
        row = dense[place[i]]
        for j in range(i + 1):
            row[place[j]] += update[i, j]


def _unknowns(nodes: Array, block: int) -> Array:
    return (np.asarray(nodes)[:, None] * block + np.arange(block)).ravel()


@njit(cache=True)
def _mirror(matrix: Array) -> None:
    """Copy the lower triangle of a square matrix onto the upper one, by tiles, which stay in the cache."""
    tile = 64
    for top in range(0, len(matrix), tile):
        for left in range(0, top + tile, tile):
            for i in range(top, min(top + tile, len(matrix))):
                for j in range(left, min(left + tile, i)):
                    matrix[j, i] = matrix[i, j]


@njit(cache=True)
def _copy(row: Array, to: Array) -> None:
    """to[:] = row, which numba takes four times as long to compile: it prepares a message of what does not fit."""
    for j in range(len(row)):
        to[j] = row[j]


@njit(cache=True)
def _reorder(matrix: Array, source: Array) -> None:
    """matrix[source][:, source] in place of a square matrix."""
    row = np.empty_like(matrix[0])
    for i in range(len(matrix)):
        _copy(matrix[i], row)
        for j in range(len(row)):
            matrix[i, j] = row[source[j]]
    moved = np.zeros(len(matrix), np.bool_)
    for first in range(len(matrix)):
        if not moved[first]:
            _copy(matrix[first], row)
            i = first
            while source[i] != first:
                _copy(matrix[source[i]], matrix[i])
                moved[i] = True
                i = source[i]
            _copy(row, matrix[i])
            moved[i] = True
