"""Gauss-Newton with truncated conjugate gradients and backtracking."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np

from registration.terms.objective import Model, Term
from registration.volume import Array


class Stop(Enum):
    """Why an optimization ended."""

    CONVERGED = "the last step changed the objective by less than the tolerance"
    SMALL_STEP = "the last step moved every control point by less than the tolerance"
    ITERATIONS = "the allowed number of steps was used up"
    NO_DESCENT = "no step along the Gauss-Newton direction lowered the objective"


@dataclass(frozen=True)
class Descent:
    """coefficients: (3, ni, nj, nk), mm; history: objective before each step and at the end."""

    coefficients: Array
    stop: Stop
    history: tuple[float, ...]


def gauss_newton(
    objective: Term,
    start: Array,
    steps: int = 15,
    tolerance: float = 1e-3,
    step_mm: float = 0.02,
    residual: float = 0.1,
    refresh: Callable[[Array], None] | None = None,
) -> Descent:
    """Minimize the objective from `start` (3, ni, nj, nk).

    Stops when a step lowers the objective by less than `tolerance` of itself, moves no control point by more than
    `step_mm`, or after `steps` steps. Each direction solves H d = -g by Jacobi-preconditioned conjugate gradients to a
    relative residual `residual` or 40 iterations; the step is halved until Armijo's condition (1e-4) holds. refresh:
    called with c before each step, to reset what the objective holds fixed during a step.
    """
    c: Array = start.astype(np.float32)
    history: list[float] = []
    for _ in range(steps):
        if refresh is not None:
            refresh(c)
        model = objective.model(c)
        value = model.value
        history.append(value)
        d = conjugate_gradients(model, residual)
        slope = float(np.vdot(model.gradient, d))
        scale, trial, new = 1.0, c + d, objective.value(c + d)
        while new > value + 1e-4 * scale * slope and scale > 0.02:
            scale /= 2
            trial = c + np.float32(scale) * d
            new = objective.value(trial)
        if new >= value:
            return Descent(c, Stop.NO_DESCENT, (*history,))
        c = trial
        if value - new < tolerance * abs(value):
            return Descent(c, Stop.CONVERGED, (*history, new))
        if scale * np.abs(d).max() < step_mm:
            return Descent(c, Stop.SMALL_STEP, (*history, new))
    return Descent(c, Stop.ITERATIONS, (*history, new))


def conjugate_gradients(model: Model, tolerance: float = 0.1, iterations: int = 40) -> Array:
    """Solve H d = -gradient to the relative residual `tolerance`, Jacobi-preconditioned, in float32."""
    right = -model.gradient.astype(np.float32)
    diagonal = model.diagonal
    inverse = (1 / np.maximum(diagonal, 1e-3 * diagonal.max())).astype(np.float32)
    x, r = np.zeros_like(right), right.copy()
    z = inverse * r
    p, rz = z.copy(), float(np.vdot(r, z))
    limit = tolerance * float(np.linalg.norm(right))
    for _ in range(iterations):
        if np.linalg.norm(r) <= limit:
            break
        hp = model.apply(p)
        alpha = np.float32(rz / max(float(np.vdot(p, hp)), 1e-30))
        x += alpha * p
        r -= alpha * hp
        z = inverse * r
        rz, old = float(np.vdot(r, z)), rz
        p = z + np.float32(rz / old) * p
    return x
