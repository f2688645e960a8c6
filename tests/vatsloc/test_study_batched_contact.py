"""Many contact problems advanced together against one at a time, the bordered factor against a fresh one, guesses,
and whole lungs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import vatsloc.study.bench.batched_contact
from poro.arrays import Array
from poro.collapse import PoroStatus, Theta, assemble, solve
from poro.contact import ChestWall, Compliance, ContactState, ContactStatus, level_set, solve_contact
from poro.contact.active_set import ALL_PIVOTS, Guess
from poro.contact.geometric_stiffness import Directions, geometric_stiffness
from poro.contact.kkt import kkt_factor
from poro.fem import Tissue, solid
from poro.fem.forms import body_load
from poro.fem.tissue import GRAVITY_KPA_PER_MM
from tests.poro.shapes import compliance_of, ellipsoid
from vatsloc.study.bench.batched_contact import CachedKktFactor, across, apply_many, solve_contact_batch
from vatsloc.study.bench.sweep import interpolated_guesses, solve_many

Hollow = tuple[Compliance, ChestWall, Array, list[float]]


@pytest.fixture(scope="module")
def hollow() -> Hollow:
    """A heavy ellipsoid inside its own outline, laid on five sides in turn, its lower end pushed up."""
    mesh = ellipsoid(14.0)
    held = np.flatnonzero(np.linalg.norm(mesh.points - [-30, 0, 0], axis=1) < 16)
    body = solid(mesh, Tissue(), held)
    nodes = np.setdiff1d(mesh.boundary.nodes, held)
    level = level_set(mesh.boundary, 6.0, 10.0)
    rest = mesh.points[nodes]
    offset = np.minimum(level.evaluate(rest)[0], 0)
    wall = ChestWall(level, rest, rest[:, 2] < -45, np.array([0, 0, 1.0]), offset)
    sides = np.array([[0.6, 0, -0.8], [0, 0.6, -0.8], [0, -1, 0], [0.3, 0.2, 0.9], [1, 0, 0]])
    loads = np.stack([body_load(mesh, d * 200 * GRAVITY_KPA_PER_MM) for d in sides], axis=2)
    free = body.solve(loads)[nodes].transpose(2, 0, 1)
    return compliance_of(body, nodes), wall, np.ascontiguousarray(free), [0.0, 2.0, 4.0, 6.0, 8.0]


def _none(free: Array) -> list[Guess]:
    return [Guess(np.zeros_like(u), np.zeros(len(u)), np.zeros(len(u), bool)) for u in free]


def _alone(hollow: Hollow, tolerance_mm: float) -> list[ContactState]:
    compliance, wall, free, travel = hollow
    return [solve_contact(compliance, wall, u, t, None, tolerance_mm) for u, t in zip(free, travel, strict=True)]


@pytest.mark.parametrize(("tolerance_mm", "single"), [(1e-3, False), (1e-8, False), (1e-3, True)])
def test_loads_together_come_to_rest_where_each_does_alone(
    hollow: Hollow, tolerance_mm: float, single: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    exact = _alone(hollow, 1e-10)
    compliance, wall, free, travel = hollow
    if single:
        monkeypatch.setitem(compliance.__dict__, "matrix", compliance.matrix.astype(np.float32))
        monkeypatch.setattr(compliance, "_groups", None)
    states = solve_contact_batch(compliance, wall, free, travel, _none(free), tolerance_mm)
    for state, reference in zip(states, exact, strict=True):
        assert state.status is ContactStatus.CONVERGED
        assert (state.active == reference.active).all()
        assert_allclose(state.u, reference.u, atol=2 * tolerance_mm)
        assert state.moves[-1] < tolerance_mm
        assert (state.force >= 0).all()
        assert (state.force[~state.active] == 0).all()
        assert state.gap.min() > -2 * tolerance_mm


def test_each_load_tells_how_it_ended_and_the_slow_ones_go_on_alone(
    hollow: Hollow, monkeypatch: pytest.MonkeyPatch
) -> None:
    compliance, wall, free, travel = hollow
    exact = _alone(hollow, 1e-10)
    starts: list[Guess | ContactState] = [exact[0], *_none(free)[1:]]
    handed: list[float] = []

    def pivoting(*args: object) -> ContactState:
        handed.append(args[3])  # type: ignore[arg-type]
        return solve_contact(*args, most_pivots=1 if len(handed) == 1 else ALL_PIVOTS)  # type: ignore[arg-type]

    monkeypatch.setattr(vatsloc.study.bench.batched_contact, "QUICK_STEPS", 2)
    monkeypatch.setattr(vatsloc.study.bench.batched_contact, "solve_contact", pivoting)
    states = solve_contact_batch(compliance, wall, free, travel, starts)
    assert handed == travel[1:]
    assert [state.status for state in states[:2]] == [ContactStatus.CONVERGED, ContactStatus.STOPPED]
    for state, reference in zip(states[2:], exact[2:], strict=True):
        assert state.status is ContactStatus.CONVERGED
        assert_allclose(state.u, reference.u, atol=2e-3)


def test_factor_kept_over_a_changed_active_set_equals_a_fresh_one(hollow: Hollow) -> None:
    compliance, wall, free, travel = hollow
    rng = np.random.default_rng(0)
    state = solve_contact(compliance, wall, free[0], travel[0])
    stiffness = geometric_stiffness(compliance, wall.rest, state.force, state.hessian)

    def met(active: Array) -> CachedKktFactor:
        pool = np.flatnonzero(active)
        normal = state.gradient[pool]
        matrix, coupling = compliance.between(pool, normal), stiffness.coupling(pool, normal)
        return CachedKktFactor(
            pool, normal, stiffness, kkt_factor(matrix, coupling, stiffness.compliance, np.dtype(float))
        )

    gap, motion = rng.normal(size=len(state.active)), rng.normal(size=len(stiffness.directions.group))
    others = rng.permutation(len(state.active))[:14]
    active = state.active.copy()
    active[others] = ~active[others]
    force = np.where(active | state.active, state.force, 0)
    before, fresh = met(state.active), met(active)
    assert before.flips(active) == 14
    assert fresh.flips(active) == 0
    args = (compliance, active, state.gradient, force, (gap, motion))
    change, turning = before.change(*args)
    assert_allclose((force + change)[~active], 0, atol=1e-12)
    # What the nodes that left carried is taken off them: a fresh factor sees its effect as a further gap.
    off = np.where(active, 0, -force)[:, None] * state.gradient
    moved = compliance.apply(off)
    left = (gap + np.einsum("nd,nd->n", state.gradient, moved), motion + stiffness.project(moved))
    expected, expected_turning = fresh.change(compliance, active, state.gradient, force, left)
    assert_allclose(change[active], expected[active], atol=1e-8 * np.abs(expected).max())
    assert_allclose(turning, expected_turning, atol=1e-8 * np.abs(expected_turning).max())


def test_products_over_many_loads_equal_the_plain_one(hollow: Hollow) -> None:
    compliance, _, free, _ = hollow
    rng = np.random.default_rng(1)
    force = rng.normal(size=free.shape)
    together = apply_many(compliance, force)
    for one, u in zip(force, together, strict=True):
        assert_allclose(u, compliance.apply(one), atol=1e-10 * np.abs(u).max())
    nodes, others = np.array([3, 8, 20]), np.array([5, 3])
    along, toward = rng.normal(size=(3, 3)), rng.normal(size=(2, 3))
    unit = np.zeros((2, *free.shape[1:]))
    unit[np.arange(2), others] = toward
    moved = np.einsum("kd,mkd->km", along, apply_many(compliance, unit)[:, nodes])
    assert_allclose(across(compliance, Directions(nodes, along), Directions(others, toward)), moved, atol=1e-12)


def test_guesses_meet_the_states_they_lie_between_and_follow_a_trend(hollow: Hollow) -> None:
    states = _alone(hollow, 1e-3)
    loads = np.array([[0.0, 0], [1, 0], [0, 1], [1, 1], [2, -1]])
    for state, guess in zip(states, interpolated_guesses(loads, states, loads), strict=True):
        assert_allclose(guess.u, state.u, atol=1e-9)
        assert_allclose(guess.force, state.force, atol=1e-9)
        assert (guess.active[state.force > 1e-6] == state.active[state.force > 1e-6]).all()
    trend = np.random.default_rng(2).normal(size=(3, *states[0].u.shape))
    linear = [
        replace(state, u=trend[0] + x * trend[1] + y * trend[2]) for state, (x, y) in zip(states, loads, strict=True)
    ]
    (guess,) = interpolated_guesses(loads, linear, np.array([[3.0, 2.0]]))
    assert_allclose(guess.u, trend[0] + 3 * trend[1] + 2 * trend[2], atol=1e-9)
    (only,) = interpolated_guesses(loads[:1], states[:1], np.array([[9.0, 9.0]]))
    assert_allclose(only.u, states[0].u, atol=1e-12)


def test_many_lungs_equal_lungs_one_by_one() -> None:
    mesh = ellipsoid(14.0)
    held = np.flatnonzero(np.linalg.norm(mesh.points - [-30, 0, 0], axis=1) < 16)
    motion = np.broadcast_to([1.0, 0, 2.0], (len(held), 3))
    system = assemble(mesh, Tissue(), np.array([-1.0, 0, 0]), held, motion)
    rng = np.random.default_rng(1)
    thetas = [Theta(10 ** rng.uniform(-10, -7.5), rng.uniform(0.7, 0.9), rng.uniform(0, 8)) for _ in range(6)]
    for theta, state in zip(thetas, solve_many(system, thetas, 1e-7), strict=True):
        alone = solve(system, theta, tolerance_mm=1e-7)
        assert state.status is PoroStatus.SOLVED
        assert state.theta is theta
        assert_allclose(state.u, alone.u, atol=1e-5)
        assert_allclose(state.p, alone.p, atol=1e-9)
        assert (state.active == alone.active).all()
