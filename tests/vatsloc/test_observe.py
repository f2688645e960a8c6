"""What is looked for in the deflated scan, and in which frame: the prior, the meshes, the hilum and its held nodes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from poro.fem import Tissue
from registration.volume import Array, Mask
from tests.vatsloc import ball_scene as scene
from vatsloc.errors import InputRefused
from vatsloc.imaging.hilum import Hilum
from vatsloc.imaging.surface import Border
from vatsloc.imaging.thorax import central_airways
from vatsloc.workflow import observe as module
from vatsloc.workflow import prepare
from vatsloc.workflow.hilum import HilumMotion, HilumSource
from vatsloc.workflow.observe import SET_UP, Observed, held_nodes, observe
from vatsloc.workflow.pose import ChangeOfPose
from vatsloc.workflow.settings import Settings, settings_of
from vatsloc.workflow.stages import Stages

HILUM_CT = scene.CENTRE_CT + np.array([-25.0, 6.0, -4.0])
INF_FROM_DEF = scene.DEF_FROM_INF.inverse()
GRAVITY = np.array([0.6, 0.0, -0.8])
COARSE = {"mesh": {"model_edge_mm": 14.0}}


def stretched(points_inf: Array) -> Array:
    """What the change of pose does beyond its rigid part, in the inflated CBCT."""
    return scene.CENTRE_INF + [2.0, -3.0, 1.0] + 1.05 * (points_inf - scene.CENTRE_INF)


class Watched:
    """`observe` with everything that reads images replaced by answers that are known; `asked` holds the questions."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, side: str = "right", hilum_ct: Array | None = None) -> None:
        self.prepared, self.asked = scene.prepared(), dict[str, tuple[Any, ...]]()
        self.side, self.hint, self.stages = side, None, Stages()
        self.hilum_ct = HILUM_CT if hilum_ct is None else hilum_ct
        mesh = scene.lung_mesh()
        inflated = stretched(scene.INF_FROM_CT(mesh.points))
        rigid, lung = scene.rigid_fit(scene.INF_FROM_CT.inverse()), scene.empty(scene.inflated())
        seen = np.ones(len(mesh.points), bool)
        self.pose = ChangeOfPose(rigid, None, lung, mesh, inflated, seen, None, None, 1.0)
        self.surface, self.found = scene.air_surface(50), scene.pneumothorax()
        answers = {
            "register_spine": scene.rigid_fit(INF_FROM_DEF),
            "find_pneumothorax": self.found,
            "deflated_surface": self.surface,
            "find_hilum": Hilum(self.hilum_ct, 20.0, True),
            "hilum_motion": HilumMotion(np.zeros((1, 3)), HilumSource.AIRWAYS),
            "still_lung": "ready",
        }
        for name, answer in answers.items():
            monkeypatch.setattr(prepare if name == "register_spine" else module, name, self._asked(name, answer))

    def _asked(self, name: str, answer: Any) -> Any:
        def ask(*values: Any, **named: Any) -> Any:
            self.asked[name] = (*values, named)
            return answer

        return ask

    def observe(self, settings: Settings, rigid: Any = None) -> Observed:
        hints = SimpleNamespace(deflated_surface=self.hint)
        case: Any = SimpleNamespace(side=self.side, hints=hints, gravity_ras=GRAVITY)
        with self.stages.beside():
            found = observe(case, self.prepared, self.pose, settings, self.stages, rigid)
            with self.stages.stage(SET_UP):
                assert self.stages.done(lambda: "begun too late") == "ready"
        return found


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> Watched:
    return Watched(monkeypatch)


def middle(mask: Mask) -> Array:
    return np.asarray(mask.grid.points()[mask.inside].mean(axis=0))


def in_def(points_ct: Array) -> Array:
    """By the mesh's motion, which here is affine."""
    return np.asarray(scene.DEF_FROM_INF(stretched(scene.INF_FROM_CT(points_ct))))


def test_spines_are_registered_deflated_to_inflated_each_in_its_own_view(watched: Watched) -> None:
    observed = watched.observe(settings_of("balanced", COARSE))
    fixed, moving, fixed_spine, moving_spine, named = watched.asked["register_spine"]
    prepared = watched.prepared
    assert fixed is prepared.deflated.volume
    assert moving is prepared.inflated.volume
    assert fixed_spine is prepared.spine_deflated.mask
    assert moving_spine is prepared.spine_inflated.mask
    assert named["fixed_seen"] is prepared.deflated.field.usable
    assert named["moving_seen"] is prepared.inflated.field.usable
    assert_allclose(observed.def_from_inf_rigid.matrix, scene.DEF_FROM_INF.matrix, atol=1e-12)


def test_a_pose_that_is_given_is_taken(watched: Watched) -> None:
    given = scene.rigid_fit(scene.INF_FROM_CT)
    observed = watched.observe(settings_of("balanced", COARSE), given)
    assert "register_spine" not in watched.asked
    assert observed.rigid is given
    assert_allclose(observed.mesh_before.points, scene.INF_FROM_CT.inverse()(watched.pose.points_inf))


def test_meshes_lie_where_the_pose_and_then_the_spine_put_them(watched: Watched) -> None:
    observed = watched.observe(settings_of("balanced", COARSE))
    mesh = watched.pose.mesh_ct
    assert_allclose(observed.mesh_before.points, in_def(mesh.points), atol=1e-9)
    assert_array_equal(observed.mesh_before.tets, mesh.tets)
    coarse = observed.model_mesh
    assert len(coarse.points) < 0.7 * len(mesh.points)
    radius = np.linalg.norm(coarse.boundary.points - in_def(scene.CENTRE_CT[None]), axis=1)
    assert_allclose(radius, 1.05 * scene.RADIUS_MM, atol=3.5)
    middle_of_mass = np.average(coarse.points, axis=0, weights=coarse.node_volumes)
    assert_allclose(middle_of_mass, in_def(scene.CENTRE_CT[None])[0], atol=0.3)


def test_the_model_is_set_up_beside_the_search_for_the_surface(watched: Watched) -> None:
    observed = watched.observe(settings_of("balanced", COARSE))
    mesh, tissue, gravity, hilum, _ = watched.asked["still_lung"]
    assert mesh is observed.model_mesh
    assert tissue == Tissue()
    assert gravity is GRAVITY
    assert hilum is observed.hilum_nodes


def test_the_prior_shows_lung_neighbour_and_airways_where_the_spine_puts_them(watched: Watched) -> None:
    observed = watched.observe(settings_of("balanced", COARSE))
    cbct, prior, _ = watched.asked["find_pneumothorax"]
    assert cbct is watched.prepared.deflated
    assert observed.found is watched.found
    assert_allclose(middle(prior.lung), in_def(scene.CENTRE_CT[None])[0], atol=0.5)
    grid = prior.lung.grid
    assert prior.lung.inside.sum() * grid.spacing.prod() == pytest.approx(observed.mesh_before.volumes.sum(), rel=0.02)
    both = scene.DEF_FROM_INF @ scene.INF_FROM_CT
    assert_allclose(middle(prior.other), both(middle(watched.prepared.lungs.left)[None])[0], atol=2.0)
    assert_allclose(middle(prior.airways), in_def(scene.CENTRE_CT[None] + scene.AIRWAY_OFFSET)[0], atol=1.2)


def test_the_neighbour_of_a_left_lung_is_the_right_one(monkeypatch: pytest.MonkeyPatch) -> None:
    watched = Watched(monkeypatch, side="left")
    watched.observe(settings_of("balanced", COARSE))
    _, prior, _ = watched.asked["find_pneumothorax"]
    both = scene.DEF_FROM_INF @ scene.INF_FROM_CT
    assert_allclose(middle(prior.other), both(scene.CENTRE_CT[None])[0], atol=1.0)
    assert watched.asked["find_hilum"][2] == "left"


def test_the_hilum_is_found_in_the_ct_and_carried_by_the_mesh(watched: Watched) -> None:
    observed = watched.observe(settings_of("balanced", COARSE))
    lung, airways, side, _ = watched.asked["find_hilum"]
    assert lung is watched.prepared.lung_ct
    assert airways is watched.prepared.lungs.airways
    assert side == "right"
    at = in_def(HILUM_CT[None])[0]
    assert_allclose(observed.hilum.point_ras, at, atol=1e-6)
    assert observed.hilum.radius_mm == 20.0
    inflated, deflated, tubes, hilum, inf_from_def, points, _ = watched.asked["hilum_motion"]
    assert inflated is watched.prepared.inflated
    assert deflated is watched.prepared.deflated
    prior = watched.asked["find_pneumothorax"][1]
    assert_array_equal(tubes.inside, central_airways(prior, prior.airways.grid))
    assert hilum is observed.hilum
    assert_allclose(inf_from_def.matrix, INF_FROM_DEF.matrix, atol=1e-12)
    assert_array_equal(points, observed.model_mesh.points[observed.hilum_nodes])
    far = np.linalg.norm(observed.model_mesh.points - at, axis=1)
    assert_array_equal(observed.hilum_nodes, held_nodes(observed.model_mesh, at, 15.0))
    assert far[observed.hilum_nodes].max() < np.delete(far, observed.hilum_nodes).min()


def test_a_hilum_beside_the_lung_moves_with_the_spine_and_as_the_border_next_to_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    inward = np.array([-0.8, 0.36, -0.48])
    beside, border = scene.CENTRE_CT + 46.0 * inward, (scene.CENTRE_CT + scene.RADIUS_MM * inward)[None]
    observed = Watched(monkeypatch, hilum_ct=beside).observe(settings_of("balanced", COARSE))
    both = scene.DEF_FROM_INF @ scene.INF_FROM_CT
    expected = both(beside[None]) + in_def(border) - both(border)
    assert_allclose(observed.hilum.point_ras, expected[0], atol=0.3)


def test_a_hilum_that_is_switched_off_stands_still(watched: Watched) -> None:
    observed = watched.observe(settings_of("balanced", COARSE, {"model": {"hilum": False}}))
    assert "hilum_motion" not in watched.asked
    assert observed.motion.source is HilumSource.OFF
    assert_array_equal(observed.motion.displacement, np.zeros((len(observed.hilum_nodes), 3)))


def test_a_surface_by_hand_takes_the_place_of_the_found_one(watched: Watched) -> None:
    assert watched.observe(settings_of("balanced", COARSE)).surface is watched.surface
    points = scene.CENTRE_DEF + 20.0 * np.concatenate([np.eye(3), -np.eye(3)])
    watched.hint = SimpleNamespace(points_ras=points, triangles=np.zeros((0, 3), int))
    by_hand = watched.observe(settings_of("balanced", COARSE)).surface
    assert_array_equal(by_hand.points, points)
    assert_allclose(by_hand.normals, np.concatenate([np.eye(3), -np.eye(3)]), atol=1e-9)
    assert_array_equal(by_hand.confidence, np.ones(6))
    assert set(by_hand.border) == {Border.AIR}


def test_a_scan_that_shows_nothing_of_the_surface_is_refused(monkeypatch: pytest.MonkeyPatch, watched: Watched) -> None:
    monkeypatch.setattr(module, "deflated_surface", lambda *_: watched.surface.where(np.zeros(50, bool)))
    with pytest.raises(InputRefused, match="deflated CBCT shows nothing of the collapsed lung's surface; take"):
        watched.observe(settings_of("balanced", COARSE))


def test_held_nodes_are_those_within_the_radius_and_at_least_the_twelve_nearest() -> None:
    mesh = scene.lung_mesh()
    far = np.linalg.norm(mesh.points - HILUM_CT, axis=1)
    wide = held_nodes(mesh, HILUM_CT, 18.0)
    assert_array_equal(wide, np.flatnonzero(far <= 18.0))
    assert len(wide) > 12
    few = held_nodes(mesh, HILUM_CT, 3.0)
    assert_array_equal(few, np.sort(np.argsort(far)[:12]))
