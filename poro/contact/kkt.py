"""Factor of the Karush-Kuhn-Tucker system of one linearized contact: normal forces and geometric stiffness.

Ref: Nocedal & Wright 2006, sec. 16.2 (Schur-complement method).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import get_lapack_funcs, lu_factor, lu_solve, solve_triangular

from poro.arrays import Array
from poro.errors import SolverError


@dataclass(frozen=True)
class KktFactor:
    """Factor of [[A, K], [K^T, S]], A (k, k) the compliance of contact nodes along their normals, S (r, r) that of the
    geometric stiffness, in A's precision. upper: Cholesky factor of A; half: (k, r) upper^-T K; schur: LU of
    S - K^T A^-1 K.
    """

    upper: Array
    half: Array
    schur: tuple[Array, Array]

    def solve(self, right: Array) -> Array:
        """Solutions (k + r, m) for right-hand sides of that shape."""
        count, own = len(self.upper), self.upper.dtype
        y = solve_triangular(self.upper, right[:count].astype(own, copy=False), trans=1, check_finite=False)
        turning = right[count:] - self.half.T @ y
        if len(turning):
            turning = lu_solve(self.schur, turning, check_finite=False)
        normal = solve_triangular(self.upper, y - self.half @ turning.astype(own), check_finite=False)
        return np.concatenate([normal, turning])


def kkt_factor(matrix: Array, coupling: Array, stiffness_compliance: Array, dtype: np.dtype) -> KktFactor:
    """Factor contact nodes' compliance (k, k), their coupling (k, r) to the geometric stiffness and the compliance
    (r, r) of that, as `dtype`.

    Raises SolverError where two contact nodes move alike.
    """
    (factorize,) = get_lapack_funcs(("potrf",), dtype=dtype)
    upper, failed = factorize(matrix.T.astype(dtype, copy=False), clean=0)
    if failed:
        raise SolverError(f"contact nodes {failed - 1} and an earlier one move alike; the compliance is singular")
    half = solve_triangular(upper, coupling.astype(dtype, copy=False), trans=1, check_finite=False)
    schur = stiffness_compliance - half.T @ half
    return KktFactor(upper, half, lu_factor(schur, check_finite=False) if len(schur) else (schur, schur))
