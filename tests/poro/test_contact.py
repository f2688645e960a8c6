"""Contact against a closed form, an independent quadratic program, equilibrium on a curved wall, finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import cholesky
from scipy.optimize import nnls
from shapes import box, compliance_of, ellipsoid

from poro.arrays import Array
from poro.collapse import Theta, assemble, solve
from poro.contact import (
    ChestWall,
    Compliance,
    ContactStatus,
    LevelSet,
    active_set,
    contact_sensitivity,
    level_set,
    solve_contact,
)
from poro.contact.active_set import LinearizedContact, linear_complementarity
from poro.contact.geometric_stiffness import GeometricStiffness, geometric_stiffness
from poro.contact.kkt import kkt_factor
from poro.errors import SolverError
from poro.fem import Solid, Tissue, solid
from poro.fem.forms import body_load
from poro.fem.tissue import GRAVITY_KPA_PER_MM
from poro.mesh import TetMesh, closest_points


def _floor(height: float) -> LevelSet:
    """Distance above the plane z = height; a cubic B-spline reproduces it exactly."""
    grid = np.broadcast_to((np.arange(60) * 5.0 - 100 - height)[None, None], (40, 40, 60)).copy()
    return LevelSet(grid, np.array([-100.0, -100.0, -100.0]), 5.0)


def _wall(mesh: TetMesh, level: LevelSet, nodes: Array) -> ChestWall:
    rest = mesh.points[nodes]
    return ChestWall(level, rest, np.zeros(len(nodes), bool), np.array([0, 0, 1.0]), np.zeros(len(nodes)))


def test_block_pressed_on_a_floor_carries_uniform_pressure() -> None:
    """nu = 0, top pushed down by d: sigma = E d / H everywhere, exact for linear elements."""
    tissue, height, push = Tissue(poisson=0.0), 30.0, 3.0
    mesh = box((4, 4, 5), (20.0, 20.0, height))
    top, bottom = (np.flatnonzero(mesh.points[:, 2] == z) for z in (height, 0.0))
    body = solid(mesh, tissue, top)
    imposed = np.broadcast_to([0, 0, -push], (len(top), 3)).copy()
    free = body.solve(np.zeros_like(mesh.points), imposed)
    compliance = compliance_of(body, bottom)
    state = solve_contact(compliance, _wall(mesh, _floor(0.0), bottom), free[bottom], 0.0)
    assert state.status is ContactStatus.CONVERGED
    assert state.active.all()
    assert_allclose(state.gap, 0, atol=1e-9)
    boundary = mesh.boundary
    floor_faces = (boundary.points[boundary.triangles, 2] == 0).all(axis=1)
    area = np.bincount(
        boundary.nodes[boundary.triangles[floor_faces]].ravel(),
        np.repeat(boundary.areas[floor_faces] / 3, 3),
        len(mesh.points),
    )
    assert_allclose(state.force / area[bottom], tissue.young_kpa * push / height, rtol=1e-8)


def test_floor_out_of_reach_stays_untouched() -> None:
    mesh = box((3, 3, 3), (20.0, 20.0, 20.0))
    top, bottom = (np.flatnonzero(mesh.points[:, 2] == z) for z in (20.0, 0.0))
    body = solid(mesh, Tissue(), top)
    free = body.solve(body_load(mesh, np.array([0, 0, -100 * GRAVITY_KPA_PER_MM])))
    state = solve_contact(compliance_of(body, bottom), _wall(mesh, _floor(-5.0), bottom), free[bottom], 0.0)
    assert not state.active.any()
    assert_allclose(state.u, free[bottom])
    assert state.gap.min() == pytest.approx(5 + free[bottom, 2].min())


class _Dense(Compliance):
    """Compliance given as a matrix, for tests of the complementarity solver alone."""

    def __init__(self, matrix: Array) -> None:
        n = len(matrix) // 3
        super().__init__(self, np.arange(3 * n).reshape(-1, 3), 3 * n)
        self.dense = matrix

    def solve(self, right: Array) -> Array:
        return self.dense @ right


def _no_stiffness(compliance: Compliance, nodes: int) -> GeometricStiffness:
    """Geometric stiffness of a flat wall, that is none."""
    return geometric_stiffness(
        compliance, np.arange(3.0 * nodes).reshape(-1, 3), np.zeros(nodes), np.zeros((nodes, 3, 3))
    )


@pytest.mark.parametrize("seed", range(8))
def test_active_set_equals_a_quadratic_program(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 40
    root = rng.normal(size=(3 * n, 3 * n))
    dense = root @ root.T / n + 0.05 * np.eye(3 * n)
    gradient = rng.normal(size=(n, 3))
    gradient /= np.linalg.norm(gradient, axis=1)[:, None]
    free = rng.normal(size=(n, 3))
    compliance = _Dense(dense)
    linear = LinearizedContact(compliance, np.zeros(n), gradient, np.zeros((n, 3)), free, _no_stiffness(compliance, n))
    force, active, u, _, _ = linear_complementarity(linear, rng.random(n) < 0.5)
    rows = np.zeros((3 * n, n))
    rows[np.arange(3 * n), np.repeat(np.arange(n), 3)] = gradient.ravel()
    w, q = rows.T @ dense @ rows, rows.T @ free.ravel()
    upper = cholesky(w)
    expected, _ = nnls(upper, -np.linalg.solve(upper.T, q), maxiter=1000)
    assert_allclose(force, expected, atol=1e-8 * max(1, np.abs(expected).max()))
    assert_allclose(u.ravel(), free.ravel() + dense @ rows @ force, atol=1e-9 * np.abs(u).max())
    assert (force[~active] == 0).all()


def _signorini(dense: Array, load: Array) -> tuple[Array, ContactStatus]:
    """Forces (n,) of n one-way contacts of compliance dense (n, n) and free gaps `load` (n,), from none active."""
    n = len(load)
    full = np.kron(dense, np.diag([1.0, 0, 0])) + np.diag(np.tile([0, 1.0, 1.0], n))
    compliance = _Dense(full)
    zero, along = np.zeros((n, 3)), np.broadcast_to([1.0, 0, 0], (n, 3)).copy()
    linear = LinearizedContact(compliance, load, along, zero, zero, _no_stiffness(compliance, n))
    force, _, _, _, status = linear_complementarity(linear, np.zeros(n, bool))
    return force, status


def _plain_sets(dense: Array, load: Array) -> bool:
    """Whether the primal-dual active set without any safeguard comes to rest, instead of coming back to a set."""
    active, seen = np.zeros(len(load), bool), set()
    while active.tobytes() not in seen:
        seen.add(active.tobytes())
        force = np.zeros(len(load))
        force[active] = -np.linalg.solve(dense[np.ix_(active, active)], load[active])
        wrong = (active & (force < 0)) | (~active & (dense @ force + load < -1e-9))
        if not wrong.any():
            return True
        active = active ^ wrong
    return False


def test_a_cycling_active_set_is_noticed_and_ended_by_pivots() -> None:
    rng = np.random.default_rng(0)
    cycled = 0
    for _ in range(4000):
        root = rng.normal(size=(8, rng.integers(1, 9)))
        dense, load = root @ root.T + 10 ** rng.uniform(-3, -0.5) * np.eye(8), rng.normal(size=8)
        if _plain_sets(dense, load):
            continue
        cycled += 1
        force, status = _signorini(dense, load)
        assert status is ContactStatus.PIVOTED
        upper = cholesky(dense)
        expected, _ = nnls(upper, -np.linalg.solve(upper.T, load))
        assert_allclose(force, expected, atol=1e-6 * max(1, expected.max()))
    assert cycled >= 5


@pytest.fixture(scope="module")
def hollow() -> tuple[TetMesh, Solid, Array, ChestWall, Compliance]:
    """A heavy ellipsoid hung by a few nodes inside its own outline."""
    mesh = ellipsoid(16.0)
    held = np.flatnonzero(np.linalg.norm(mesh.points - [-30, 0, 0], axis=1) < 16)
    body = solid(mesh, Tissue(), held)
    nodes = np.setdiff1d(mesh.boundary.nodes, held)
    level = level_set(mesh.boundary, 6.0, 10.0)
    rest = mesh.points[nodes]
    moving = rest[:, 2] < -45
    wall = ChestWall(level, rest, moving, np.array([0, 0, 1.0]), np.minimum(level.evaluate(rest)[0], 0))
    return mesh, body, nodes, wall, compliance_of(body, nodes)


def test_level_set_derivatives() -> None:
    level = level_set(ellipsoid(13.0).boundary, 6.0, 10.0)
    x = np.random.default_rng(3).uniform(-50, 50, (40, 3))
    _, gradient, hessian = level.evaluate(x)
    h = 1e-4
    for axis in range(3):
        step = h * np.eye(3)[axis]
        ahead, behind = level.evaluate(x + step), level.evaluate(x - step)
        assert_allclose((ahead[0] - behind[0]) / (2 * h), gradient[:, axis], atol=1e-7)
        assert_allclose((ahead[1] - behind[1]) / (2 * h), hessian[:, axis], atol=1e-7)
    assert level.evaluate(np.zeros((1, 3)))[0][0] > 25
    assert level.evaluate(np.array([[60.0, 0, 0]]))[0][0] < -10


@pytest.mark.parametrize("density", [80.0, 250.0])
def test_signorini_conditions_hold_on_a_curved_wall(hollow: tuple, density: float) -> None:
    mesh, body, nodes, wall, compliance = hollow
    load = body_load(mesh, np.array([0.6, 0, -0.8]) * density * GRAVITY_KPA_PER_MM)
    free = body.solve(load)
    state = solve_contact(compliance, wall, free[nodes], 0.0)
    assert state.status is ContactStatus.CONVERGED
    assert state.active.sum() > 10
    assert state.gap.min() > -1e-3
    assert (state.force >= 0).all()
    assert_allclose(state.gap[state.force > 0], 0, atol=1e-4)
    pushed = np.zeros_like(load)
    pushed[nodes] = state.gradient * state.force[:, None]
    u = free + body.solve(pushed)
    assert_allclose(u[nodes], state.u, atol=1e-2)
    assert state.moves[-1] < 1e-3
    assert state.steps <= 12


def test_on_the_way_contact_forces_press_and_never_pull(hollow: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, body, nodes, wall, compliance = hollow
    seen: list[Array] = []

    def watched(compliance: Compliance, rest: Array, force: Array, hessian: Array) -> GeometricStiffness:
        seen.append(force)
        return geometric_stiffness(compliance, rest, force, hessian)

    monkeypatch.setattr(active_set, "geometric_stiffness", watched)
    free = body.solve(body_load(mesh, np.array([0, 0, -200.0 * GRAVITY_KPA_PER_MM])))[nodes]
    state = solve_contact(compliance, wall, free, 4.0, tolerance_mm=1e-8)
    assert len(seen) > 4
    assert min(force.min() for force in seen) >= 0
    assert min(force.sum() for force in seen[2:]) > 0.5 * state.force.sum()


def test_contact_is_found_from_any_start(hollow: tuple) -> None:
    mesh, body, nodes, wall, compliance = hollow
    heavy, light = (
        body.solve(body_load(mesh, np.array([0, 0, -d * GRAVITY_KPA_PER_MM])))[nodes] for d in (300.0, 60.0)
    )
    cold = solve_contact(compliance, wall, light, 4.0, tolerance_mm=1e-8)
    warm = solve_contact(compliance, wall, light, 4.0, solve_contact(compliance, wall, heavy, 0.0), tolerance_mm=1e-8)
    assert_allclose(warm.u, cold.u, atol=1e-6)
    assert (warm.active == cold.active).all()


def test_sensitivity_of_contact_equals_finite_differences(hollow: tuple) -> None:
    mesh, body, nodes, wall, compliance = hollow
    direction = np.array([0.3, 0.2, -0.9]) * GRAVITY_KPA_PER_MM
    unit = body.solve(body_load(mesh, direction))[nodes]
    at = solve_contact(compliance, wall, 150 * unit, 5.0, tolerance_mm=1e-9)
    change = contact_sensitivity(compliance, wall, at, np.stack([unit, 0 * unit], axis=2), np.array([0.0, 1.0]))
    for k, (load, travel) in enumerate(((1e-3, 0.0), (0.0, 1e-4))):
        ahead, behind = (
            solve_contact(compliance, wall, (150 + s * load) * unit, 5.0 + s * travel, at, 1e-10) for s in (1, -1)
        )
        assert (ahead.active == behind.active).all()
        total = [s.gradient * s.force[:, None] for s in (ahead, behind)]
        difference = (total[0] - total[1]) / (2 * (load or travel))
        assert_allclose(change[:, :, k], difference, atol=2e-4 * np.abs(difference).max())


def test_nodes_that_the_diaphragm_lets_behind_the_wall_are_counted_and_the_hilum_is_left_out() -> None:
    """A diaphragm that sinks under a heavy lung takes its nodes along, out of the chest wall."""
    mesh = ellipsoid(15.0)
    held = np.flatnonzero(np.linalg.norm(mesh.points - [-30, 0, 0], axis=1) < 16)
    system = assemble(mesh, Tissue(), np.array([0, 0, -1.0]), held, np.zeros((len(held), 3)))
    sinking = replace(system, wall=replace(system.wall, axis=-system.wall.axis))
    assert not np.isin(system.contact_nodes, held).any()
    for travel in (0.0, 8.0):
        state = solve(sinking, Theta(0.0, 0.5, travel))
        out = closest_points(mesh.boundary, (mesh.points + state.u)[system.contact_nodes]).distance
        assert (out[~system.wall.moving] < 1.5).all()
        assert state.gap.min() > -1e-3
        if travel:
            assert (out[system.wall.moving] > 2).sum() <= state.conflicts <= (out > 0).sum()
            assert state.conflicts > 5
        else:
            assert state.conflicts == 0


def test_contact_nodes_that_move_alike_have_no_forces() -> None:
    with pytest.raises(SolverError, match="contact nodes 1 and an earlier one move alike"):
        kkt_factor(np.ones((2, 2)), np.zeros((2, 0)), np.zeros((0, 0)), np.dtype(float))
