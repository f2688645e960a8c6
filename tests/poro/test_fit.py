"""The forward model's derivative, targets of its own making, load modes, and the size of the ellipsoid."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from shapes import ellipsoid

from poro.arrays import Array
from poro.collapse import PoroState, PoroStatus, PoroSystem, Theta, assemble, hilum_modes, solve, uniform_strain_modes
from poro.collapse.modes import LoadMode, eigenstrain_mode
from poro.collapse.solution import sensitivity, solve_nearby
from poro.fem import Tissue
from poro.fit import Fit, FitSettings, FitStatus, Target, ellipsoid95, fit_collapse, identifiability, point_covariance
from poro.fit.identifiability import THETA_NAMES
from poro.fit.observations import Observer, independence
from poro.fit.problem import STEP_SCALE, FitProblem
from poro.mesh import TetMesh, interpolate, locate

TISSUE = Tissue()
GRAVITY = np.array([-1.0, 0.0, 0.0])
TRUE = Theta(2e-8, 0.82, 6.0)


@pytest.fixture(scope="module")
def system() -> PoroSystem:
    mesh = ellipsoid(15.0)
    held = np.flatnonzero(np.linalg.norm(mesh.points - [-30, 0, 0], axis=1) < 16)
    return assemble(mesh, TISSUE, GRAVITY, held, np.broadcast_to([1.0, 0, 2.0], (len(held), 3)))


@pytest.fixture(scope="module")
def truth(system: PoroSystem) -> PoroState:
    return solve(system, TRUE)


def _target(system: PoroSystem, state: PoroState, inner: int = 0) -> Target:
    s = system.mesh.boundary
    moved = s.moved(s.points + state.u[s.nodes])
    seen = moved.points[:, 2] < 30
    x = np.random.default_rng(5).uniform(-22, 22, (inner, 3))
    y = x + interpolate(locate(system.mesh, x), state.u)
    return Target(moved.points[seen], moved.node_normals[seen], np.ones(seen.sum()), x, y, np.ones(inner))


def test_forward_solution_is_a_collapsed_lung_against_its_wall(system: PoroSystem, truth: PoroState) -> None:
    assert truth.status is PoroStatus.SOLVED
    ratio = (truth.det_f * system.mesh.volumes).sum() / system.mesh.volumes.sum()
    assert 0.3 < ratio < 0.9
    assert truth.gap.min() > -1e-3
    assert (truth.contact_pressure[truth.active] > 0).all()
    assert_allclose(truth.u[system.hilum], [[1.0, 0, 2.0]] * len(system.hilum), atol=1e-12)
    assert truth.u[:, 0].mean() < 0


def test_more_evacuation_means_less_volume_and_more_weight_more_sag(system: PoroSystem) -> None:
    volume = [float((solve(system, Theta(k, 0.9)).det_f * system.mesh.volumes).sum()) for k in (1e-10, 1e-8, 1e-6)]
    assert volume[0] > volume[1] > volume[2]
    sag = [solve(system, Theta(1e-9, phi)).u[:, 0].mean() for phi in (0.9, 0.6)]
    assert sag[1] < sag[0] < 0.5


def test_a_solution_nearby_is_the_same_and_one_far_off_is_not_waited_for(
    system: PoroSystem, truth: PoroState, monkeypatch: pytest.MonkeyPatch
) -> None:
    theta = Theta(2.2e-8, 0.83, 6.5)
    near, known = solve_nearby(system, theta, truth), solve(system, theta, truth)
    assert near.status is PoroStatus.SOLVED
    assert_allclose(near.u, known.u, atol=1e-9)
    monkeypatch.setattr("poro.collapse.solution.NEARBY_PIVOTS", 1)
    assert solve_nearby(system, theta, truth).status is PoroStatus.NOT_CONVERGED


def test_sensitivity_equals_finite_differences(system: PoroSystem, truth: PoroState) -> None:
    du = sensitivity(system, truth)
    x = TRUE.vector()
    for k, h in enumerate((1e-4, 1e-4, 1e-3)):
        ahead, behind = (solve(system, Theta.of(x + s * h * np.eye(3)[k]), truth, 1e-9) for s in (1, -1))
        assert (ahead.active == behind.active).all()
        difference = (ahead.u - behind.u) / (2 * h)
        assert_allclose(du[:, :, k], difference, atol=2e-3 * np.abs(difference).max())


@pytest.mark.parametrize("plain", [False, True])
def test_residuals_have_exact_derivatives(system: PoroSystem, truth: PoroState, plain: bool) -> None:
    observer = Observer(system.mesh, _target(system, solve(system, Theta(1e-8, 0.85)), inner=12), plain)
    du = np.random.default_rng(6).normal(size=(*truth.u.shape, 2))
    rows = observer.residuals(truth.u)
    h = 1e-6
    for k in range(2):
        ahead, behind = (observer.residuals(truth.u + s * h * du[:, :, k]).value for s in (1, -1))
        smooth = np.abs(rows.value) > 1e-2
        assert_allclose(rows.derivative(du)[smooth, k], ((ahead - behind) / (2 * h))[smooth], atol=1e-4)


def test_distances_are_to_the_surface_and_with_plain_to_its_nearest_node(system: PoroSystem) -> None:
    boundary, still = system.mesh.boundary, np.zeros_like(system.mesh.points)
    corners = boundary.points[boundary.triangles]
    outward = boundary.area_vectors / np.linalg.norm(boundary.area_vectors, axis=1)[:, None]
    points = corners.mean(axis=1) + 2.0 * outward  # above the middles of an ellipsoid's faces, which bulges
    target = Target(points, outward, np.ones(len(points)))
    assert_allclose(Observer(system.mesh, target).residuals(still).value, 2.0, atol=1e-9)
    nearest = np.linalg.norm(points[:, None] - boundary.points, axis=2).min(axis=1)
    plain = Observer(system.mesh, target, plain=True).residuals(still).value.reshape(-1, 3)
    assert_allclose(np.linalg.norm(plain, axis=1), nearest)


@pytest.mark.parametrize(("degrees", "share"), [(0.0, 1.0), (60.0, 0.5), (90.0, 0.0), (150.0, 0.0)])
def test_a_target_point_whose_normal_disagrees_loses_weight_and_an_opposed_one_all(
    system: PoroSystem, degrees: float, share: float
) -> None:
    """Above the surface's nodes, which are nearest, by their normals turned about the tangent nearest to A."""
    boundary, still = system.mesh.boundary, np.zeros_like(system.mesh.points)
    up = boundary.node_normals
    across = np.cross(up, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across, axis=1)[:, None]
    turn = np.deg2rad(degrees)
    confidence = np.linspace(0.2, 1.0, len(up))
    target = Target(boundary.points + up, np.cos(turn) * up + np.sin(turn) * across, confidence)
    rows = Observer(system.mesh, target).residuals(still)
    assert_allclose(rows.value, 1.0, atol=1e-9)
    assert_allclose(rows.weight, share * confidence, atol=1e-9)


def test_weights_do_not_hang_on_rounding(system: PoroSystem, truth: PoroState) -> None:
    """Points outside a bulging surface lie nearest to its edges and corners, which belong to several faces."""
    observer = Observer(system.mesh, _target(system, solve(system, Theta(1e-9, 0.85))))
    rng = np.random.default_rng(9)
    before = observer.residuals(truth.u)
    for _ in range(3):
        after = observer.residuals(truth.u + 1e-11 * rng.normal(size=truth.u.shape))
        assert_allclose(after.value, before.value, atol=1e-8)
        assert_allclose(after.weight, before.weight, atol=1e-7)


@pytest.fixture(scope="module")
def recovered(system: PoroSystem, truth: PoroState) -> Fit:
    settings = FitSettings(
        surface_sigma_mm=0.5, keypoint_sigma_mm=0.5, correlation_mm=5.0, tolerance=1e-5, max_steps=40
    )
    return fit_collapse(system, _target(system, truth, inner=15), settings)


def test_own_target_is_recovered(recovered: Fit, truth: PoroState) -> None:
    """A target made by the model itself: a test of the inverse problem, not of the model."""
    assert recovered.status is FitStatus.CONVERGED
    assert np.log10(recovered.theta.kappa_b) == pytest.approx(np.log10(TRUE.kappa_b), abs=0.01)
    assert recovered.theta.phi == pytest.approx(TRUE.phi, abs=0.005)
    assert recovered.theta.d_diaph_mm == pytest.approx(TRUE.d_diaph_mm, abs=0.1)
    assert np.linalg.norm(recovered.state.u - truth.u, axis=1).max() < 0.1
    cost = [step.cost for step in recovered.history]
    assert (np.diff(cost) <= 0).all()


def test_no_trial_reaches_farther_than_contact_can_follow(system: PoroSystem, truth: PoroState) -> None:
    """The travel is all but unseen by the inner points, so an unbounded step would leap to the box's wall."""
    target = _target(system, truth, inner=15)
    unseen = Target(target.points[:0], target.normals[:0], target.weights[:0], *_inner(target))
    history = fit_collapse(system, unseen, FitSettings(starts=((1e-9, 0.7, 0.0),))).history
    last = history[0].theta
    for step in history[1:]:
        assert (np.abs(step.theta - last) <= step.radius * STEP_SCALE + 1e-12).all()
        last = step.theta if step.accepted else last
    for step, following in pairwise(history):
        assert step.accepted or following.radius <= 0.3 * step.radius
    assert max(abs(step.theta[0] - history[0].theta[0]) for step in history) > STEP_SCALE[0]


def _inner(target: Target) -> tuple[Array, Array, Array]:
    return target.inflated, target.deflated, target.keypoint_weights


def test_ellipsoid_grows_with_what_is_unknown(recovered: Fit, system: PoroSystem) -> None:
    points = np.array([[5.0, 5, 5], [8.0, 5, 5]])
    covariance = point_covariance(recovered, system, points)
    axes, directions = ellipsoid95(covariance)
    assert (np.diff(axes) <= 0).all()
    assert_allclose(directions @ directions.swapaxes(1, 2), np.broadcast_to(np.eye(3), (2, 3, 3)), atol=1e-12)
    assert axes.max() < 2.0
    again = np.einsum("ka,kai,kaj->kij", axes**2 / 7.814728, directions, directions)
    assert_allclose(again, covariance, rtol=1e-9)
    surer = point_covariance(recovered, system, points, np.array([0.0, 3.0]))
    assert_allclose(surer[1] - point_covariance(recovered, system, points[1:], 0.0)[0], 9 * np.eye(3), atol=1e-9)
    assert np.linalg.eigvalsh(recovered.covariance).min() > 0


def test_paper_cost_finds_the_same_lung_where_points_are_nodes(system: PoroSystem, truth: PoroState) -> None:
    settings = FitSettings(plain=True, robust=np.inf, starts=((1e-8, 0.85, 4.0),), tolerance=1e-5)
    found = fit_collapse(system, _target(system, truth), settings)
    assert np.linalg.norm(found.state.u - truth.u, axis=1).mean() < 0.6


def _stretches(mesh: TetMesh) -> list[LoadMode]:
    """Isotropic strains: uniform, and growing linearly along each axis from -1 to 1."""
    centre = mesh.points[mesh.tets].mean(axis=1)
    low, high = centre.min(axis=0), centre.max(axis=0)
    along = 2 * (centre - low) / (high - low) - 1
    fields = {"uniform": np.ones(len(centre)), "S": along[:, 2], "A": along[:, 1], "R": along[:, 0]}
    return [eigenstrain_mode(mesh, TISSUE, name, x[:, None, None] * np.eye(3), 0.1) for name, x in fields.items()]


def test_load_modes_are_recovered_from_inner_points(system: PoroSystem) -> None:
    mesh = system.mesh
    modes = (*_stretches(mesh), *hilum_modes(mesh, system.hilum)[:1])
    wide = assemble(mesh, TISSUE, GRAVITY, system.hilum, system.hilum_displacement, modes)
    amplitudes = (-0.05, 0.04, -0.03, 0.02, 2.0)
    state = solve(wide, Theta(1e-8, 0.85, 0.0, amplitudes))
    settings = FitSettings(
        surface_sigma_mm=0.3, keypoint_sigma_mm=0.3, correlation_mm=5.0, tolerance=1e-5, max_steps=40
    )
    found = fit_collapse(wide, _target(wide, state, inner=60), settings)
    assert np.linalg.norm(found.state.u - state.u, axis=1).mean() < 0.15
    assert_allclose(found.theta.modes[:4], amplitudes[:4], atol=0.03)
    assert found.theta.modes[4] == pytest.approx(2.0, abs=0.5)


def test_mode_sensitivity_equals_finite_differences(system: PoroSystem) -> None:
    modes = uniform_strain_modes(system.mesh, TISSUE)
    wide = assemble(system.mesh, TISSUE, GRAVITY, system.hilum, system.hilum_displacement, modes)
    x = np.array([-8.0, 0.85, 2.0, -0.05, 0.02, 0.01, -0.04, 0.02, -0.03])
    state = solve(wide, Theta.of(x))
    du = sensitivity(wide, state)
    for k in (3, 4, 8):
        step = 1e-4 * np.eye(9)[k]
        ahead, behind = (solve(wide, Theta.of(x + s * step), state) for s in (1, -1))
        difference = (ahead.u - behind.u) / 2e-4
        assert_allclose(du[:, :, k], difference, atol=2e-3 * np.abs(difference).max())


def test_slope_is_the_gradient_of_the_robust_cost_and_its_priors_at_frozen_weights(
    system: PoroSystem, truth: PoroState
) -> None:
    modes = hilum_modes(system.mesh, system.hilum)[:1]
    wide = assemble(system.mesh, TISSUE, GRAVITY, system.hilum, system.hilum_displacement, modes)
    target, settings = _target(system, truth, inner=12), FitSettings(kappa_decades=0.7)
    problem = FitProblem.of(wide, target, settings)
    x = np.array([-7.4, 0.75, 3.0, 1.5])

    state = solve(wide, Theta.of(x), None, 1e-9)
    rows = problem.observer.residuals(state.u)
    _, slope = problem.normal_equations(rows, sensitivity(wide, state), x)
    for k, h in enumerate((1e-4, 1e-4, 1e-3, 1e-3)):
        costs = []
        for theta in (x + h * np.eye(4)[k], x - h * np.eye(4)[k]):
            moved = problem.observer.residuals(solve(wide, Theta.of(theta), state, 1e-9).u)
            costs.append(problem.cost(moved, problem.whiten(rows), theta))
        difference = (costs[0] - costs[1]) / (2 * h)
        assert slope[k] == pytest.approx(difference, rel=5e-3, abs=1e-3 * np.abs(slope).max())


def test_a_start_where_no_pressure_is_felt_comes_back_through_the_prior(system: PoroSystem, truth: PoroState) -> None:
    """At 1e-13 the pressure drop is 1e-4 of what it can be: without a prior nothing takes the fit away from there."""
    target, start = _target(system, truth), ((1e-13, 0.82, 6.0),)
    lost = fit_collapse(system, target, FitSettings(starts=start, kappa_decades=np.inf, free=(True, False, False)))
    found = fit_collapse(system, target, FitSettings(starts=start, free=(True, False, False)))
    assert lost.theta.kappa_b < 1e-12
    assert np.log10(found.theta.kappa_b) == pytest.approx(np.log10(TRUE.kappa_b), abs=0.05)


@pytest.mark.parametrize("last_is_free", [True, False])
def test_identifiability_is_of_the_fit_s_covariance_given_what_is_held(system: PoroSystem, last_is_free: bool) -> None:
    whole = np.array([[4.0, 1.0, 0.5], [1.0, 2.0, 0.3], [0.5, 0.3, 1.0]])
    fit: Any = SimpleNamespace(covariance=whole, free=np.array([True, True, last_is_free]), theta=TRUE)
    known = identifiability(fit, system)
    given = whole if last_is_free else whole[:2, :2] - np.outer(whole[:2, 2], whole[2, :2]) / whole[2, 2]
    assert_allclose(known.sigma, np.sqrt(np.diag(given)))
    assert_allclose(known.correlation, given / np.outer(known.sigma, known.sigma))


def test_identifiability_names_what_is_held_and_what_ended_at_a_bound(system: PoroSystem, truth: PoroState) -> None:
    target = _target(system, truth, inner=15)
    known = identifiability(fit_collapse(system, target, FitSettings(starts=((2e-8, 0.82, 6.0),))), system)
    assert known.names == THETA_NAMES
    assert known.at_bound == ()
    assert_allclose(np.diag(known.correlation), 1, atol=1e-12)
    assert (np.diff(known.singular) <= 0).all()
    # The information is that of the covariance: along the valley its inverse is the variance, in longest steps.
    assert np.linalg.norm(known.valley) == pytest.approx(1)
    information = np.linalg.inv(known.correlation * np.outer(known.sigma, known.sigma)) * np.outer(
        STEP_SCALE, STEP_SCALE
    )
    assert known.valley @ information @ known.valley == pytest.approx(known.singular[-1] ** 2)
    still = fit_collapse(
        system, target, FitSettings(starts=((2e-8, 0.93, 0.0),), free=(True, False, True), max_steps=1)
    )
    assert identifiability(still, system).names == ("log10 kappa_b", "d_diaph_mm")
    down = _target(system, solve(system, Theta(2e-8, 0.82, 0.0)), inner=15)
    ended = fit_collapse(
        system, replace(down, points=down.points - [0, 0, 4.0]), FitSettings(starts=((2e-8, 0.82, 3.0),))
    )
    assert identifiability(ended, system).at_bound == ("d_diaph_mm",)


def test_empty_targets_and_wrong_gravity_are_refused(system: PoroSystem) -> None:
    with pytest.raises(ValueError, match="no point of positive weight"):
        fit_collapse(system, Target(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)))
    with pytest.raises(ValueError, match="unit vector"):
        assemble(system.mesh, TISSUE, 2 * GRAVITY, system.hilum, system.hilum_displacement)


def test_points_share_their_weight_with_neighbours_within_half_the_correlation_length() -> None:
    points = np.array([[0.0, 0, 0], [0, 0, 0], [0, 0, 7], [0, 0, 14.6]])
    assert_allclose(independence(points, 15.0), [1 / 3, 1 / 3, 1 / 3, 1])
    assert_allclose(independence(points, 15.3), [1 / 3, 1 / 3, 1 / 4, 1 / 2])
    assert_allclose(independence(points, 0.0), 1)  # two at one place count in full too
    assert independence(np.zeros((0, 3)), 15.0).shape == (0,)
