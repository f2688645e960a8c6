"""Factor of the contact forces and wall springs of one linearized wall, which outlives small changes of the active set.

Ref: Nocedal & Wright 2006, sec. 16.2 (Schur-complement method); Gill et al. 1987 (bordering a factor that is kept).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import get_lapack_funcs, lu_factor, lu_solve, solve_triangular

from poro.contact.compliance import Compliance
from poro.contact.geometric_stiffness import Springs
from poro.mesh.tetmesh import Array


@dataclass(frozen=True)
class Saddle:
    """Factor of [[A, K], [K^T, S]], A (k, k) the compliance of contact nodes, S (r, r) that of springs, in A's
    precision. upper: Cholesky factor of A; half: (k, r) upper^-T K; schur: LU of S - K^T A^-1 K.
    """

    upper: Array
    half: Array
    schur: tuple[Array, Array]

    def solve(self, right: Array) -> Array:
        """Solutions (k + r, m) for right-hand sides of that shape."""
        count, own = len(self.upper), self.upper.dtype
        y = solve_triangular(self.upper, right[:count].astype(own, copy=False), trans=1, check_finite=False)
        pull = right[count:] - self.half.T @ y
        if len(pull):
            pull = lu_solve(self.schur, pull, check_finite=False)
        push = solve_triangular(self.upper, y - self.half @ pull.astype(own), check_finite=False)
        return np.concatenate([push, pull])


def saddle(matrix: Array, coupling: Array, stretch: Array, dtype: np.dtype) -> Saddle:
    """Factor contact nodes' compliance (k, k), their coupling (k, r) to springs and the springs' (r, r), as `dtype`.

    Raises ValueError where two contact nodes move alike.
    """
    (factorize,) = get_lapack_funcs(("potrf",), dtype=dtype)
    upper, failed = factorize(matrix.T.astype(dtype, copy=False), clean=0)
    if failed:
        raise ValueError(f"contact nodes {failed - 1} and an earlier one move alike; the compliance is singular")
    half = solve_triangular(upper, coupling.astype(dtype, copy=False), trans=1, check_finite=False)
    schur = stretch - half.T @ half
    return Saddle(upper, half, lu_factor(schur, check_finite=False) if len(schur) else (schur, schur))


@dataclass(frozen=True)
class KeptWall:
    """Linearized wall at one active set. pool: (k,) its nodes; normal: (k, 3); springs, factor: of that wall."""

    pool: Array
    normal: Array
    springs: Springs
    factor: Saddle

    def flips(self, active: Array) -> int:
        """Nodes in which the active set (nc,) bool differs from the wall's own."""
        return int(active.sum() + len(self.pool) - 2 * active[self.pool].sum())

    def change(
        self, compliance: Compliance, active: Array, normal: Array, force: Array, left: tuple[Array, Array]
    ) -> tuple[Array, Array]:
        """Change of the normal forces (nc,) and the springs' forces (r,) that close the gaps and stretches `left` over,
        (nc,) and (r,), at an active set (nc,) bool of nodes of normals (nc, 3) under forces (nc,).

        Nodes that have left the wall's set are held at no force, those that came are bordered to its factor.
        """
        gap, stretch = left
        count = len(self.pool)
        inside = np.zeros(len(active), bool)
        inside[self.pool] = True
        gone, come = np.flatnonzero(inside & ~active), np.flatnonzero(active & ~inside)
        right = -np.concatenate([gap[self.pool], stretch])
        border = np.zeros((len(right), len(come) + len(gone)))
        if len(come):
            border[:count, : len(come)] = -compliance.across(self.pool, self.normal, come, normal[come])
            border[count:, : len(come)] = -self.springs.along_normals(come, normal[come]).T
        border[np.searchsorted(self.pool, gone), len(come) + np.arange(len(gone))] = 1
        solved = self.factor.solve(np.column_stack([right, border]))
        x, by_border = solved[:, 0], solved[:, 1:]
        change = np.zeros(len(active))
        if border.shape[1]:
            small = border.T @ by_border
            small[: len(come), : len(come)] -= compliance.between(come, normal[come])
            wanted = np.concatenate([gap[come], -force[gone]]) - border.T @ x
            extra = np.linalg.solve(small, wanted)
            x = x + by_border @ extra
            change[come] = extra[: len(come)]
        change[self.pool] = x[:count]
        change[gone] = -force[gone]
        return change, x[count:]
