"""The descent of a fit on one parameter: a curve whose Gauss-Newton step from afar goes too far."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from poro.arrays import Array
from poro.collapse import PoroStatus, Theta
from poro.fit import trust_region
from poro.fit.trust_region import MOST_UNSETTLED, Descent, bounded_step, descend

FREE = np.array([False, False, True])


def descent(monkeypatch: pytest.MonkeyPatch, lost_within: float) -> Descent:
    """From 2 down the square of the arc tangent; nearer to 0 than `lost_within` no state converges."""

    def solved(_system: Any, theta: Theta, _start: Any = None) -> Any:
        lost = abs(theta.d_diaph_mm) < lost_within
        return SimpleNamespace(u=theta.vector(), status=PoroStatus.NOT_CONVERGED if lost else PoroStatus.SOLVED)

    def normal_equations(rows: Array, _by: Any, theta: Array) -> tuple[Array, Array]:
        by = FREE / (1 + theta[2] ** 2)
        return 2 * np.outer(by, by), 2 * by * rows

    problem: Any = SimpleNamespace(
        system=None,
        free=FREE,
        step_scale=np.full(3, 10.0),
        settings=SimpleNamespace(tolerance=1e-6, max_steps=60),
        observer=SimpleNamespace(residuals=lambda u: np.arctan(u[2:])),
        whiten=lambda rows: rows,
        cost=lambda rows, _whitened, _theta: float(rows @ rows),
        normal_equations=normal_equations,
    )
    monkeypatch.setattr(trust_region, "solve", solved)
    monkeypatch.setattr(trust_region, "solve_nearby", solved)
    monkeypatch.setattr(trust_region, "sensitivity", lambda *_: None)
    monkeypatch.setattr(trust_region, "bounds", lambda _: (np.full(3, -np.inf), np.full(3, np.inf)))
    return descend(problem, np.array([0.0, 0.5, 2.0]))


def test_a_step_that_raises_the_cost_is_refused_and_a_shorter_one_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    found = descent(monkeypatch, 0.0)
    cost = [step.cost for step in found.history]
    assert not found.history[1].accepted
    assert found.history[2].radius < found.history[1].radius
    assert max(np.diff(cost)) <= 0
    assert found.theta[2] == pytest.approx(0, abs=1e-3)


def test_a_step_to_a_state_that_did_not_converge_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    found = descent(monkeypatch, 0.5)
    assert found.state.status is PoroStatus.SOLVED
    assert 0.5 <= abs(found.theta[2]) < 2.0


def test_a_descent_ends_after_a_few_trials_whose_contact_does_not_settle(monkeypatch: pytest.MonkeyPatch) -> None:
    found = descent(monkeypatch, 1.9)
    assert sum(abs(step.theta[2]) < 1.9 for step in found.history) == MOST_UNSETTLED
    assert not found.converged
    assert abs(found.theta[2]) >= 1.9


def boxed(seed: int, free: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Normal equations whose parameters mean much the same, so that one that is stopped moves all the others."""
    rng = np.random.default_rng(seed)
    jacobian = rng.normal(size=(40, 6)) + 5 * rng.normal(size=(40, 1))
    normal, slope = jacobian.T @ jacobian, jacobian.T @ rng.normal(0, 30, 40)
    low, high = -rng.uniform(0.05, 1.0, 6), rng.uniform(0.05, 1.0, 6)
    low[5] = high[5] = 0.0
    return normal, slope, low, high, bounded_step(normal, slope, np.zeros(6), low, high, free)


@pytest.mark.parametrize("seed", range(8))
def test_a_step_within_a_box_promises_more_than_any_step_beside_it(seed: int) -> None:
    free = np.array([True, True, True, False, True, True])
    normal, slope, low, high, step = boxed(seed, free)

    def promised(step: Array) -> float:
        return float(-(slope + 0.5 * normal @ step) @ step)

    assert step[3] == step[5] == 0
    assert ((low <= step) & (step <= high)).all()
    assert promised(step) > 0
    beside = np.random.default_rng(seed).normal(0, 0.05, (400, 6)) * free
    others = np.clip(step + beside, low, high)
    assert max(promised(other) for other in others) <= promised(step) * (1 + 1e-5)


def test_some_parameters_come_off_the_side_of_the_box_that_the_free_step_would_have_hit() -> None:
    """Stopping what leaves the box and solving for the rest would leave them there, and promise a rise."""
    off = 0
    for seed in range(8):
        normal, slope, low, high, step = boxed(seed, np.ones(6, bool))
        without = np.append(np.linalg.solve(normal[:5, :5], -slope[:5]), 0.0)
        hit = (without < low) | (without > high)
        off += int((hit & (low < step) & (step < high)).sum())
    assert off > 0
