"""Change of pose by value: what is registered to what, which nodes are seen, and how the others follow."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from poro.mesh import closest_points
from registration.correspondences import Correspondences
from registration.maps.inversion import Inversion, invert_at
from registration.sliding import moved_mm
from registration.volume import Array, Mask
from tests.vatsloc import ball_scene as scene
from vatsloc.errors import InputRefused
from vatsloc.workflow import pose as module
from vatsloc.workflow.pose import (
    FIRST,
    ChangeOfPose,
    _deep_inside,
    _hinted,
    as_side,
    change_of_pose,
    ffd_settings,
    moved_far,
)
from vatsloc.workflow.refinement import BlockRefinement
from vatsloc.workflow.settings import settings_of
from vatsloc.workflow.stages import Stages

CT_FROM_INF = scene.INF_FROM_CT.inverse()
STRETCH = np.array([[1.05, 0.02, 0.0], [0.0, 0.97, -0.03], [0.01, 0.0, 1.03]])
SHIFT = np.array([3.0, -2.0, 4.0])
PLANE = scene.CENTRE_INF[0] + 6.0
COARSE = {"mesh": {"edge_mm": 12.0}}
NO_HINTS = SimpleNamespace(spine_ct_ras=None, spine_cbct_inflated_ras=None)


def moved(points_ct: Array) -> Array:
    """Where the tissue of the CT lies in the inflated CBCT."""
    placed = scene.INF_FROM_CT(points_ct)
    return np.asarray(scene.CENTRE_INF + SHIFT + (placed - scene.CENTRE_INF) @ STRETCH.T)


def moved_back(points_inf: Array) -> Array:
    return CT_FROM_INF(scene.CENTRE_INF + (points_inf - scene.CENTRE_INF - SHIFT) @ np.linalg.inv(STRETCH).T)


class Watched:
    """`change_of_pose` with known answers from everything that reads images; `asked` holds the questions."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, half: bool = True, hints: Any = NO_HINTS) -> None:
        usable = scene.inflated().grid.points()[..., 0] < PLANE if half else None
        self.prepared, self.stages, self.asked = scene.prepared(usable), Stages(), dict[str, tuple[Any, ...]]()
        self.case: Any = SimpleNamespace(ct=scene.ct(), side="right", hints=hints)
        self.prior, self.lung_inf = object(), scene.empty(scene.inflated())
        self.fit: Any = scene.sliding_fit(50, 0.0, moved_back)
        self.off, self.prospect = np.zeros(3), object()
        for name, answer in (
            ("register_spine", scene.rigid_fit(CT_FROM_INF)),
            ("carry_prior", self.prior),
            ("inflated_lung", self.lung_inf),
            ("prospect", self.prospect),
        ):
            monkeypatch.setattr(module, name, self._asked(name, answer))

        monkeypatch.setattr(module, "refine_by_blocks", self._refine)

    def _refine(self, *values: Any) -> BlockRefinement:
        self.asked["refine_by_blocks"] = values
        return BlockRefinement(values[1].map.moved + self.off, ())

    def _asked(self, name: str, answer: Any) -> Any:
        def ask(*values: Any, **named: Any) -> Any:
            self.asked[name] = (*values, named)
            return answer

        return ask

    def run(self, **tables: Any) -> ChangeOfPose:
        register = self._asked("register", self.fit)
        return change_of_pose(
            self.case, self.prepared, settings_of("balanced", COARSE, tables), self.stages, register=register
        )


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> Watched:
    return Watched(monkeypatch)


def test_spines_are_registered_inflated_to_ct(watched: Watched) -> None:
    found = watched.run()
    fixed, moving, fixed_spine, moving_spine, named = watched.asked["register_spine"]
    assert fixed is watched.prepared.inflated.volume
    assert moving is watched.case.ct
    assert fixed_spine is watched.prepared.spine_inflated.mask
    assert moving_spine is watched.prepared.spine_ct.mask
    assert named["fixed_seen"] is watched.prepared.inflated.field.usable
    assert (named["initial"], named["search"]) == (None, None)
    assert_allclose(found.inf_from_ct_rigid.matrix, scene.INF_FROM_CT.matrix, atol=1e-12)


def test_the_lung_is_registered_inflated_to_ct_from_the_spines_pose(watched: Watched) -> None:
    found = watched.run()
    lungs, side, volume, back, _ = watched.asked["carry_prior"]
    assert (lungs, side, volume) == (watched.prepared.lungs, "right", watched.prepared.inflated.volume)
    assert_allclose(back.matrix, CT_FROM_INF.matrix)
    assert watched.asked["inflated_lung"][:2] == (watched.prepared.inflated, watched.prior)
    fixed, moving, settings, prior, named = watched.asked["register"]
    assert fixed.volume is watched.prepared.inflated.volume
    assert moving.volume is watched.case.ct
    assert moving.lung is watched.prepared.lung_ct
    assert settings == ffd_settings(settings_of("balanced").registration)
    assert fixed.lung is watched.lung_inf is found.lung_inf
    assert fixed.seen is watched.prepared.inflated.field.usable
    assert moving.seen is None
    assert_allclose(prior.matrix, CT_FROM_INF.matrix)
    assert named["coarse_beyond_mm"] == -1.0
    (choice,) = (choice for choice in watched.stages.choices if choice.part == FIRST)
    # 0 mm, but balanced keeps the first registration in every case.
    assert (choice.kept, choice.value, choice.limit) == (True, 0.0, -1.0)
    assert found.ffd is watched.fit


def test_seen_nodes_go_where_the_inverted_field_says_and_the_others_go_on_smoothly(watched: Watched) -> None:
    found = watched.run()
    truth, placed = moved(found.mesh_ct.points), scene.INF_FROM_CT(found.mesh_ct.points)
    assert np.linalg.norm(truth - placed, axis=1).mean() > 4.0
    assert found.seen[truth[:, 0] < PLANE - 7.0].mean() > 0.5
    view = watched.prepared.inflated.field.usable.grid
    low, high = view.to_ras(np.full(3, -0.5)), view.to_ras(np.array(view.shape) - 0.5)
    rim = np.minimum(truth - low, high - truth).min(axis=1)
    deep = np.minimum(rim, PLANE - truth[:, 0])
    assert found.seen[deep > 7.0].all()
    assert not found.seen[deep < 0.0].any()
    assert 0.2 < found.seen.mean() < 0.9
    error = np.linalg.norm(found.points_inf - truth, axis=1)
    assert error[found.seen].mean() < 0.1
    assert error.max() < 1.5
    assert_array_equal(found.mesh_inf.points, found.points_inf)
    assert_array_equal(found.mesh_inf.tets, found.mesh_ct.tets)
    inner = scene.CENTRE_CT + np.array([[-10.0, 5, 4], [0, 0, 0]])
    assert_allclose(found.inf_from_ct(inner), moved(inner), atol=0.2)
    assert found.extrapolation is not None
    assert list(watched.stages.seconds) == [
        "spine CT to inflated",
        "inflated lung",
        "mesh",
        "free-form deformation",
        "inversion and extrapolation",
        "block refinement, inflated",
    ]


def test_blocks_near_the_pleura_refine_the_pose_and_deep_seen_nodes_stay(watched: Watched) -> None:
    watched.off = np.array([0.5, 1.0, -2.0])
    found = watched.run()
    compared, rest, settings, _ = watched.asked["prospect"]
    prospect, shape = watched.asked["refine_by_blocks"]
    assert prospect is watched.prospect
    assert rest is shape.rest
    assert (compared.ct, compared.lung_ct) == (watched.case.ct, watched.prepared.lung_ct)
    assert (compared.scan, compared.lung) == (watched.prepared.inflated, watched.lung_inf)
    assert_allclose(shape.rest.points, scene.INF_FROM_CT(found.mesh_ct.points))
    assert shape.map.mesh is found.mesh_ct
    depth = scene.RADIUS_MM - np.linalg.norm(found.mesh_ct.points - scene.CENTRE_CT, axis=1)
    assert_array_equal(np.isin(np.arange(len(depth)), shape.anchors)[depth > 18.0], found.seen[depth > 18.0])
    assert not (depth[shape.anchors] < 14.0).any()
    assert shape.within_mm == 16.0
    assert_array_equal(found.points_inf, shape.map.moved + watched.off)
    assert found.refinement is not None
    assert settings == settings_of("balanced").refinement


def test_without_the_refinement_the_pose_is_the_registrations(watched: Watched) -> None:
    found = watched.run(refinement={"on": False})
    assert found.refinement is None
    assert not {"prospect", "refine_by_blocks"} & set(watched.asked)
    assert watched.stages.skipped["block refinement, inflated"] == "switched off in the settings"


def test_the_mesh_fills_the_operated_lung_of_the_ct(watched: Watched) -> None:
    mesh = watched.run().mesh_ct
    assert_allclose(mesh.points.mean(axis=0), scene.CENTRE_CT, atol=1.0)
    assert_allclose(np.linalg.norm(mesh.boundary.points - scene.CENTRE_CT, axis=1), scene.RADIUS_MM, atol=3.0)


def test_what_is_seen_outweighs_what_is_not_and_what_did_not_settle_is_left_out(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: dict[str, Any] = {}

    def invert(mapping: Any, points: Array, start: Array) -> Inversion:
        assert_allclose(start, scene.INF_FROM_CT(points), atol=1e-9)
        exact = invert_at(mapping, points, start)
        asked["unsettled"] = np.arange(len(points)) % 9 == 0
        residual = np.where(asked["unsettled"], 1.1, 0.9)
        return Inversion(exact.points_fixed + 0.5 * asked["unsettled"][:, None], residual, 1)

    real = module.extrapolate

    def extrapolate(mesh: Any, nodes: Array, displacement: Array, tissue: Any, weights: Array) -> Any:
        asked.update(mesh=mesh, nodes=nodes, displacement=displacement, weights=weights)
        return real(mesh, nodes, displacement, tissue, weights)

    monkeypatch.setattr(module, "invert_at", invert)
    monkeypatch.setattr(module, "extrapolate", extrapolate)
    found = watched.run()
    points = found.mesh_ct.points
    assert (moved(points)[asked["unsettled"], 0] < PLANE - 10.0).any()  # some of them well in view
    assert_array_equal(asked["nodes"], np.flatnonzero(~asked["unsettled"]))
    assert not found.seen[asked["unsettled"]].any()
    wanted = (moved(points) - asked["mesh"].points)[asked["nodes"]]
    assert_allclose(asked["displacement"], wanted, atol=0.02)
    depth = -closest_points(found.mesh_ct.boundary, points).distance[asked["nodes"]]
    told, seen = 0.01 * 1e4 ** np.clip((depth - 4) / 12, 0, 1), found.seen[asked["nodes"]]
    assert_allclose(asked["weights"], np.where(seen, told, np.minimum(told, 1.0)))
    assert asked["weights"][seen & (depth >= 16)].min() == pytest.approx(100.0)
    assert asked["weights"][depth <= 4].max() == pytest.approx(0.01)


def test_with_all_of_the_lung_in_view_every_node_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    watched = Watched(monkeypatch, half=False)
    wide = scene.grid_about(scene.CENTRE_INF, 40, 4.0)
    seen = Mask(np.ones(wide.shape, bool), wide.ras_from_ijk)
    field = SimpleNamespace(usable=seen)
    prepared = watched.prepared
    watched.prepared = SimpleNamespace(  # type: ignore[assignment]
        lungs=prepared.lungs,
        lung_ct=prepared.lung_ct,
        inflated=SimpleNamespace(volume=prepared.inflated.volume, field=field),
        spine_ct=prepared.spine_ct,
        spine_inflated=prepared.spine_inflated,
    )
    found = watched.run()
    assert found.seen.all()
    assert found.overlap == 1.0
    assert found.extrapolation is not None
    assert np.linalg.norm(found.points_inf - moved(found.mesh_ct.points), axis=1).mean() < 0.1


def test_a_registration_that_is_switched_off_leaves_the_lung_to_the_spine(watched: Watched) -> None:
    found = watched.run(registration={"on": False})
    assert "register" not in watched.asked
    assert_allclose(found.points_inf, scene.INF_FROM_CT(found.mesh_ct.points), atol=1e-9)
    assert not found.seen.any()
    assert found.seen.shape == (len(found.mesh_ct.points),)
    assert (found.ffd, found.inversion, found.extrapolation) == (None, None, None)
    assert watched.stages.skipped == {"free-form deformation": "switched off in the settings"}


def test_the_overlap_is_the_share_of_the_lung_in_view_and_too_little_is_refused(watched: Watched) -> None:
    share = watched.run().overlap
    x = np.random.default_rng(0).uniform(-40, 40, (20000, 3))
    x = x[np.linalg.norm(x, axis=1) < scene.RADIUS_MM] + scene.CENTRE_INF
    assert share == pytest.approx((x[:, 0] < PLANE).mean(), abs=0.04)
    with pytest.raises(InputRefused, match="of the right lung, 80 % needed"):
        watched.run(gates={"min_overlap": 0.8})


def test_a_vertebra_marked_in_both_images_starts_the_search_there_and_narrows_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    marked = SimpleNamespace(
        spine_ct_ras=np.array([1.0, -50.0, 20.0]), spine_cbct_inflated_ras=np.array([11.0, -40.0, -100.0])
    )
    watched = Watched(monkeypatch, hints=marked)
    watched.run()
    named = watched.asked["register_spine"][-1]
    start = named["initial"]
    assert_allclose(start(marked.spine_cbct_inflated_ras[None]), marked.spine_ct_ras[None])
    assert start.angle_degrees == 0
    assert named["search"].shift_mm == 10.0
    one_only: Any = SimpleNamespace(hints=SimpleNamespace(spine_ct_ras=np.zeros(3), spine_cbct_inflated_ras=None))
    assert _hinted(one_only) is None


@pytest.mark.parametrize(("limit", "far"), [(9.0, True), (11.0, False)])
def test_matches_are_far_where_95_percent_moved_by_more_than_the_limit_against_the_prior(
    watched: Watched, limit: float, far: bool
) -> None:
    fixed = np.random.default_rng(2).uniform(-30, 30, (100, 3))
    off = np.where(np.arange(100) < 90, 10.0, 0.0)
    off[:4] = 500.0  # fewer than 5 %
    matches = Correspondences.of(fixed, CT_FROM_INF(fixed) + off[:, None] * np.array([0, 0, 1.0]))
    watched.fit = scene.sliding_fit(100, moved_mm(matches, CT_FROM_INF), moved_back)
    watched.run(leave_out={"first_registration_mm": limit})
    assert watched.asked["register"][-1]["coarse_beyond_mm"] == limit
    (choice,) = (choice for choice in watched.stages.choices if choice.part == FIRST)
    assert (choice.kept, choice.limit) == (far, limit)
    assert choice.value == pytest.approx(10.0)
    assert (FIRST in watched.stages.skipped) is not far


def test_without_matches_the_start_is_taken_to_be_far() -> None:
    choice = moved_far(scene.sliding_fit(0, moved_mm(None, CT_FROM_INF)), 1000.0)
    assert (choice.kept, choice.value) == (True, np.inf)


def test_a_registration_without_coarse_levels_of_its_own_leaves_no_choice(watched: Watched) -> None:
    watched.fit = SimpleNamespace(moving_from_fixed=moved_back)
    watched.run()
    assert watched.stages.choices == []


def test_deep_inside_keeps_off_the_rim_and_the_end_of_the_image() -> None:
    grid = scene.grid_about(np.array([10.0, 20.0, -30.0]), 40, 2.0)  # 80 mm wide
    x = grid.points()
    region = Mask(x[..., 0] < 20.0, grid.ras_from_ijk)  # its rim 10 mm off along R
    middle = np.array([10.0, 20.0, -30.0])
    deep = np.array([[0.0, 0, 0], [2, 0, 0], [-32, 0, 0], [0, 32, 0], [0, 0, -32]])
    assert _deep_inside(region, middle + deep).all()
    shallow = np.array([[10.5, 0, 0], [15, 0, 0], [-39.9, 0, 0], [0, 39.9, 0], [0, 0, 60]])
    # Not on the rim itself and not beyond: voxels of 4 mm tell its place within 2 mm.
    assert not _deep_inside(region, middle + shallow).any()


def test_settings_of_a_run_reach_the_registration() -> None:
    run = settings_of(
        "balanced", {"registration": {"grid_mm": 11, "levels": 4, "voxel_mm": 3, "window_mm": 7, "bending": 123}}
    )
    made = ffd_settings(run.registration)
    assert (made.spacing_mm, made.levels, made.voxel_mm, made.window_mm) == (11, 4, 3, 7)
    assert made.weights.bending == 123


def test_sides_keep_their_names() -> None:
    assert (as_side("left"), as_side("right")) == ("left", "right")
