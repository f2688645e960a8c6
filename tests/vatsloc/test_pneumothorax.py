"""How phase 2 is put together: which displacement goes where, in which frame, and what a choice leaves out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from poro.mesh import TetMesh
from registration.correspondences import Correspondences
from registration.volume import Array
from tests.vatsloc import ball_scene as scene
from vatsloc.workflow import pneumothorax as module
from vatsloc.workflow.model_selection import CollapseModel, Refinement
from vatsloc.workflow.pneumothorax import (
    REFINEMENT,
    RESIDUAL,
    Collapse,
    begin_refinement,
    collapse,
    contact_surface,
    refined,
)
from vatsloc.workflow.pose import ChangeOfPose
from vatsloc.workflow.refinement import BlockRefinement, Compared, Shape
from vatsloc.workflow.residual import Residual
from vatsloc.workflow.seen_fissure import PIECES
from vatsloc.workflow.settings import RefinementSettings, settings_of
from vatsloc.workflow.stages import Stages

TRIED = Refinement("regional fit", 3.0, 2.0, False)
KEPT = Refinement("elastic correction", 3.0, 1.2, True)


class Parts:
    """A pose, what was observed and a model that moves its own, coarser mesh by the scene's affine collapse."""

    def __init__(self, refinements: Sequence[Refinement] = ()) -> None:
        mesh, both = scene.lung_mesh(), (scene.INF_FROM_CT, scene.DEF_FROM_INF)
        inflated, before = scene.placed(mesh, *both[:1]), scene.placed(mesh, *both)
        coarse = scene.placed(scene.lung_mesh(7.0), *both)
        count = len(mesh.points)
        self.pose: Any = ChangeOfPose(
            scene.rigid_fit(scene.INF_FROM_CT.inverse()),
            None,
            scene.empty(scene.inflated()),
            mesh,
            inflated.points,
            np.ones(count, bool),
            None,
            None,
            1.0,
        )
        self.before, self.inflated, self.prepared, self.stages = before, inflated, scene.prepared(), Stages()
        self.observed: Any = SimpleNamespace(
            mesh_before=before,
            model_mesh=coarse,
            def_from_inf_rigid=scene.DEF_FROM_INF,
            found=scene.pneumothorax(),
            surface=scene.air_surface(40),
        )
        places = scene.CENTRE_DEF + np.random.default_rng(7).uniform(-20, 20, (9, 3))
        self.pairs = Correspondences.of(scene.collapsed(places), places, ncc=np.linspace(0.6, 1, 9))
        system: Any = SimpleNamespace(mesh=coarse)
        nothing: Any = None
        moved = scene.collapsed(coarse.points) - coarse.points
        self.model = CollapseModel(system, nothing, moved, self.pairs, tuple(refinements), nothing, np.zeros((0, 0, 3)))
        self.asked: list[tuple[Any, ...]] = []
        self.refined: list[tuple[Compared, Shape]] = []
        self.off = np.zeros(3)

    def run(self, monkeypatch: pytest.MonkeyPatch, images: Residual | None, **tables: Any) -> Collapse:
        case: Any = SimpleNamespace(gravity_ras=np.array([1.0, 0, 0]), ct=scene.ct())
        settings = settings_of("balanced", tables)

        def select_model(gravity: Array, *rest: Any) -> CollapseModel:
            assert_array_equal(gravity, case.gravity_ras)
            assert rest == (self.prepared, self.observed, settings, self.stages)
            return self.model

        def correct(*values: Any) -> Residual | None:
            self.asked.append(values)
            return images

        def ready(compared: Compared, rest: TetMesh, chosen: RefinementSettings) -> Compared:
            assert rest is self.before
            assert chosen == settings.refinement
            return compared

        def refine(compared: Compared, shape: Shape) -> BlockRefinement:
            self.refined.append((compared, shape))
            return BlockRefinement(shape.map.moved + self.off, ())

        monkeypatch.setattr(module, "prospect", ready)
        monkeypatch.setattr(module, "refine_by_blocks", refine)
        monkeypatch.setattr(module, "select_model", select_model)
        monkeypatch.setattr(module, "residual_registration", correct)
        found = collapse(case, self.prepared, self.pose, self.observed, settings, self.stages)
        return refined(case, self.prepared, self.pose, found, settings, self.stages)


def correction(parts: Parts) -> Residual:
    nodes = len(parts.before.points)
    off = np.random.default_rng(3).normal(size=(nodes, 3))
    return Residual(off, np.ones(nodes, bool), np.ones(nodes, bool), np.zeros(nodes), 0.5)


def test_the_lungs_nodes_go_where_the_models_displacement_and_then_the_images_take_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    parts = Parts()
    images = correction(parts)
    found = parts.run(monkeypatch, images)
    inner = scene.inner_nodes(parts.before, scene.CENTRE_DEF, 35.0)
    truth = scene.collapsed(parts.before.points)
    assert_allclose((found.points_after - images.displacement)[inner], truth[inner], atol=1e-6)
    assert_array_equal(found.mesh_after.points, found.points_after)
    assert_array_equal(found.mesh_after.tets, parts.before.tets)
    assert found.residual is images
    assert list(parts.stages.seconds) == [RESIDUAL, REFINEMENT]


@pytest.mark.parametrize(("refinements", "begun"), [((), False), ((TRIED,), False), ((TRIED, KEPT), True)])
def test_a_fissure_is_looked_for_beside_the_images_where_the_model_follows_keypoints(
    monkeypatch: pytest.MonkeyPatch, refinements: tuple[Refinement, ...], begun: bool
) -> None:
    parts = Parts(refinements)
    monkeypatch.setattr(module, "seen_fissure", lambda *given: given)
    with parts.stages.beside():
        parts.run(monkeypatch, None)
        with parts.stages.stage(PIECES):
            given = parts.stages.done(lambda: None)
    assert (given is not None) is begun
    if given is not None:
        assert given == (parts.pose, parts.observed, parts.model.correspondences)


def test_the_residual_registration_is_asked_in_the_frames_of_the_scans(monkeypatch: pytest.MonkeyPatch) -> None:
    parts = Parts()
    parts.run(monkeypatch, None)
    ((prepared, lung, model, before, surface, settings, pairs),) = parts.asked
    assert prepared is parts.prepared
    assert lung is parts.observed.found.lung
    assert before is parts.before
    assert surface is parts.observed.surface
    assert settings == settings_of("balanced").residual
    assert_allclose(scene.DEF_FROM_INF(pairs.moving), parts.pairs.moving)
    assert_array_equal(pairs.fixed, parts.pairs.fixed)
    assert_array_equal(pairs.ncc, parts.pairs.ncc)
    assert_allclose(model(pairs.moving), pairs.fixed, atol=1e-6)
    far = np.array([[300.0, -200.0, 100.0]])
    assert np.linalg.norm(model(far) - scene.DEF_FROM_INF(far)) < 20.0  # the rigid part is that of the spines
    assert_array_equal(model.mesh.points, parts.inflated.points)


@pytest.mark.parametrize(
    ("refinements", "asked", "levels"), [((), 3, 3), ((TRIED,), 3, 3), ((TRIED, KEPT), 3, 2), ((KEPT,), 1, 1)]
)
def test_a_model_that_follows_places_needs_one_level_less(
    monkeypatch: pytest.MonkeyPatch, refinements: tuple[Refinement, ...], asked: int, levels: int
) -> None:
    parts = Parts(refinements)
    parts.run(monkeypatch, None, residual={"levels": asked}, leave_out={"residual_mm": -1.0})
    assert parts.asked[0][5].levels == levels


def test_without_images_the_answer_is_the_models(monkeypatch: pytest.MonkeyPatch) -> None:
    parts = Parts()
    inner = scene.inner_nodes(parts.before, scene.CENTRE_DEF, 35.0)
    truth = scene.collapsed(parts.before.points)
    found = parts.run(monkeypatch, None)
    assert found.residual is None
    assert RESIDUAL not in parts.stages.skipped
    assert_allclose(found.points_after[inner], truth[inner], atol=1e-6)
    off = Parts()
    found = off.run(monkeypatch, correction(off), residual={"on": False})
    assert (found.residual, off.asked) == (None, [])
    assert off.stages.skipped == {RESIDUAL: "switched off in the settings"}
    assert_allclose(found.points_after[inner], truth[inner], atol=1e-6)


@pytest.mark.parametrize(
    ("refinements", "limit", "kept"),
    [((KEPT,), 1.1, True), ((KEPT,), 1.3, False), ((TRIED,), 2.9, True), ((), 90.0, True)],
)
def test_a_model_that_predicts_unseen_places_makes_the_images_superfluous(
    monkeypatch: pytest.MonkeyPatch, refinements: tuple[Refinement, ...], limit: float, kept: bool
) -> None:
    parts = Parts(refinements)
    found = parts.run(monkeypatch, correction(parts), leave_out={"residual_mm": limit})
    assert (found.residual is not None) is kept
    (choice,) = parts.stages.choices
    assert (choice.part, choice.kept, choice.limit) == (RESIDUAL, kept, limit)
    assert choice.value == (parts.model.held_out_mm if refinements else np.inf)
    assert (RESIDUAL in parts.stages.skipped) is not kept


def test_blocks_of_the_ct_refine_what_model_and_images_made(monkeypatch: pytest.MonkeyPatch) -> None:
    parts = Parts()
    parts.off = np.array([1.0, -2.0, 0.5])
    images = correction(parts)
    found = parts.run(monkeypatch, images)
    ((compared, shape),) = parts.refined
    assert compared.ct is scene.ct()
    assert compared.lung_ct is parts.prepared.lung_ct
    assert compared.scan is parts.prepared.deflated
    assert compared.lung is parts.observed.found.lung
    assert shape.rest is parts.before
    assert shape.map.mesh is parts.pose.mesh_ct
    assert_allclose(shape.map.around.matrix, (scene.DEF_FROM_INF @ scene.INF_FROM_CT).matrix, atol=1e-12)
    assert (len(shape.anchors), shape.within_mm, shape.cut, shape.piece) == (0, np.inf, None, None)
    inner = scene.inner_nodes(parts.before, scene.CENTRE_DEF, 35.0)
    truth = scene.collapsed(parts.before.points)
    assert_allclose((shape.map.moved - images.displacement)[inner], truth[inner], atol=1e-6)
    assert_array_equal(found.points_after, shape.map.moved + parts.off)
    assert found.refinement is not None


def test_blocks_of_a_cut_lung_know_the_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    parts = Parts()
    found = parts.run(monkeypatch, None)
    cut: Any = SimpleNamespace(
        fissure=SimpleNamespace(sheet=SimpleNamespace(distance=lambda points: points[:, 2])),
        pieces=SimpleNamespace(node_piece=lambda: np.array([0, 1])),
    )
    case: Any = SimpleNamespace(ct=scene.ct())
    refined(case, parts.prepared, parts.pose, replace(found, parted=cut), settings_of("balanced", {}), parts.stages)
    shape = parts.refined[-1][1]
    assert shape.cut is not None
    assert_array_equal(shape.cut(np.array([[1.0, 2.0, 3.0]])), [3.0])
    assert_array_equal(shape.piece, [0, 1])


def test_a_refinement_that_is_switched_off_is_not_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    parts = Parts()
    found = parts.run(monkeypatch, None, refinement={"on": False})
    assert (found.refinement, parts.refined) == (None, [])
    assert parts.stages.skipped == {REFINEMENT: "switched off in the settings"}


def test_a_collapse_shows_its_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    parts = Parts()
    found = parts.run(monkeypatch, None)
    assert found.def_from_inf_rigid is scene.DEF_FROM_INF
    assert found.mesh_before is parts.before
    assert found.system is parts.model.system
    assert_array_equal(contact_surface(found).points, parts.before.boundary.points)
    coarse: TetMesh = parts.observed.model_mesh
    inner = scene.inner_nodes(parts.before, scene.CENTRE_DEF, 35.0)
    assert_allclose(found.on_lung(coarse.points)[inner], parts.before.points[inner], atol=1e-6)


def test_what_the_images_alone_tell_is_begun_beside_the_model(monkeypatch: pytest.MonkeyPatch) -> None:
    given: Any = tuple(object() for _ in range(3))
    stages = Stages()
    monkeypatch.setattr(module, "_prospect", lambda *values: values)
    for on in (False, True):
        settings = settings_of("balanced", {"refinement": {"on": on}})
        with stages.beside():
            begin_refinement(*given, settings, stages)
            with stages.stage(REFINEMENT):
                assert stages.done(lambda: None) == ((*given, settings) if on else None)
