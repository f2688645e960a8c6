"""Model selection as a whole: what its parts are asked, and what is left out and why."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from poro.collapse import StrainMeasure as Strain
from poro.collapse.choice import StrainChoice
from poro.fem import Tissue
from poro.mesh import TetMesh
from registration.correspondences import Correspondences
from registration.volume import Array
from tests.vatsloc import ball_scene as scene
from tests.vatsloc.selection_scene import (
    GRAVITY,
    HILUM,
    HILUM_MM,
    a_fit,
    knows,
    mesh,
    motion,
    pairs_of,
)
from vatsloc.workflow import model_selection as module
from vatsloc.workflow.model_selection import (
    NO_CORRESPONDENCES,
    CollapseModel,
    Corrections,
    Refinement,
    fit_settings,
    select_model,
)
from vatsloc.workflow.settings import settings_of
from vatsloc.workflow.stages import Stages


@dataclass(frozen=True)
class System:
    """What model selection reads of the lung that is to collapse."""

    mesh: TetMesh
    hilum_displacement: Array | None = None
    gravity: Array = field(default_factory=lambda: GRAVITY)
    hilum: Array = field(default_factory=lambda: HILUM)
    tissue: Tissue = field(default_factory=Tissue)


class Selection:
    """`select_model` with a plain fit that knows 20 % of the collapse, and corrections that know all of it when shown
    all; whole_fields: False where these have to be held back at some nodes.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, pairs: Correspondences, whole_fields: bool = True) -> None:
        lung = mesh()
        self.plain = a_fit(0.1 * motion(lung.points))
        self.solid = a_fit(0.2 * motion(lung.points)).state
        self.asked: dict[str, tuple[Any, ...]] = {}
        self.stages = Stages()
        self.observed: Any = SimpleNamespace(
            model_mesh=lung,
            hilum_nodes=HILUM,
            motion=SimpleNamespace(displacement=HILUM_MM),
            surface=scene.air_surface(30),
        )
        self.others = np.full((4, *lung.points.shape), 2.0)
        system = System(lung)
        chosen = StrainChoice(self.solid, Strain.FINITE, "because", 0.01, None)
        for name, answer in (
            ("still_lung", system),
            ("fit_collapse", self.plain),
            ("keep_in_range", chosen),
            ("find_correspondences", pairs),
            ("perturbation_ensemble", self.others),
        ):
            monkeypatch.setattr(module, name, self._asked(name, answer))
        whole = len(pairs)

        def corrected(_strain: float, fields: Corrections) -> Any:
            assert fields.settings == fit_settings(self.settings)
            return lambda m, t, s: knows(1.0 if len(t.inflated) == whole else 0.7)(m, t, s)

        def refused(_strain: float, fields: Corrections) -> Any:
            assert fields.settings == fit_settings(self.settings)
            return lambda m, t, s: m

        monkeypatch.setattr(module, "corrected", corrected if whole_fields else refused)
        monkeypatch.setattr(module, "held_back", refused if whole_fields else corrected)

    def _asked(self, name: str, answer: Any) -> Any:
        def ask(*values: Any, **named: Any) -> Any:
            self.asked[name] = (*values, *named.values())
            return answer

        return ask

    def run(self, **tables: Any) -> CollapseModel:
        tables = {"model": {"regional": False}, **tables}
        self.settings = settings_of("balanced", tables)
        self.prepared: Any = object()
        return select_model(GRAVITY, self.prepared, self.observed, self.settings, self.stages)


def test_the_plain_fit_is_made_of_what_was_observed(monkeypatch: pytest.MonkeyPatch) -> None:
    known = Selection(monkeypatch, pairs_of())
    known.run()
    lung, _, gravity, hilum = known.asked["still_lung"]
    assert lung is known.observed.model_mesh
    assert_array_equal(gravity, GRAVITY)
    assert_array_equal(hilum, HILUM)
    assert_array_equal(known.asked["fit_collapse"][0].hilum_displacement, HILUM_MM)
    assert_array_equal(known.asked["fit_collapse"][1].points, known.observed.surface.points)
    assert known.asked["fit_collapse"][2] == fit_settings(known.settings)
    assert known.asked["keep_in_range"][1] is known.plain.state
    (choice,) = known.stages.choices
    assert (choice.part, choice.kept, choice.value, choice.limit) == ("finite strain", True, 0.01, 0.01)


def test_keypoints_are_matched_where_the_strain_measure_that_holds_puts_them(monkeypatch: pytest.MonkeyPatch) -> None:
    known = Selection(monkeypatch, pairs_of())
    model = known.run()
    prepared, observed, displacement, settings = known.asked["find_correspondences"]
    assert prepared is known.prepared
    assert observed is known.observed
    assert_array_equal(displacement, known.solid.u)
    assert settings == known.settings.keypoints
    lung = known.observed.model_mesh.points
    assert_allclose(model.displacement, motion(lung))
    assert_allclose(model.ensemble, -0.3 * motion(lung)[None], atol=1e-12)
    assert "perturbation_ensemble" not in known.asked
    assert [refinement.name for refinement in model.refinements] == [
        f"elastic correction, strain {s:g}" for s in (0.05, 0.025, 0.0125)
    ]
    assert sum(refinement.kept for refinement in model.refinements) == 1


@pytest.mark.parametrize(
    ("pairs", "tables", "skipped"),
    [
        (pairs_of(), {"keypoints": {"on": False}}, {"keypoints": "switched off in the settings"}),
        (pairs_of(20), {}, {"regional fit": "only 20 keypoints were matched inside the lung"}),
        (pairs_of(), {"model": {"regional": False, "correct": False}}, {}),
    ],
)
def test_without_a_refinement_the_plain_fit_stands_and_the_ensemble_says_how_sure_it_is(
    monkeypatch: pytest.MonkeyPatch, pairs: Correspondences, tables: dict[str, Any], skipped: dict[str, str]
) -> None:
    known = Selection(monkeypatch, pairs)
    model = known.run(**tables)
    assert_array_equal(model.displacement, known.solid.u)
    assert model.fit.state is known.solid
    assert model.refinements == ()
    assert known.stages.skipped == skipped
    assert_array_equal(model.ensemble, known.others)
    assert known.asked["perturbation_ensemble"][2] is known.plain
    assert len(model.correspondences) == (0 if "keypoints" in skipped else len(pairs))
    assert len(NO_CORRESPONDENCES) == 0


def test_a_fit_that_was_not_fitted_to_all_keypoints_has_the_ensemble_of_the_plain_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It differs by nothing from the training-only model, which would say that it is certain."""
    known = Selection(monkeypatch, pairs_of())

    def trial_stays(model: CollapseModel, *_: Any) -> tuple[CollapseModel, CollapseModel]:
        moved = 0.5 * motion(known.observed.model_mesh.points)
        trial = replace(model, displacement=moved, refinements=(Refinement("regional fit", 5.0, 2.0, True),))
        return trial, trial

    monkeypatch.setattr(module, "refined_model", trial_stays)
    assert_array_equal(known.run().ensemble, known.others)


@pytest.mark.parametrize(("model", "tried"), [({}, True), ({"regional": False}, False)])
def test_the_regional_fit_is_tried_unless_it_is_switched_off(
    monkeypatch: pytest.MonkeyPatch, model: dict[str, bool], tried: bool
) -> None:
    known = Selection(monkeypatch, pairs_of())
    monkeypatch.setattr(module, "_regional", lambda _system, _settings: lambda m, t, s: knows(0.9)(m, t, s))
    known.run(model=model)
    assert ("regional fit" in known.stages.seconds) is tried


def test_corrections_are_held_back_at_some_nodes_where_none_can_be_taken_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    known = Selection(monkeypatch, pairs_of(), whole_fields=False)
    model = known.run()
    assert_allclose(model.displacement, motion(known.observed.model_mesh.points))
    names = [f"elastic correction, strain {s:g}" for s in (0.05, 0.025, 0.0125)]
    assert [refinement.name for refinement in model.refinements] == [*names, *(f"{name}, held back" for name in names)]
    assert [refinement.kept for refinement in model.refinements[:3]] == [False, False, False]
    assert sum(refinement.kept for refinement in model.refinements) == 1
