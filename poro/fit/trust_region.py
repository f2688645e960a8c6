"""Gauss-Newton in a box-shaped trust region, within bounds. Ref: Conn, Gould & Toint 2000 (trust regions)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear

from poro.arrays import Array
from poro.collapse.model import Theta
from poro.collapse.solution import PoroState, PoroStatus, sensitivity, solve, solve_nearby
from poro.fit.problem import FitProblem, bounds

DAMPING = 1e-6  # of the normal equations' diagonal, against directions that no datum sees
SMALLEST = 1e-3  # share of the longest step at which a refused step ends the descent
MOST_UNSETTLED = 4  # trials whose contact does not settle, after which the descent ends: they are the dearest by far


@dataclass(frozen=True)
class FitStep:
    """One accepted or refused trial: cost, share of the longest step that it was allowed, theta as a vector."""

    cost: float
    radius: float
    theta: Array
    accepted: bool


@dataclass(frozen=True)
class Descent:
    """Where one start ended. theta: (3 + k,); converged: whether no step promised or brought enough any more."""

    theta: Array
    state: PoroState
    history: tuple[FitStep, ...]
    converged: bool

    @property
    def cost(self) -> float:
        """At the end."""
        return self.history[-1].cost


def descend(problem: FitProblem, theta: Array) -> Descent:
    """Lower the cost from theta (3 + k,); the box shrinks when a step is refused, and the observations' weights are
    frozen at every accepted state.
    """
    low, high = bounds(problem.system)
    free, scale, tolerance = problem.free, problem.step_scale, problem.settings.tolerance
    theta = np.clip(theta, low, high)
    state = solve(problem.system, Theta.of(theta))
    rows = problem.observer.residuals(state.u)
    cost = problem.cost(rows, problem.whiten(rows), theta)
    radius = 1.0
    history = [FitStep(cost, radius, theta, True)]
    unsettled = 0
    normal, slope = problem.normal_equations(rows, sensitivity(problem.system, state), theta)
    for _ in range(problem.settings.max_steps):
        near = np.maximum(low, theta - radius * scale), np.minimum(high, theta + radius * scale)
        step = bounded_step(normal, slope, theta, *near, free)
        promised = -(slope + 0.5 * normal @ step) @ step
        if promised <= 0.1 * tolerance * cost:
            return Descent(theta, state, tuple(history), True)
        trial_state = solve_nearby(problem.system, Theta.of(theta + step), state)
        trial_rows = problem.observer.residuals(trial_state.u)
        trial_cost = problem.cost(trial_rows, problem.whiten(trial_rows), theta + step)
        settled = trial_state.status is not PoroStatus.NOT_CONVERGED
        accepted = trial_cost < cost and settled
        history.append(FitStep(trial_cost if accepted else cost, radius, theta + step, accepted))
        unsettled += not settled
        if unsettled == MOST_UNSETTLED:
            break
        if not accepted:
            radius = 0.3 * min(radius, float(np.abs(step / scale).max()))
            if radius < SMALLEST:
                return Descent(theta, state, tuple(history), True)
            continue
        gain = (cost - trial_cost) / cost
        theta, state, rows, cost = theta + step, trial_state, trial_rows, trial_cost
        # A step that the whole box cut short says little of what the next one may gain; in a small one all steps are.
        if gain < tolerance and (radius < 1 or (np.abs(step) < 0.99 * scale).all()):
            return Descent(theta, state, tuple(history), True)
        radius = min(1.0, 3 * radius)
        normal, slope = problem.normal_equations(rows, sensitivity(problem.system, state), theta)
    return Descent(theta, state, tuple(history), False)


def bounded_step(normal: Array, slope: Array, theta: Array, low: Array, high: Array, free: Array) -> Array:
    """Gauss-Newton step (k,) that promises most of all within the box low..high; parameters not free stay.

    Ref: Stark & Parker 1995 (bounded-variable least squares).
    """
    damped = normal + DAMPING * np.diag(np.maximum(np.diag(normal), 1e-12 * np.diag(normal).max()))
    step, moving = np.zeros_like(theta), np.flatnonzero(free & (low < high))
    if len(moving):
        unit = 1 / np.sqrt(np.diag(damped)[moving])
        factor = np.linalg.cholesky(damped[np.ix_(moving, moving)] * unit[:, None] * unit)
        sides = ((side - theta)[moving] / unit for side in (low, high))
        wanted = solve_triangular(factor, -slope[moving] * unit, lower=True)
        step[moving] = lsq_linear(factor.T, wanted, tuple(sides), method="bvls").x * unit
    return np.clip(theta + step, low, high) - theta
