"""How a solver says that it has no answer."""

from __future__ import annotations


class SolverError(RuntimeError):
    """A linear solver stopped without an answer: its matrix is not positive definite, or its iterations ran out.

    residuals: relative ones of every iteration, empty where a factorization failed. What has a usable answer that is
    merely not converged says so by a status instead (`PoroStatus`, `FitStatus`, `FiniteStatus`, `ContactStatus`).
    """

    def __init__(self, message: str, residuals: tuple[float, ...] = ()) -> None:
        super().__init__(message)
        self.residuals = residuals
