"""The perturbation ensemble: which fits are made, which of them count, and how far they lie from the best one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from poro.collapse import PoroStatus, PoroSystem, Theta
from poro.fit import FitSettings, Target
from registration.volume import Array
from vatsloc.workflow import ensemble

GRAVITY = np.array([0.6, 0.0, -0.8])
HILUM = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
BEST_U = np.array([[0.5, -0.5, 0.25]])


@dataclass
class Tries:
    """Stands in for `fit_collapse`: notes what it is asked, and answers try n with the displacement n + 1 along x."""

    costs: dict[int, float]
    status: dict[int, PoroStatus]
    asked: list[tuple[PoroSystem, Target, FitSettings]]

    def __call__(self, system: PoroSystem, target: Target, settings: FitSettings) -> Any:
        n = len(self.asked)
        self.asked.append((system, target, settings))
        state = SimpleNamespace(u=np.add(BEST_U, [n + 1.0, 0, 0]), status=self.status.get(n, PoroStatus.SOLVED))
        return SimpleNamespace(costs=np.array([self.costs.get(n, 100.0)]), state=state)


def system() -> PoroSystem:
    other: Any = None
    return PoroSystem(other, other, GRAVITY, np.array([0, 1]), HILUM, *6 * (other,))


def surface() -> Target:
    rng = np.random.default_rng(2)
    return Target(rng.normal(0, 20, (9, 3)), np.tile([0.0, 0, 1], (9, 1)), 0.1 + np.arange(9.0))


def answers(monkeypatch: pytest.MonkeyPatch, costs: Any = (), status: Any = ()) -> tuple[Array, Tries]:
    tries = Tries(dict(costs), dict(status), [])
    monkeypatch.setattr(ensemble, "fit_collapse", tries)
    best: Any = SimpleNamespace(
        theta=Theta(3e-8, 0.75, 9.0),
        costs=np.array([11.0, 10.0]),
        state=SimpleNamespace(u=BEST_U),
    )
    return ensemble.perturbation_ensemble(system(), surface(), best, FitSettings(max_steps=17)), tries


def test_starts_count_where_they_end_as_well_as_the_best(monkeypatch: pytest.MonkeyPatch) -> None:
    far, _ = answers(monkeypatch, {0: 10.49, 1: 10.51})
    assert_allclose(far[:, 0, 0], [1.0, *np.arange(3.0, 10.0)])
    far, _ = answers(monkeypatch, {0: 10.51, 1: 10.49})
    assert_allclose(far[:, 0, 0], np.arange(2.0, 10.0))
    assert_allclose(far[:, 0, 1:], 0.0)


def test_tries_that_did_not_settle_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    status = {3: PoroStatus.NOT_CONVERGED, 4: PoroStatus.INVERTED}
    far, _ = answers(monkeypatch, status=status)
    assert_allclose(far[:, 0, 0], [3.0, 5.0, 6.0, 7.0, 8.0, 9.0])
    none, _ = answers(monkeypatch, status=dict.fromkeys(range(9), PoroStatus.NOT_CONVERGED))
    assert none.shape == (0, 1, 3)


def test_two_more_starts_then_seven_disturbed_inputs_from_the_best(monkeypatch: pytest.MonkeyPatch) -> None:
    _, tries = answers(monkeypatch)
    starts = [asked.starts for _, _, asked in tries.asked]
    assert starts == [((1e-10, 0.6, 5.0),), ((1e-6, 0.9, 15.0),)] + 7 * [((3e-8, 0.75, 9.0),)]
    assert all(replace(asked, starts=()) == FitSettings(max_steps=17, starts=()) for _, _, asked in tries.asked)


def test_gravity_is_tilted_hilum_moved_and_surface_halved_one_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    _, tries = answers(monkeypatch)
    whole, usual = surface(), system()
    systems, targets = [asked[0] for asked in tries.asked], [asked[1] for asked in tries.asked]
    for one in (*systems[:2], *systems[4:]):
        assert_allclose(one.gravity, usual.gravity)
    for one in (*systems[:4], *systems[7:]):
        assert_allclose(one.hilum_displacement, HILUM)
    for one in targets[:7]:
        assert_allclose(one.weights, whole.weights)
    tilted = np.array([one.gravity for one in systems[2:4]])
    assert_allclose(np.linalg.norm(tilted, axis=1), 1.0)
    assert_allclose(np.degrees(np.arccos(tilted @ GRAVITY)), 10.0)
    assert np.dot(*(tilted - np.cos(np.radians(10)) * GRAVITY)) == pytest.approx(0.0, abs=1e-9)
    for one, axis in zip(systems[4:7], np.eye(3), strict=True):
        assert_allclose(one.hilum_displacement - HILUM, np.tile(3.0 * axis, (2, 1)))
    near, far = targets[7].weights, targets[8].weights
    assert_allclose(near + far, whole.weights)
    assert sorted([(near > 0).sum(), (far > 0).sum()]) == [4, 5]
    assert not np.any(near * far)
    along = targets[7].points @ np.cross(GRAVITY, tilted[0])  # the first axis of the tilt
    below = along <= np.median(along)
    assert any(np.array_equal(one.weights > 0, below) for one in targets[7:])
