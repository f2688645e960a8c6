"""One linear solver for elasticity and flow: dense-front Cholesky, or smoothed aggregation when the factor is too
large.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import pyamg
from pyamg.util.utils import get_block_diag
from scipy.sparse import bsr_matrix, csr_matrix
from scipy.sparse.linalg import LinearOperator, cg

from poro.arrays import Array
from poro.errors import SolverError
from poro.linalg.cholesky import Cholesky, cholesky
from poro.linalg.dissection import Tree, dissect
from poro.linalg.relaxation import BLOCK, backward, forward_from_zero

# Numbers in a factor above which memory (8 bytes each) decides for the iterative solver.
FACTOR_LIMIT = 150_000_000
ONCE_LIMIT = 10_000_000  # the same for one right-hand side: beyond it multigrid takes less time, half at 23 million
ONCE_TOLERANCE = 1e-7  # of that: displacements of 3 mm are then right to 0.00001 mm
MAX_ITERATIONS = 200  # of multigrid
MAX_STEPS = 30  # of conjugate gradients behind a factor in single precision; usually three


class LinearSolver(Protocol):
    """Anything that solves for one (n,) or many (n, k) right-hand sides."""

    def solve(self, right: Array) -> Array:
        """Solution of the shape of `right`."""
        ...


@dataclass(frozen=True)
class Multigrid:
    """Conjugate gradients preconditioned by one V-cycle of smoothed aggregation; stops at a relative residual of
    `tolerance`.

    inverses: (n, 3, 3) of the diagonal's blocks where the matrix has three unknowns a node, None where it has one;
    residuals: norms of the last right-hand side's iterations, the first before any.
    """

    matrix: bsr_matrix
    hierarchy: Any
    inverses: Array | None
    tolerance: float = 1e-10
    residuals: list[float] = field(default_factory=list)

    def solve(self, right: Array) -> Array:
        """Solution of the shape of `right`; raises SolverError when MAX_ITERATIONS do not suffice."""
        columns = [self._solve_one(b) for b in np.atleast_2d(right.T)]
        return columns[0] if right.ndim == 1 else np.stack(columns, axis=1)

    def _solve_one(self, right: Array) -> Array:
        if not right.any():
            return np.zeros_like(right)
        self.residuals.clear()
        cycle = LinearOperator(self.matrix.shape, matvec=self._cycle, dtype=float)
        x, info = pyamg.krylov.cg(
            self.matrix, right, tol=self.tolerance, maxiter=MAX_ITERATIONS, M=cycle, residuals=self.residuals
        )
        if info:
            relative = tuple(float(r / self.residuals[0]) for r in self.residuals)
            raise SolverError(
                f"multigrid stopped at a relative residual of {relative[-1]:.1e} after {MAX_ITERATIONS} iterations",
                relative,
            )
        return np.asarray(x)

    def _cycle(self, right: Array) -> Array:
        """A V-cycle from zero. PyAMG's own also computes the residual before and after, as dear as its smoothing."""
        *levels, coarsest = self.hierarchy.levels
        rights, guesses = [right], []
        for level in levels:
            guess, left = self._smoothed(level, rights[-1])
            guesses.append(guess)
            rights.append(level.R @ left)
        x = self.hierarchy.coarse_solver(coarsest.A, rights.pop())
        for level, guess, b in zip(reversed(levels), reversed(guesses), reversed(rights), strict=True):
            x = guess + level.P @ x
            if self.inverses is not None and level is levels[0]:
                backward(level.A, self.inverses, b, x)
            else:
                level.postsmoother(level.A, x, b)
        return np.asarray(x)

    def _smoothed(self, level: Any, right: Array) -> tuple[Array, Array]:
        """A sweep from zero on a level, and the residual that it leaves."""
        if self.inverses is not None and level is self.hierarchy.levels[0]:
            return forward_from_zero(level.A, self.inverses, right)
        guess = np.zeros_like(right)
        level.presmoother(level.A, guess, right)
        return guess, right - level.A @ guess


@dataclass(frozen=True)
class SingleFactor:
    """Conjugate gradients preconditioned by a Cholesky factor in single precision: half the time of a factor in double
    precision where it serves one right-hand side. Stops at a relative residual of `tolerance`.
    """

    matrix: csr_matrix
    factor: Cholesky
    tolerance: float = 1e-12

    def solve(self, right: Array) -> Array:
        """Solution of the shape of `right`; raises SolverError when MAX_STEPS do not suffice."""
        columns = [self._solve_one(b) for b in np.atleast_2d(right.T)]
        return columns[0] if right.ndim == 1 else np.stack(columns, axis=1)

    def _solve_one(self, right: Array) -> Array:
        preconditioner = LinearOperator(self.matrix.shape, matvec=self.factor.solve, dtype=float)
        x, info = cg(self.matrix, right, rtol=self.tolerance, atol=0.0, maxiter=MAX_STEPS, M=preconditioner)
        if info:
            raise SolverError(f"a factor in single precision did not lead to {self.tolerance:g} in {MAX_STEPS} steps")
        return np.asarray(x)


def rigid_body_modes(points: Array) -> Array:
    """Three translations and three rotations at points (n, 3), as columns (3n, 6)."""
    modes = np.zeros((len(points), 3, 6))
    modes[:, :, :3] = np.eye(3)
    centred = points - points.mean(axis=0)
    for axis in range(3):
        modes[:, :, 3 + axis] = np.cross(np.eye(3)[axis], centred)
    return modes.reshape(-1, 6)


def elimination_tree(matrix: csr_matrix, points: Array) -> Tree:
    """Order in which a matrix with 1 or 3 unknowns at each of points (n, 3) is eliminated."""
    block = matrix.shape[0] // len(points)
    return dissect(_node_graph(matrix, block), points, 96 if block == 1 else 40)


def linear_solver(
    matrix: csr_matrix, points: Array, tree: Tree | None = None, limit: int = FACTOR_LIMIT
) -> LinearSolver:
    """Solver of a symmetric positive definite matrix with 1 or 3 unknowns at each of points (n, 3); chosen by size.

    tree: of an earlier matrix with the same entries, to save its making.
    """
    block = matrix.shape[0] // len(points)
    tree = tree or elimination_tree(matrix, points)
    return cholesky(matrix, tree, block) if tree.factor_entries(block) <= limit else multigrid(matrix, points)


def multigrid(matrix: csr_matrix, points: Array, tolerance: float = 1e-10) -> Multigrid:
    """Smoothed aggregation for a matrix as of `linear_solver`. Ref: Vanek 1996.

    Prolongations are smoothed by local weights: the usual estimate of the spectral radius begins at random. The rigid
    body modes are taken as they are: relaxing them first triples the time of the set-up and saves no iteration.
    """
    block = matrix.shape[0] // len(points)
    near_null = rigid_body_modes(points) if block == 3 else np.ones((len(points), 1))
    blocked = bsr_matrix(matrix, blocksize=(block, block))
    hierarchy = pyamg.smoothed_aggregation_solver(
        blocked,
        B=near_null,
        strength=("symmetric", {"theta": 0.0}),
        smooth=("jacobi", {"omega": 4 / 3, "weighting": "local"}),
        improve_candidates=None,
        presmoother=("block_gauss_seidel", {"sweep": "forward"}),
        postsmoother=("block_gauss_seidel", {"sweep": "backward"}),  # the other way, or the cycle is not symmetric
        max_coarse=300,
        coarse_solver="splu",  # PyAMG's own choice, a pseudo-inverse, takes longer than all the rest
    )
    finest = hierarchy.levels[0].A
    inverses = get_block_diag(finest, BLOCK, inv_flag=True) if block == BLOCK else None
    return Multigrid(blocked, hierarchy, inverses, tolerance)


@dataclass(frozen=True)
class ForFew:
    """Solver of a matrix as of `linear_solver`, in less time than that takes for one right-hand side or a few.

    quick: None where the matrix is too ill-conditioned for it; where that shows later, an exact factor answers too.
    """

    matrix: csr_matrix
    points: Array
    tree: Tree
    quick: LinearSolver | None

    def solve(self, right: Array) -> Array:
        """Solution of the shape of `right`."""
        if self.quick is not None:
            try:
                return self.quick.solve(right)
            except SolverError:
                pass
        return linear_solver(self.matrix, self.points, self.tree).solve(right)


def solver_for_few(
    matrix: csr_matrix, points: Array, tree: Tree | None = None, tolerance: float = ONCE_TOLERANCE
) -> ForFew:
    """Solver of a symmetric positive definite matrix for few right-hand sides, to a relative residual of `tolerance`
    where that is multigrid's; matrix and tree as of `linear_solver`.
    """
    block = matrix.shape[0] // len(points)
    tree = tree or elimination_tree(matrix, points)
    quick: LinearSolver | None
    try:
        if tree.factor_entries(block) > ONCE_LIMIT:
            quick = multigrid(matrix, points, tolerance)
        else:
            quick = SingleFactor(matrix, cholesky(matrix, tree, block, np.float32))
    except SolverError:
        quick = None
    return ForFew(matrix, points, tree, quick)


BATCH = 384
"""Right-hand sides that are solved together."""


def inverse_at(solver: LinearSolver, unknowns: Array, size: int, dtype: type) -> Array:
    """Rows and columns (k, k) of type `dtype` of the inverse of a matrix of `size` unknowns at distinct ones (k,)."""
    if isinstance(solver, Cholesky):
        return solver.inverse_at(unknowns, dtype)
    result: Array = np.empty((len(unknowns), len(unknowns)), dtype)
    for first in range(0, len(unknowns), BATCH):
        chunk = unknowns[first : first + BATCH]
        right = np.zeros((size, len(chunk)))
        right[chunk, np.arange(len(chunk))] = 1
        result[:, first : first + BATCH] = solver.solve(right)[unknowns]
    return result


def _node_graph(matrix: csr_matrix, block: int) -> csr_matrix:
    """Which nodes share an entry."""
    if block == 1:
        return matrix
    pairs = bsr_matrix(matrix, blocksize=(block, block))
    n = matrix.shape[0] // block
    return csr_matrix((np.ones(len(pairs.indices)), pairs.indices, pairs.indptr), shape=(n, n))
