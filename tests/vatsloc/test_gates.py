"""Quality gates by value: each is fed by its own measurement, held against its own limit, on both sides of it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from poro.mesh import TetMesh
from registration.volume import Array, Mask
from tests.vatsloc import run_scene as known
from vatsloc.imaging.surface import Border
from vatsloc.workflow import localization
from vatsloc.workflow.gates import Gate
from vatsloc.workflow.model_selection import Refinement
from vatsloc.workflow.quality import (
    in_view,
    quality_gates,
    surface_distances,
    surface_percentiles,
    warn_of_unsure_tissue,
)
from vatsloc.workflow.settings import GateSettings, Settings
from vatsloc.workflow.stages import Stages

# What the scene below measures, by gate, and the limit that each one is held against.
MEASURED = {
    "overlap": (0.63, "min_overlap"),
    "spine_ct_inflated": (0.81, "min_spine_ncc"),
    "spine_inflated_deflated": (0.72, "min_spine_ncc"),
    "spine_slip_ct_inflated": (0.21, "min_spine_margin"),
    "spine_slip_inflated_deflated": (0.07, "min_spine_margin"),
    "registration_folds": (0.011, "max_folded_share"),
    "inverted_elements": (0.25, "max_inverted_elements"),
    "deflated_surface": (5, "min_surface_points"),
    "fissures": (2 / 7, "max_fissure_share"),
    "surface": (1.75, "max_surface_mm"),
    "held_out": (3.5, "max_held_out_mm"),
    "agreement": (0.75, "min_agreement"),
    "model_error": (2.5, "max_model_error_mm"),
}
SAYS = {
    "overlap": "too little of the lung",
    "spine": "do not match",
    "spine_slip": "slipped by a vertebra",
    "registration_folds": "folds space",
    "inverted_elements": "inside out",
    "deflated_surface": "Too little of the collapsed lung",
    "fissures": "Gas lies where the lung was",
    "surface": "stays off the observed one",
    "held_out": "does not predict",
    "agreement": "disagree",
    "model_error": "contradict the model",
}
LENIENT = GateSettings(
    **{limit: 0 if limit.startswith("min") else 1e9 for limit in GateSettings.model_fields}  # type: ignore[arg-type]
)


@pytest.fixture(scope="module")
def scene() -> known.Scene:
    """The known run with every part that a gate looks at; a quarter of its tetrahedra are turned inside out."""
    base = known.scene().with_model(
        refinements=(Refinement("regional", 4.0, 3.5, True), Refinement("elastic", 3.5, 2.75, False)),
    )
    base = base.with_collapse(residual=known.corrected(base.pose.mesh_ct))
    mesh = base.collapse.mesh_before
    turned = np.arange(len(mesh.tets)) % 4 == 1
    tets = np.where(turned[:, None], mesh.tets[:, [0, 2, 1, 3]], mesh.tets)
    return base.with_observed(mesh_before=TetMesh(mesh.points, tets))


def gates_of(scene: known.Scene, limits: GateSettings = LENIENT) -> dict[str, Gate]:
    return quality_gates(scene.pose, scene.collapse, limits)


def failed(gates: dict[str, Gate]) -> set[str]:
    return {name for name, gate in gates.items() if not gate.ok}


def test_each_gate_holds_what_was_measured_for_it(scene: known.Scene) -> None:
    gates = gates_of(scene)
    assert set(gates) == set(MEASURED)
    for name, (value, _) in MEASURED.items():
        assert gates[name].value == pytest.approx(value), name
    assert failed(gates) == set()


def test_each_gate_says_what_its_own_failure_means(scene: known.Scene) -> None:
    for name, gate in gates_of(scene).items():
        kind = name.removesuffix("_ct_inflated").removesuffix("_inflated_deflated")
        assert SAYS[kind] in gate.says


@pytest.mark.parametrize("name", MEASURED)
def test_each_gate_passes_at_its_own_limit_and_fails_beyond(scene: known.Scene, name: str) -> None:
    _, limit = MEASURED[name]
    value = gates_of(scene)[name].value
    stricter = 1 if limit.startswith("min") else -1
    beyond = value + stricter * (1 if limit == "min_surface_points" else 1e-9)
    held = gates_of(scene, LENIENT.model_copy(update={limit: value}))
    stopped = gates_of(scene, LENIENT.model_copy(update={limit: beyond}))
    assert held[name].ok
    assert held[name].limit == value
    # Two spines share a limit: beyond it the worse one fails as well.
    others = {n for n, (v, of) in MEASURED.items() if of == limit and (v - MEASURED[name][0]) * stricter < -1e-6}
    assert failed(held) == others
    assert failed(stopped) == others | {name}


def test_limits_are_those_of_the_documentation() -> None:
    assert GateSettings().model_dump() == {
        "min_overlap": 0.40,
        "min_spine_ncc": 0.5,
        "min_spine_margin": 0.02,
        "max_folded_share": 0.0,
        "max_inversion_mm": 1.0,
        "max_inverted_elements": 0.01,
        "max_surface_mm": 2.5,
        "min_surface_points": 200,
        "max_fissure_share": 0.1,
        "min_agreement": 0.5,
        "max_model_error_mm": 10.0,
        "max_held_out_mm": 5.0,
        "max_ellipsoid_mm": 15.0,
        "max_out_of_view_mm": 10.0,
        "max_left_over_mm": 4.0,
        "min_recognized": 0.15,
    }


def test_a_slipped_spine_is_one_whose_runner_up_is_nearly_as_good(scene: known.Scene) -> None:
    limits = GateSettings()
    for runner_up, slipped in ((0.60, False), (0.789, False), (0.791, True), (0.85, True)):
        pose = replace(scene.pose, rigid=replace(scene.pose.rigid, runner_up_ncc=runner_up))
        gate = quality_gates(pose, scene.collapse, limits)["spine_slip_ct_inflated"]
        assert gate.ok is not slipped
        assert gate.value == pytest.approx(0.81 - runner_up)


def test_flat_elements_count_as_inverted(scene: known.Scene) -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    cloud = np.concatenate([np.add(corners, [3.0 * n, 0, 0]) for n in range(5)])
    after = cloud.copy()
    after[7] = [3.4, 0.4, 0.0]
    after[11, 2] = -0.1
    mesh = TetMesh(cloud, np.arange(20).reshape(5, 4))
    other = scene.with_observed(mesh_before=mesh).with_collapse(points_after=after)
    assert gates_of(other)["inverted_elements"].value == pytest.approx(2 / 5)


def test_parts_that_did_not_run_have_no_gates(scene: known.Scene) -> None:
    every = set(MEASURED)
    assert set(gates_of(scene.with_pose(ffd=None))) == every - {"registration_folds"}
    assert set(gates_of(scene.with_collapse(residual=None))) == every - {"agreement", "model_error"}
    assert set(gates_of(scene.with_model(refinements=()))) == every - {"held_out"}


def test_held_out_misfit_is_that_of_the_last_step_taken(scene: known.Scene) -> None:
    for kept, expected in (((False, False), 4.0), ((True, False), 3.5), ((True, True), 2.75), ((False, True), 2.75)):
        refinements = (Refinement("regional", 4.0, 3.5, kept[0]), Refinement("elastic", 3.5, 2.75, kept[1]))
        assert gates_of(scene.with_model(refinements=refinements))["held_out"].value == expected


def test_where_no_air_is_seen_surface_gates_fail(scene: known.Scene) -> None:
    surface = scene.collapse.observed.surface
    bare = scene.with_observed(surface=surface.only(Border.CONTACT, Border.DENSE))
    assert_allclose(surface_distances(bare.collapse), [np.inf])
    assert surface_percentiles(bare.collapse) == dict.fromkeys(("p50", "p75", "p90", "p95"), np.inf)
    gates = gates_of(bare, GateSettings())
    assert (gates["surface"].ok, gates["deflated_surface"].ok) == (False, False)
    assert gates["fissures"].value == 0


def test_surface_distances_are_from_the_collapsed_lung_whichever_side_the_air_is_seen_on(scene: known.Scene) -> None:
    assert_allclose(surface_distances(known.scene().collapse), np.abs(known.OFF_SURFACE_MM), atol=1e-9)


VIEWS = {"inflated": (known.INFLATED_GRID, known.NODULE_INF), "deflated": (known.DEFLATED_GRID, known.NODULE_DEF)}


@pytest.mark.parametrize("image", VIEWS)
@pytest.mark.parametrize(("limit_mm", "ok"), [(7.001, True), (6.999, False)])
def test_a_nodule_out_of_either_view_is_measured_in_that_image(image: str, limit_mm: float, ok: bool) -> None:
    whole = {
        name: (Mask(np.ones(grid.shape, bool), grid.ras_from_ijk), nodule) for name, (grid, nodule) in VIEWS.items()
    }
    grid, _ = VIEWS[image]
    edge = grid.to_ras(np.array([0.0, 5.0, 5.0]))
    outward = -grid.ras_from_ijk[:3, 0] / grid.spacing[0]
    log = Stages()
    gate = in_view(whole | {image: (whole[image][0], edge + 7.0 * outward)}, limit_mm, log)
    assert gate.value == pytest.approx(7.0)
    assert gate.limit == limit_mm
    assert gate.ok is ok
    assert "out of a CBCT's view" in gate.says
    (warning,) = log.warnings
    assert warning.startswith(f"The nodule lies 7 mm out of what the {image} CBCT shows")


def test_of_two_views_the_worse_counts_and_both_are_warned_of() -> None:
    point = Mask(np.ones((1, 1, 1), bool), np.eye(4))
    for inflated, deflated in ((3.0, 5.0), (5.0, 3.0)):
        log = Stages()
        shown = {"inflated": (point, np.array([inflated, 0, 0])), "deflated": (point, np.array([0, deflated, 0]))}
        assert in_view(shown, 4.0, log).value == 5.0
        for warning, name, mm in zip(log.warnings, shown, (inflated, deflated), strict=True):
            assert warning.startswith(f"The nodule lies {mm:.0f} mm out of what the {name} CBCT shows")
    log = Stages()
    gate = in_view({"inflated": (point, np.zeros(3)), "deflated": (point, np.zeros(3))}, 0.0, log)
    assert (gate.ok, gate.value, log.warnings) == (True, 0.0, [])


def unsure(mesh: TetMesh, seen: Array, radius_mm: Array) -> list[str]:
    """The warnings for a lung whose nodes are known to `radius_mm`."""
    stages = Stages()
    warn_of_unsure_tissue(mesh, seen, radius_mm, stages)
    return stages.warnings


def test_tissue_near_the_pleura_that_is_badly_known_is_told() -> None:
    mesh = known.ball_mesh(np.zeros(3), 40.0, 10.0)
    near, east = mesh.node_depths <= 10, mesh.points[:, 0]
    order = np.argsort(-east)
    share = np.cumsum(np.where(near, mesh.node_volumes, 0)[order]) / mesh.node_volumes[near].sum()
    cap = {part: east >= east[order[np.searchsorted(share, part)]] for part in (0.2, 0.35)}
    everywhere = np.ones(len(east), dtype=bool)

    (warning,) = unsure(mesh, everywhere, np.where(cap[0.35], 17.2, 3.0))
    assert "more than 17 mm" in warning
    assert not unsure(mesh, everywhere, np.where(cap[0.2], 17.2, 3.0)), "less than a quarter"
    assert not unsure(mesh, everywhere, np.where(cap[0.35], 11.5, 3.0)), "known well enough"
    assert not unsure(mesh, ~cap[0.35], np.where(cap[0.35], 17.2, 3.0)), "out of view"
    assert not unsure(mesh, everywhere, np.where(near, 3.0, 99.0)), "deeper than any that cannot be felt"
    assert not unsure(mesh, ~everywhere, np.full(len(east), 99.0)), "none in view"


def test_a_run_that_has_checked_itself_tells_it_and_keeps_the_radius(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = known.scene()
    radius = np.full(len(scene.pose.mesh_ct.points), 40.0)
    for name, given in {"compare": None, "check_gates": {}, "covariance": np.eye(3)[None], "radius95": radius}.items():
        monkeypatch.setattr(localization, name, lambda *_asked, given=given: given)
    monkeypatch.setattr(localization, "Checks", lambda phase1, chain: SimpleNamespace(phase1=phase1, chain=chain))
    before = localization.Localization(
        scene.prepared, scene.pose, scene.collapse, known.NODULE_INF, known.NODULE_DEF, np.ones(3), np.eye(3), {}
    )
    stages = Stages()
    found = localization.checked(scene.case, before, Settings(), stages)
    assert found.radius95_mm is radius
    assert ["more than 40 mm" in warning for warning in stages.warnings] == [True]
