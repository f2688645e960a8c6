"""Gauss-Newton with truncated conjugate gradients and backtracking."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np

from registration.terms.objective import QuadraticModel, Term
from registration.volume import Array


class Stop(Enum):
    """Why an optimization ended."""

    CONVERGED = "the last step changed the objective by less than the tolerance"
    SMALL_STEP = "the last step moved every control point by less than the tolerance"
    ITERATIONS = "the allowed number of steps was used up"
    NO_DESCENT = "no step along the Gauss-Newton direction lowered the objective"


class SolveStatus(Enum):
    """Why conjugate gradients ended."""

    SOLVED = "the residual fell to the tolerance"
    ITERATIONS = "the allowed number of iterations was used up"
    NEGATIVE_CURVATURE = "the Hessian is not positive definite along a search direction; the step so far is kept"


@dataclass(frozen=True)
class Solve:
    """step: (3, ni, nj, nk), mm; residuals: |H d + g| / |g| before each iteration and at the end."""

    step: Array
    status: SolveStatus
    residuals: tuple[float, ...]


@dataclass(frozen=True)
class Descent:
    """coefficients: (3, ni, nj, nk), mm; history: objective before each step and at the end; solves: status and
    relative residuals of the conjugate gradients of each step.
    """

    coefficients: Array
    stop: Stop
    history: tuple[float, ...]
    solves: tuple[tuple[SolveStatus, tuple[float, ...]], ...]


LEAST_GAIN = 1e-3
"""Share of the objective that a step has to lower it by."""
LEAST_STEP_MM = 0.02
"""A step that moves no control point by more is the last one."""


def gauss_newton(
    objective: Term,
    start: Array,
    steps: int = 15,
    residual: float = 0.1,
    refresh: Callable[[Array], None] | None = None,
) -> Descent:
    """Minimize the objective from `start` (3, ni, nj, nk).

    Stops when a step lowers the objective by less than `LEAST_GAIN` of itself, moves no control point by more than
    `LEAST_STEP_MM`, or after `steps` steps. Each direction solves H d = -g by Jacobi-preconditioned conjugate
    gradients to a relative residual `residual` or 40 iterations; the step is halved until Armijo's condition (1e-4)
    holds. refresh: called with c before each step, to reset what the objective holds fixed during a step.
    """
    c: Array = start.astype(np.float32)
    history: list[float] = []
    solves: list[tuple[SolveStatus, tuple[float, ...]]] = []

    def ended(at: Array, stop: Stop, *last: float) -> Descent:
        return Descent(at, stop, (*history, *last), tuple(solves))

    for _ in range(steps):
        if refresh is not None:
            refresh(c)
        model = objective.model(c)
        value = model.value
        history.append(value)
        solve = conjugate_gradients(model, residual)
        solves.append((solve.status, solve.residuals))
        d = solve.step
        slope = float(np.vdot(model.gradient, d))
        scale, trial, new = 1.0, c + d, objective.value(c + d)
        while new > value + 1e-4 * scale * slope and scale > 0.02:
            scale /= 2
            trial = c + np.float32(scale) * d
            new = objective.value(trial)
        if new >= value:
            return ended(c, Stop.NO_DESCENT)
        c = trial
        if value - new < LEAST_GAIN * abs(value):
            return ended(c, Stop.CONVERGED, new)
        if scale * np.abs(d).max() < LEAST_STEP_MM:
            return ended(c, Stop.SMALL_STEP, new)
    return ended(c, Stop.ITERATIONS, new)


def conjugate_gradients(model: QuadraticModel, tolerance: float = 0.1, iterations: int = 40) -> Solve:
    """Solve H d = -gradient to the relative residual `tolerance`, Jacobi-preconditioned, in float32.

    Where H turns out not to be positive definite, the step so far is the answer, the preconditioned gradient if there
    was none. Ref: Steihaug 1983.
    """
    right = -model.gradient.astype(np.float32)
    diagonal = model.diagonal
    inverse = (1 / np.maximum(diagonal, 1e-3 * diagonal.max())).astype(np.float32)
    x, r = np.zeros_like(right), right.copy()
    z = inverse * r
    p, rz = z.copy(), float(np.vdot(r, z))
    whole = float(np.linalg.norm(right))
    limit, residuals = tolerance * whole, []
    for done in range(iterations + 1):
        left = np.linalg.norm(r)
        residuals.append(float(left) / whole if whole else 0.0)
        if left <= limit:
            return Solve(x, SolveStatus.SOLVED, tuple(residuals))
        if done == iterations:
            break
        hp = model.apply(p)
        curvature = float(np.vdot(p, hp))
        if curvature <= 0:
            return Solve(x if done else p, SolveStatus.NEGATIVE_CURVATURE, tuple(residuals))
        alpha = np.float32(rz / curvature)
        x += alpha * p
        r -= alpha * hp
        z = inverse * r
        rz, old = float(np.vdot(r, z)), rz
        p = z + np.float32(rz / old) * p
    return Solve(x, SolveStatus.ITERATIONS, tuple(residuals))
