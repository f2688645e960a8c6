"""A refinement is kept only when keypoints held out from it say so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from poro.collapse import Theta, assemble, keep_in_range, solve
from poro.fem import Tissue, neo_hookean
from poro.fit import Fit, FitSettings, Target, fit_collapse
from poro.mesh import TetMesh, stuff
from registration.correspondences import Correspondences
from vatsloc.workflow.ensemble import perturbation_ensemble
from vatsloc.workflow.model_selection import (
    NO_ENSEMBLE,
    CollapseModel,
    Corrections,
    Step,
    corrected,
    fit_settings,
    held_out,
    misfit,
    select_refinement,
)
from vatsloc.workflow.settings import settings_of

GRADIENT = np.array([[-0.1, 0.02, 0.0], [0.03, -0.05, 0.04], [0.0, -0.02, 0.08]])


@pytest.fixture(scope="module")
def lung() -> TetMesh:
    """An ellipsoid of 60, 70 and 80 mm half axes."""
    axes = np.array([60.0, 70.0, 80.0])
    shape = (30, 34, 38)
    affine = np.diag([5.0, 5.0, 5.0, 1.0])
    affine[:3, 3] = -2.5 * (np.array(shape) - 1)
    x = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1) * 5.0 + affine[:3, 3]
    return stuff(np.linalg.norm(x / axes, axis=-1) < 1, affine, 18.0)


@pytest.fixture(scope="module")
def surface(lung: TetMesh) -> Target:
    """Where the lung's surface goes under GRADIENT."""
    boundary = lung.boundary
    moved = boundary.moved(boundary.points @ (np.eye(3) + GRADIENT).T)
    return Target(moved.points, moved.node_normals, np.ones(len(moved.points)))


@pytest.fixture(scope="module")
def still(lung: TetMesh) -> CollapseModel:
    """A model that has not learned anything: everything stays where it is."""
    hilum = np.flatnonzero(np.linalg.norm(lung.points - [-50, 0, 0], axis=1) < 25)
    system = assemble(lung, Tissue(), np.array([1.0, 0, 0]), hilum, np.zeros((len(hilum), 3)))
    boundary = lung.boundary
    found: Fit = fit_collapse(system, Target(boundary.points, boundary.node_normals, np.ones(len(boundary.points))))
    nothing = np.zeros_like(lung.points)
    solid = keep_in_range(system, found.state, neo_hookean(Tissue()))
    return CollapseModel(
        system, replace(found, state=replace(found.state, u=nothing)), nothing, _pairs(), (), solid, NO_ENSEMBLE
    )


def _pairs(noise_mm: float = 0.0, smooth: bool = True) -> Correspondences:
    rng = np.random.default_rng(5)
    x = rng.uniform(-45, 45, (300, 3))
    motion = x @ GRADIENT.T if smooth else 0 * x
    return Correspondences.of(x + motion + noise_mm * rng.normal(size=x.shape), x)


def _steps() -> dict[str, Step]:
    return {f"strain {strain:g}": corrected(strain, Corrections(FitSettings())) for strain in (0.05, 0.0125)}


def test_misfit_is_the_median_distance(lung: TetMesh) -> None:
    shift = np.array([2.0, -1.0, 2.0])
    x = np.array([[0.0, 0, 0], [10, 5, 0], [-20, 3, 7]])
    y = x + shift + np.array([[0.0, 0, 0], [0, 4, 0], [0, 0, 30]])
    assert misfit(lung, np.broadcast_to(shift, lung.points.shape), Correspondences.of(y, x)) == pytest.approx(4.0)


def test_a_quarter_is_held_out_in_whole_blocks() -> None:
    points = np.random.default_rng(0).uniform(0, 400, (4000, 3))
    hidden = held_out(points)
    assert 0.15 < hidden.mean() < 0.35
    block = np.floor(points / 40).astype(int)
    _, number = np.unique(block, axis=0, return_inverse=True)
    share = np.bincount(number, hidden) / np.bincount(number)
    assert set(np.unique(share)) == {0.0, 1.0}


def test_a_refinement_that_predicts_what_it_has_not_seen_is_taken_and_follows_all_pairs(
    still: CollapseModel, surface: Target
) -> None:
    model, training_only = select_refinement(_steps(), still, still, surface)
    assert sum(refinement.kept for refinement in model.refinements) == 1
    best = min(model.refinements, key=lambda refinement: refinement.after_mm)
    assert best.kept
    assert best.before_mm == pytest.approx(
        np.median(np.linalg.norm(_pairs().moving @ GRADIENT.T, axis=1)[held_out(_pairs().fixed)])
    )
    assert model.held_out_mm == best.after_mm < 0.3 * best.before_mm
    mesh = still.system.mesh
    hidden = held_out(_pairs().fixed)
    assert misfit(mesh, model.displacement, _pairs().only(hidden)) < misfit(
        mesh, training_only.displacement, _pairs().only(hidden)
    )


def test_a_step_that_fails_with_all_pairs_gives_way_to_the_next_best(still: CollapseModel, surface: Target) -> None:
    everything = len(still.correspondences)

    def fails(model: CollapseModel, target: Target, start: Fit) -> CollapseModel:
        return (
            model
            if len(target.inflated) == everything
            else corrected(0.05, Corrections(FitSettings()))(model, target, start)
        )

    model, _ = select_refinement(
        {"fails": fails, "holds": corrected(0.0125, Corrections(FitSettings()))}, still, still, surface
    )
    assert {refinement.name: refinement.kept for refinement in model.refinements} == {"fails": False, "holds": True}
    assert np.abs(model.displacement).max() > 1.0


def test_the_standard_deviation_of_keypoints_in_the_settings_reaches_the_correction(
    still: CollapseModel, surface: Target
) -> None:
    """The surer they are said to be, the closer they are followed."""
    target = replace(
        surface,
        inflated=still.correspondences.moving,
        deflated=still.correspondences.fixed,
        keypoint_weights=np.ones(300),
    )
    left = []
    for sigma_mm in (0.5, 50.0):
        settings = fit_settings(settings_of("balanced", {"keypoints": {"sigma_mm": sigma_mm}}))
        found = corrected(0.05, Corrections(settings))(still, target, still.fit)
        left.append(misfit(still.system.mesh, found.displacement, still.correspondences))
    assert left[0] < 0.5 * left[1]


def test_noise_alone_is_not_worth_a_rung(still: CollapseModel) -> None:
    boundary = still.system.mesh.boundary
    stays = Target(boundary.points, boundary.node_normals, np.ones(len(boundary.points)))
    noisy = replace(still, correspondences=_pairs(noise_mm=2.0, smooth=False))
    model, training_only = select_refinement(_steps(), noisy, noisy, stays)
    assert [refinement.kept for refinement in model.refinements] == [False, False]
    assert_allclose(model.displacement, 0)
    assert_allclose(training_only.displacement, 0)


def test_the_ensemble_follow_the_inputs_and_agree_where_the_surface_tells_all(
    lung: TetMesh, still: CollapseModel
) -> None:
    system = still.system
    truth = solve(system, Theta(2e-8, 0.7, 0.0))
    boundary = lung.boundary.moved(lung.boundary.points + truth.u[lung.boundary.nodes])
    seen = Target(boundary.points, boundary.node_normals, np.ones(len(boundary.points)))
    settings = FitSettings(free=(True, True, False))
    best = fit_collapse(system, seen, settings)
    members = perturbation_ensemble(system, seen, best, settings)
    at_hilum = np.linalg.norm(members[:, system.hilum].mean(axis=1), axis=1)
    moved = members[np.abs(at_hilum - 3) < 1e-6]
    assert len(moved) == 3
    assert_allclose(np.abs(moved[:, system.hilum].mean(axis=1)), 3 * np.eye(3), atol=1e-6)
    held = members[at_hilum < 1e-6]
    assert len(held) >= 4
    # Starts and halves of a surface that the model explains end where the best fit did; only the two tilts differ.
    assert sorted(np.linalg.norm(held, axis=2).max(axis=1) > 0.5) == [False] * (len(held) - 2) + [True] * 2
