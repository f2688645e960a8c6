"""Smallest energy by limited-memory quasi-Newton steps in a fixed metric.

Ref: Liu 2017 (quasi-Newton steps in the metric of a Laplacian).
"""

from __future__ import annotations

from enum import Enum
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


class Status(Enum):
    """How the search for equilibrium ended."""

    CONVERGED = "The out-of-balance force fell below its limit."
    STALLED = "The energy stopped falling before the out-of-balance force was below its limit."
    STEPS = "The allowed steps were used up."


class Metric(Protocol):
    """A factorized positive matrix."""

    def solve(self, rhs: Array) -> Array:
        """Its inverse times `rhs` (n, 3)."""
        ...


class Problem(Protocol):
    """An energy of coefficients (n, 3), and the metric that its steps are measured in."""

    metric: Metric

    def energy(self, u: Array) -> tuple[float, Array]:
        """Energy and gradient (n, 3)."""
        ...


def minimize(
    problem: Problem, u: Array, first_force: float | None, steps: int = 150, limit: float = 1e-2
) -> tuple[Array, Status, Array]:
    """Limited-memory BFGS until the force, the metric's norm of the next step, is `limit` of the first; where it ended,
    why, and the force of every step. first_force: of an earlier search to measure this one by.

    Raises ValueError where the energy of the start is not finite.
    """
    value, gradient = problem.energy(u)
    if not np.isfinite(value):
        raise ValueError("the lung is folded at the start, reduce the motion of the cage")
    memory: list[tuple[Array, Array, float]] = []
    history: list[float] = []
    while len(history) < steps:
        step = _two_loop(problem, gradient, memory)
        slope = float((step * gradient).sum())
        history.append(float(np.sqrt(max(-slope, 0.0))))
        if history[-1] <= limit * (first_force or history[0]):
            return u, Status.CONVERGED, np.array(history)
        t, found = 1.0, problem.energy(u + step)
        while found[0] > value + 1e-4 * t * slope and t > 1e-3:
            t *= 0.4
            found = problem.energy(u + t * step)
        if found[0] >= value:
            if not memory:
                return u, Status.STALLED, np.array(history)
            memory = []
            continue
        y, s = found[1] - gradient, t * step
        curvature = float((y * s).sum())
        if curvature > 0:
            memory = [*memory[-11:], (s, y, curvature)]
        u, (value, gradient) = u + s, found
    return u, Status.STEPS, np.array(history)


def _two_loop(problem: Problem, gradient: Array, memory: list[tuple[Array, Array, float]]) -> Array:
    q = gradient.copy()
    shares = []
    for s, y, sy in reversed(memory):
        a = float((s * q).sum()) / sy
        q -= a * y
        shares.append(a)
    d = problem.metric.solve(q)
    for (s, y, sy), a in zip(memory, reversed(shares), strict=True):
        d += (a - float((y * d).sum()) / sy) * s
    return -d
