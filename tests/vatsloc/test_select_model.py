"""Steps of model selection: what each is shown, which model it starts from, and what is kept."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from poro.collapse import Theta
from poro.fem import Tissue
from poro.fit import Fit, FitSettings, FitStatus, Target
from poro.mesh import TetMesh
from registration.volume import Array
from tests.vatsloc.selection_scene import (
    HILUM,
    a_fit,
    a_model,
    a_surface,
    knows,
    mesh,
    motion,
    pairs_of,
)
from vatsloc.imaging.surface import Border, SurfacePoints
from vatsloc.workflow import model_selection as module
from vatsloc.workflow.model_selection import (
    GAIN,
    CollapseModel,
    Corrections,
    Refinement,
    Step,
    _regional,
    corrected,
    fit_settings,
    held_back,
    held_out,
    select_refinement,
    surface_target,
    too_few,
)
from vatsloc.workflow.settings import settings_of


def test_held_out_keypoints_are_never_shown_to_the_model_that_is_judged_by_them() -> None:
    shown: list[tuple[CollapseModel, Target, Any]] = []

    def watched(model: CollapseModel, target: Target, start: Fit) -> CollapseModel:
        shown.append((model, target, start))
        return replace(
            model, displacement=(0.7 + 0.1 * len(shown)) * motion(model.system.mesh.points), fit=a_fit(0 * u)
        )

    start = a_model(0.2)
    u, surface = start.displacement, a_surface()
    training_only = replace(start, displacement=0.5 * u, fit=a_fit(u))
    model, trained = select_refinement({"step": watched}, start, training_only, surface)
    hidden = held_out(start.correspondences.fixed)
    assert 10 < hidden.sum() < len(hidden) - 10
    (one, few, from_one), (other, every, from_other) = shown
    assert (one, other) == (training_only, start)
    assert_array_equal(few.inflated, start.correspondences.moving[~hidden])
    assert_array_equal(few.deflated, start.correspondences.fixed[~hidden])
    assert_array_equal(few.keypoint_weights, np.ones((~hidden).sum()))
    assert_array_equal(every.inflated, start.correspondences.moving)
    assert_array_equal(every.deflated, start.correspondences.fixed)
    for target in (few, every):
        assert_array_equal(target.points, surface.points)
        assert_array_equal(target.normals, surface.normals)
    assert from_one is training_only.fit
    assert from_other is trained.fit
    assert_allclose(trained.displacement, 0.8 * motion(start.system.mesh.points))
    assert_allclose(model.displacement, 0.9 * motion(start.system.mesh.points))
    (refinement,) = model.refinements
    whole = np.linalg.norm(start.correspondences.fixed - start.correspondences.moving, axis=1)[hidden]
    assert refinement.before_mm == pytest.approx(
        0.9 * np.median(whole), rel=0.05
    )  # the training_only model knows 0.1 of it
    assert refinement.after_mm == pytest.approx(0.2 * np.median(whole), rel=0.05)
    assert refinement.kept


@pytest.mark.parametrize(("left", "kept"), [(GAIN + 0.01, False), (GAIN - 0.01, True)])
def test_a_refinement_has_to_gain_five_percent(left: float, kept: bool) -> None:
    start = a_model(0.0)
    model, training_only = select_refinement({"step": knows(1 - left)}, start, start, a_surface())
    (refinement,) = model.refinements
    assert refinement.after_mm / refinement.before_mm == pytest.approx(left, abs=1e-3)
    assert refinement.kept is kept
    assert model.held_out_mm == (refinement.after_mm if kept else refinement.before_mm)
    assert_array_equal(training_only.displacement, model.displacement)
    assert bool(model.displacement.any()) is kept


def test_the_best_is_taken_and_where_it_does_not_settle_the_next_best() -> None:
    start = a_model(0.0)
    loose = knows(0.9, fit=a_fit(start.displacement, settled=False))
    contact = knows(0.95, fit=replace(a_fit(start.displacement), status=FitStatus.CONTACT))
    steps = {"a": knows(0.5), "b": knows(0.8), "c": loose, "d": contact, "e": knows(0.6)}
    model, training_only = select_refinement(steps, start, start, a_surface())
    assert [(refinement.name, refinement.kept) for refinement in model.refinements] == [
        ("a", False),
        ("b", True),
        ("e", False),
    ]
    assert_allclose(model.displacement, 0.8 * motion(start.system.mesh.points))

    def only_training(model: CollapseModel, target: Target, begin: Fit) -> CollapseModel:
        whole = len(target.inflated) == len(start.correspondences)
        return replace(knows(0.9)(model, target, begin), fit=a_fit(start.displacement, settled=not whole))

    model, training_only = select_refinement({"f": only_training, **steps}, start, start, a_surface())
    assert [refinement.name for refinement in model.refinements if refinement.kept] == ["b"]
    assert_allclose(training_only.displacement, 0.8 * motion(start.system.mesh.points))


def test_where_nothing_settles_with_all_keypoints_the_best_trial_stays_if_it_may() -> None:
    start = a_model(0.0)

    def only_training(share: float) -> Step:
        def step(model: CollapseModel, target: Target, begin: Fit) -> CollapseModel:
            whole = len(target.inflated) == len(start.correspondences)
            return replace(knows(share)(model, target, begin), fit=a_fit(start.displacement, settled=not whole))

        return step

    steps = {"a": only_training(0.6), "b": only_training(0.9), "c": only_training(0.02)}
    without, _ = select_refinement(steps, start, start, a_surface())
    assert not any(refinement.kept for refinement in without.refinements)
    assert_array_equal(without.displacement, start.displacement)
    model, training_only = select_refinement(steps, start, start, a_surface(), or_trial=True)
    assert [refinement.name for refinement in model.refinements if refinement.kept] == ["b"]
    assert_allclose(model.displacement, 0.9 * motion(start.system.mesh.points))
    assert_array_equal(training_only.displacement, model.displacement)
    model, _ = select_refinement({"c": steps["c"]}, start, start, a_surface(), or_trial=True)
    assert not any(refinement.kept for refinement in model.refinements)


def test_refinements_add_up_and_the_last_one_kept_says_what_remains() -> None:
    model = a_model(refinements=(Refinement("a", 5.0, 4.0, True), Refinement("b", 4.0, 4.5, False)))
    assert model.held_out_mm == 4.0
    assert a_model(refinements=(Refinement("a", 5.0, 4.9, False),)).held_out_mm == 5.0
    assert a_model().held_out_mm is None
    again, _ = select_refinement({"c": knows(0.9)}, model, model, a_surface())
    assert [refinement.name for refinement in again.refinements] == ["a", "b", "c"]


def test_too_few_or_too_crowded_keypoints_judge_nothing() -> None:
    assert too_few(pairs_of()) is None
    assert too_few(pairs_of(39)) == "only 39 keypoints were matched inside the lung"
    many = pairs_of(2000)
    hidden, shown = np.flatnonzero(held_out(many.fixed)), np.flatnonzero(~held_out(many.fixed))
    for h, s in ((10, 30), (40, 10)):
        assert too_few(many.only(np.concatenate([hidden[:h], shown[:s]]))) is None
    for h, s in ((9, 31), (41, 9)):
        assert "too close together" in str(too_few(many.only(np.concatenate([hidden[:h], shown[:s]]))))


def test_every_border_but_a_fissure_is_a_target_with_its_own_confidence_and_normal() -> None:
    count = 12
    rng = np.random.default_rng(1)
    border = np.array([Border.AIR, Border.FISSURE, Border.CONTACT, Border.DENSE] * 3, dtype=np.int8)
    seen = SurfacePoints(rng.normal(size=(count, 3)), rng.normal(size=(count, 3)), rng.uniform(size=count), border)
    target = surface_target(seen)
    kept = np.flatnonzero(border != Border.FISSURE)
    assert_array_equal(target.points, seen.points[kept])
    assert_array_equal(target.normals, seen.normals[kept])
    assert_array_equal(target.weights, seen.confidence[kept])
    assert len(target.inflated) == 0
    for kind in Border:
        assert_array_equal(seen.only(kind).points, seen.points[border == kind])
        assert_array_equal(seen.only(kind).confidence, seen.confidence[border == kind])
        assert_array_equal(seen.only(kind).normals, seen.normals[border == kind])
        assert set(seen.only(kind).border) == {kind}


def test_settings_of_a_run_reach_the_fit() -> None:
    usual = fit_settings(settings_of("balanced"))
    assert (usual.plain, usual.free, usual.kappa_decades) == (False, (True, True, True), FitSettings.kappa_decades)
    tables = {"model": {"cost": "plain", "diaphragm": False, "max_steps": 7}, "keypoints": {"sigma_mm": 1.25}}
    paper = fit_settings(settings_of("balanced", tables), 2)
    assert (paper.plain, paper.free) == (True, (True, True, False, True, True))
    assert (paper.max_steps, paper.keypoint_sigma_mm, paper.kappa_decades) == (7, 1.25, np.inf)


@pytest.mark.parametrize(
    ("share", "before", "whole"),
    [(0.0005, 0.0, True), (0.002, 0.0, False), (0.002, 0.002, True), (0.004, 0.002, False)],
)
def test_a_correction_that_turns_more_elements_inside_out_is_refused_or_held_back_at_these_alone(
    monkeypatch: pytest.MonkeyPatch, share: float, before: float, whole: bool
) -> None:
    start = a_model(0.3)
    start = replace(start, fit=a_fit(start.displacement, tets=10000, inverted=before))
    mesh, point = start.system.mesh, 40
    field = np.full_like(start.displacement, 0.5)
    field[point] = 40.0
    asked: list[Any] = []

    def constraints_to(target: Target, lung: TetMesh, u: Array, settings: FitSettings) -> str:
        asked.append((target, lung, u, settings))
        return "constraints"

    def loosened(lung: TetMesh, u: Array, tissue: Any, wanted: Any, stiffest: float) -> Iterator[Any]:
        asked.append((lung, u, wanted, stiffest))
        for number in range(6):
            now = field if number == 5 else 0 * field
            yield SimpleNamespace(u=now, det_f=np.where(np.arange(10000) < share * 10000, -1.0, 1.0))

    monkeypatch.setattr(module, "constraints_to", constraints_to)
    monkeypatch.setattr(module, "loosened", loosened)
    target, settings = a_surface(), FitSettings(keypoint_sigma_mm=1.25)
    fields = Corrections(settings)
    found = corrected(0.025, fields)(start, target, start.fit)
    assert (found is not start) is whole
    if not whole:
        found = held_back(0.025, fields)(start, target, start.fit)
    moved = found.displacement - start.displacement
    around = (mesh.tets == point).any(axis=1)
    if whole:
        assert_allclose(moved, field)
    else:
        now = TetMesh(mesh.points + start.displacement, mesh.tets).volumes > 0
        after = TetMesh(mesh.points + found.displacement, mesh.tets).volumes > 0
        assert (after | ~now)[around].all()
        assert np.abs(moved[point]).max() < 40
        assert_allclose(moved[~np.isin(np.arange(len(moved)), mesh.tets[around])], 0.5)
    assert asked[0] == (target, start.system.mesh, start.displacement, settings)
    assert asked[1] == (start.system.mesh, start.displacement, "constraints", 0.0125 / 16)
    assert len(asked) == 2


@pytest.mark.parametrize(("hilum", "count"), [(True, 12), (False, 6)])
def test_the_regional_fit_sets_stretches_and_hilum_free_and_starts_where_it_is_told(
    monkeypatch: pytest.MonkeyPatch, hilum: bool, count: int
) -> None:
    @dataclass(frozen=True)
    class System:
        mesh: TetMesh
        hilum: Array
        tissue: Tissue
        modes: tuple[Any, ...] = ()

    start = replace(a_model(), system=System(mesh(), HILUM, Tissue()))  # type: ignore[arg-type]
    asked: list[tuple[Any, ...]] = []
    answer = a_fit(0.4 * motion(mesh().points))

    def fit(*values: Any) -> Any:
        asked.append(values)
        return answer

    monkeypatch.setattr(module, "fit_collapse", fit)
    target = a_surface()
    begin = replace(start.fit, theta=Theta(1e-9, 0.7, 4.0, (0.1, 0.2)))
    found = _regional(start.system, settings_of("balanced", {"model": {"hilum": hilum}}))(start, target, begin)
    ((system, seen, settings),) = asked
    assert seen is target
    assert len(system.modes) == count
    assert sum(mode.name.startswith("strain") for mode in system.modes) == 6
    assert len(settings.free) == 3 + count
    assert settings.starts == ((1e-9, 0.7, 4.0, 0.1, 0.2),)
    assert found.system is system
    assert found.fit is answer
    assert_array_equal(found.displacement, answer.state.u)
