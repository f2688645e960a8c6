"""Which strain measure is used, why, and that the finite-strain lung balances its pressure, weight and wall."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from shapes import ellipsoid

from poro.collapse import (
    LinearRange,
    PoroSystem,
    StrainMeasure,
    Theta,
    assemble,
    choice,
    finite_strain,
    hilum_modes,
    keep_in_range,
    solve,
)
from poro.collapse.choice import StrainChoice, finite_problem
from poro.collapse.finite_strain import FiniteProblem, FiniteStatus, deform
from poro.fem import Tissue, neo_hookean, solid
from poro.fem.forms import deformation_gradient

TISSUE = Tissue()
MATERIAL = neo_hookean(TISSUE)


@pytest.fixture(scope="module")
def system() -> PoroSystem:
    mesh = ellipsoid(16.0)
    held = np.flatnonzero(np.linalg.norm(mesh.points - [-30, 0, 0], axis=1) < 16)
    return assemble(mesh, TISSUE, np.array([-1.0, 0, 0]), held, np.broadcast_to([1.0, 0, 2.0], (len(held), 3)))


def solved_in_range(system: PoroSystem, theta: Theta, within: LinearRange | None = None) -> StrainChoice:
    return keep_in_range(system, solve(system, theta), MATERIAL, within)


def test_pressure_at_small_load_is_the_pressure_gradients_linear_force(system: PoroSystem) -> None:
    """Integral of q div v equals that of -alpha grad p . v, for p with its surface value on the whole surface."""
    p, _ = system.flow.pressure(1e-8)
    drop = TISSUE.pleural_kpa - p[system.mesh.tets].mean(axis=1)
    still = np.zeros_like(system.hilum_displacement)
    small = 1e-4
    problem = FiniteProblem(
        system.mesh, MATERIAL, system.hilum, still, np.zeros_like(system.mesh.points), None, small * drop
    )
    linear = solid(system.mesh, TISSUE, system.hilum).solve((system.pressure_load @ p).reshape(-1, 3))
    state = deform(problem)
    assert_allclose(state.u / small, linear, atol=1e-3 * np.abs(linear).max())


def test_free_body_under_uniform_pressure_drop_shrinks_by_the_closed_form() -> None:
    """F = s I: mu (s - 1 / s) + 3 lambda ln s / s + q s^2 = 0."""
    lame, mu, s = TISSUE.lame_kpa, TISSUE.shear_kpa, 0.8
    q = -(mu * (s - 1 / s) + 3 * lame * np.log(s) / s) / s**2
    mesh = ellipsoid(18.0)
    held = np.flatnonzero(mesh.points[:, 2] < -40)
    exact = (s - 1) * mesh.points
    problem = FiniteProblem(mesh, MATERIAL, held, exact[held], 0 * exact, None, np.full(len(mesh.tets), q))
    state = deform(problem)
    assert q > 0
    assert state.status is FiniteStatus.SOLVED
    assert_allclose(state.u, exact, atol=1e-6)


def test_gentle_lungs_stay_linear_and_say_so(system: PoroSystem) -> None:
    chosen = solved_in_range(system, Theta(1e-10, 0.9))
    assert chosen.strain is StrainMeasure.LINEAR
    assert chosen.finite is None
    assert chosen.why.startswith("linear strain: 0.00 %")
    assert_allclose(chosen.state.u, solve(system, Theta(1e-10, 0.9)).u, atol=1e-2)


def test_collapsed_lungs_go_finite_and_hold_signorini(system: PoroSystem) -> None:
    theta = Theta(1e-6, 0.5, 4.0)
    chosen = solved_in_range(system, theta, LinearRange(min_det=0.5))
    state = chosen.state
    assert chosen.strain is StrainMeasure.FINITE
    assert chosen.why.startswith("neo-Hookean:")
    assert state.det_f.min() > 0.05
    assert_allclose(state.det_f, np.linalg.det(deformation_gradient(system.mesh, state.u)))
    assert state.gap[system.contact_nodes].min() > -1e-6
    assert (state.contact_pressure >= 0).all()
    assert_allclose(state.gap[state.contact_pressure > 0], 0, atol=1e-6)
    assert chosen.finite is not None
    assert chosen.finite.residuals[-1] < 1e-8
    assert state.det_f @ system.mesh.volumes > solve(system, theta).det_f @ system.mesh.volumes


def test_a_lung_that_takes_too_many_steps_stays_linear_and_says_so(
    system: PoroSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(choice, "MOST_STEPS", 2)
    linear = solve(system, Theta(1e-6, 0.5, 4.0))
    chosen = keep_in_range(system, linear, MATERIAL, LinearRange(min_det=0.5))
    assert chosen.state is linear
    assert chosen.strain is StrainMeasure.LINEAR
    assert chosen.finite is not None
    assert chosen.finite.status is FiniteStatus.OUT_OF_STEPS
    assert 0 <= chosen.finite.share < 1
    assert f"neo-Hookean carried only {100 * chosen.finite.share:.0f} % of the load in" in chosen.why


def test_finite_strain_is_left_out_where_it_moves_nothing_and_kept_where_it_does(system: PoroSystem) -> None:
    """What the choice is worth: median motion of the nodes between both strain measures, under one load."""

    def apart(theta: Theta) -> float:
        linear, finite = (solved_in_range(system, theta, LinearRange(share=share)) for share in (1.0, -1.0))
        assert (linear.strain, finite.strain) == (StrainMeasure.LINEAR, StrainMeasure.FINITE)
        return float(np.median(np.linalg.norm(linear.state.u - finite.state.u, axis=1)))

    gentle, strong = Theta(1e-10, 0.9), Theta(1e-6, 0.5, 4.0)
    assert solved_in_range(system, gentle).strain is StrainMeasure.LINEAR
    assert apart(gentle) < 0.5
    assert solved_in_range(system, strong).strain is StrainMeasure.FINITE
    assert apart(strong) > 0.5


def test_a_solved_lung_is_kept_as_it_is_or_solved_again(system: PoroSystem) -> None:
    linear = solve(system, Theta(1e-8, 0.8, 2.0))
    kept = keep_in_range(system, linear, MATERIAL, LinearRange(min_det=linear.det_f.min()))
    assert kept.state is linear
    assert kept.entry() == {"strain": "linear strain", "why": kept.why, "share_out_of_range": 0.0}
    bound = float(np.quantile(linear.det_f, 0.25))
    again = keep_in_range(system, linear, MATERIAL, LinearRange(min_det=bound))
    assert again.state.theta is linear.theta
    assert again.entry()["strain"] == "finite strain"
    assert again.entry()["share_out_of_range"] == pytest.approx(0.25, abs=1 / len(linear.det_f))
    assert 0.1 < np.linalg.norm(again.state.u - linear.u, axis=1).max() < 10


def test_load_modes_are_refused(system: PoroSystem) -> None:
    with_modes = assemble(
        system.mesh,
        TISSUE,
        system.gravity,
        system.hilum,
        system.hilum_displacement,
        hilum_modes(system.mesh, system.hilum)[:1],
    )
    with pytest.raises(ValueError, match="no load modes"):
        finite_problem(with_modes, Theta(1e-9, 0.8, 0.0, (0.0,)), MATERIAL)


def test_a_share_of_the_load_is_given_up_that_brings_nothing_and_the_rest_where_steps_are_short(
    system: PoroSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A lung under more than it can carry. Each try's residuals, and whether it balanced."""
    tries: list[tuple[list[float], bool]] = []
    newton = finite_strain._newton

    def spied(
        problem: FiniteProblem, before: float, share: float, start: Any, residuals: list[float], limits: Any
    ) -> Any:
        known = len(residuals)
        found = newton(problem, before, share, start, residuals, limits)
        tries.append((residuals[known:], found is not None))
        return found

    monkeypatch.setattr(finite_strain, "_newton", spied)
    overloaded = finite_problem(system, Theta(1e-8, 0.5, 60.0), MATERIAL)
    state = deform(overloaded, most_steps=60)
    assert state.status is FiniteStatus.OUT_OF_STEPS
    assert 0 < state.share < 1
    failed = [each for each, balanced in tries if not balanced]
    assert len(failed) >= 2
    assert all(len(each) - 1 - int(np.argmin(each)) <= finite_strain._PATIENCE for each in failed)
    assert any(len(each) < finite_strain._MAX_NEWTON for each in failed)
    short = deform(overloaded, most_steps=20)  # 7 steps for the first quarter, 10 at best for two more shares
    assert short.status is FiniteStatus.OUT_OF_STEPS
    assert short.share == 0.25


@pytest.mark.parametrize(
    ("rest", "step", "shares"), [(0.75, 0.5, 2), (0.5, 0.5, 1), (0.5, 0.25, 2), (0.75, 0.25, 2), (0.0, 0.5, 0)]
)
def test_steps_that_double_carry_the_rest_of_a_load(rest: float, step: float, shares: int) -> None:
    assert finite_strain._shares_at_best(rest, step) == shares
    assert step * (2**shares - 1) >= rest
    assert shares == 0 or step * (2 ** (shares - 1) - 1) < rest
