"""The descent of a fit on one parameter: a curve whose Gauss-Newton step from afar goes too far."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from poro.arrays import Array
from poro.collapse import PoroStatus, Theta
from poro.fit import trust_region
from poro.fit.trust_region import Descent, descend

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
