"""Residual registration by value: which way each registration goes, whom it believes, and where the border moves."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from poro.mesh import TetMesh
from registration.correspondences import Correspondences
from registration.volume import Array, Mask
from tests.vatsloc import ball_scene as scene
from vatsloc.imaging.surface import Border, SurfacePoints
from vatsloc.maps import MeshMap
from vatsloc.workflow import residual
from vatsloc.workflow.residual import Residual, _border_offsets, residual_registration
from vatsloc.workflow.settings import ResidualSettings

NO_CORRESPONDENCES = Correspondences.of(np.zeros((0, 3)), np.zeros((0, 3)))
NO_SURFACE = SurfacePoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, dtype=np.int8))
COARSE = ResidualSettings(voxel_mm=4.0, grid_mm=24.0, levels=1)
FINE = ResidualSettings(levels=1)
OFF = np.array([2.0, -1.0, 1.5])
"""By how much the made registrations say that the model is wrong."""


class Scene:
    """The model knows 60 % of the collapse."""

    inflated = scene.placed(scene.lung_mesh(), scene.INF_FROM_CT)
    before = scene.placed(scene.lung_mesh(), scene.INF_FROM_CT, scene.DEF_FROM_INF)
    truth = scene.collapsed(before.points)
    nodes = before.points + 0.6 * (truth - before.points)
    model = MeshMap(inflated, nodes, scene.DEF_FROM_INF)
    far = np.linalg.norm(before.points - scene.CENTRE_DEF, axis=1)


class Registration:
    """Stands in for `register_ffd`: first there, by `there`, then back, by `back`; remembers what it was given."""

    def __init__(self, there: Callable[[Array], Array], back: Callable[[Array], Array]) -> None:
        self.answers = [SimpleNamespace(moving_from_fixed=there, min_det=0.4)]
        self.answers += [SimpleNamespace(moving_from_fixed=back, min_det=0.2)]
        self.calls: list[dict[str, Any]] = []

    def __call__(self, fixed: Any, moving: Any, **rest: Any) -> Any:
        self.calls.append({"fixed": fixed, "moving": moving, **rest})
        return self.answers[len(self.calls) - 1]


def run(
    monkeypatch: pytest.MonkeyPatch,
    registration: Registration,
    surface: SurfacePoints = NO_SURFACE,
    pairs: Correspondences = NO_CORRESPONDENCES,
    lung: Mask | None = None,
    settings: ResidualSettings = COARSE,
    **usable: Array,
) -> Residual | None:
    monkeypatch.setattr(residual, "register_ffd", registration)
    lung = scene.lung_deflated() if lung is None else lung
    return residual_registration(scene.prepared(**usable), lung, Scene.model, Scene.before, surface, settings, pairs)


def shifted(offset: Array) -> Callable[[Array], Array]:
    return lambda points: points + offset


def two_valued(near: float, other: float, radius: float = 25.0) -> Callable[[Array], Array]:
    """OFF, and along R `near` mm more within a radius of the middle before the collapse, `other` mm more elsewhere."""
    return lambda nodes: nodes + OFF + np.where(Scene.far < radius, near, other)[:, None] * np.array([1.0, 0, 0])


def test_the_modelled_lung_comes_nearer_to_the_truth_inside_and_at_its_border() -> None:
    found = residual_registration(
        scene.prepared(),
        scene.lung_deflated(),
        Scene.model,
        Scene.before,
        scene.air_surface(),
        COARSE,
        NO_CORRESPONDENCES,
    )
    assert found is not None
    left = np.linalg.norm(Scene.nodes + found.displacement - Scene.truth, axis=1)
    before = np.linalg.norm(Scene.nodes - Scene.truth, axis=1)
    assert before.mean() > 3.0
    assert left.mean() < 1.0
    border = Scene.before.boundary.nodes
    assert left[border].mean() < 0.25 * before[border].mean()
    assert found.agreed_share > 0.6
    assert found.min_det > 0.5


def test_believed_nodes_go_half_way_between_both_answers_and_the_others_follow(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = run(monkeypatch, Registration(shifted(-OFF), two_valued(1.0, 4.0)))
    assert found is not None
    inner = Scene.far < 25.0
    assert_allclose(found.disagreement_mm, np.where(inner, 1.0, 4.0), atol=0.02)
    assert found.compared.mean() > 0.9
    assert_array_equal(found.seen, inner & found.compared)
    assert_allclose(
        found.displacement, np.broadcast_to(OFF + np.array([0.5, 0, 0]), found.displacement.shape), atol=0.02
    )
    assert found.min_det == 0.2


def test_less_than_a_few_believed_nodes_are_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert run(monkeypatch, Registration(shifted(-OFF), two_valued(4.0, 4.0))) is None
    assert run(monkeypatch, Registration(shifted(-OFF), two_valued(2.9, 2.9))) is not None


def test_nothing_where_no_lung_is_in_both_views(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = Registration(shifted(-OFF), two_valued(0.0, 0.0))
    assert run(monkeypatch, nothing, usable_inflated=np.zeros(scene.inflated().hu.shape, bool)) is None
    assert run(monkeypatch, nothing, lung=scene.empty(scene.deflated())) is None
    assert nothing.calls == []


def test_a_node_that_the_way_back_does_not_reach_is_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    limit = scene.CENTRE_DEF[1]

    def there(points: Array) -> Array:
        y = points - OFF
        return np.stack([y[:, 0], np.minimum(y[:, 1], limit), y[:, 2]], axis=1)

    lenient = COARSE.model_copy(update={"max_disagreement_mm": 1000.0})
    found = run(monkeypatch, Registration(there, two_valued(0.0, 0.0)), settings=lenient)
    assert found is not None
    assert not found.seen[Scene.nodes[:, 1] > limit + 1.0].any()
    assert found.seen[found.compared & (Scene.nodes[:, 1] < limit - 0.1)].all()


def test_each_registration_gets_its_own_images_region_and_matches(monkeypatch: pytest.MonkeyPatch) -> None:
    moving = scene.CENTRE_INF + np.random.default_rng(3).uniform(-20, 20, (12, 3))
    fixed = scene.CENTRE_DEF + np.random.default_rng(4).uniform(-20, 20, (12, 3))
    known = Registration(shifted(-OFF), two_valued(0.0, 0.0))
    assert run(monkeypatch, known, pairs=Correspondences.of(fixed, moving), settings=FINE) is not None
    there, back = known.calls
    expected = Scene.model(moving)
    assert_allclose(there["matches"].fixed, fixed)
    assert_allclose(there["matches"].moving, expected)
    assert_allclose(back["matches"].fixed, expected)
    assert_allclose(back["matches"].moving, fixed)
    assert there["fixed"] is back["moving"]
    assert there["moving"] is back["fixed"]
    middle = np.linalg.norm(there["fixed"].grid.points() - scene.CENTRE_DEF, axis=-1) > 36.0
    assert (there["fixed"].hu[middle] < -950).any()  # only the deflated CBCT shows pleural air
    assert not (there["moving"].hu[middle & (there["moving"].hu > -999)] < -950).any()
    back_ct = Scene.model.inverse()
    for call, depth in (
        (there, lambda x: scene.RADIUS_MM - np.linalg.norm(scene.expanded(x) - scene.CENTRE_DEF, axis=1)),
        (back, lambda x: scene.RADIUS_MM - np.linalg.norm(back_ct(x) - scene.CENTRE_INF, axis=1)),
    ):
        region = call["fixed_mask"]
        assert 1.0 < depth(region.grid.points()[region.inside]).min() < 4.0


def test_only_what_both_scans_show_is_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    plane_inf, plane_def = scene.CENTRE_INF[0] + 8.0, scene.CENTRE_DEF[2] + 10.0
    known = Registration(shifted(-OFF), two_valued(0.0, 0.0))
    found = run(
        monkeypatch,
        known,
        usable_inflated=scene.inflated().grid.points()[..., 0] < plane_inf,
        usable_deflated=scene.deflated().grid.points()[..., 2] < plane_def,
    )
    assert found is not None
    over_inf, over_def = Scene.inflated.points[:, 0] - plane_inf, Scene.nodes[:, 2] - plane_def
    assert not found.compared[(over_inf > 9.0) | (over_def > 9.0)].any()
    assert found.compared[(over_inf < -3.0) & (over_def < -3.0) & (Scene.far < 32.0)].all()
    assert found.compared.sum() > 100
    for call in known.calls:
        assert_array_equal(call["moving_mask"].inside, known.calls[0]["moving_mask"].inside)
        seen = call["moving_mask"]
        points = seen.grid.points()[seen.inside]
        assert points[:, 2].max() < plane_def + 2.5
        back = scene.DEF_FROM_INF.inverse()(points)[np.linalg.norm(points - scene.CENTRE_DEF, axis=1) > 50]
        assert back[:, 0].max() < plane_inf + 12.0


def test_the_lung_is_compared_where_it_was_segmented_not_where_the_model_has_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    grid = scene.deflated().grid
    plane = scene.CENTRE_DEF[0]
    half = Mask(scene.lung_deflated().inside & (grid.points()[..., 0] < plane), grid.ras_from_ijk)
    found = run(monkeypatch, Registration(shifted(-OFF), two_valued(0.0, 0.0)), lung=half)
    assert found is not None
    end = Scene.nodes[:, 0] + OFF[0]  # where the registration puts a node, not where the model does
    assert not found.compared[end > plane + 5.0].any()
    assert found.compared[(end < plane - 0.5) & (Scene.far < 32.0)].all()


def test_the_free_border_goes_to_the_observed_air_along_its_normals(monkeypatch: pytest.MonkeyPatch) -> None:
    border = TetMesh(Scene.nodes + OFF, Scene.before.tets).boundary
    count = len(border.nodes)
    air = SurfacePoints(
        border.points + 2.0 * border.node_normals,
        border.node_normals,
        np.ones(count),
        np.full(count, Border.AIR, dtype=np.int8),
    )
    found = run(monkeypatch, Registration(shifted(-OFF), two_valued(0.0, 4.0)), surface=air)
    assert found is not None
    assert found.seen.sum() > 30
    assert_allclose(found.displacement[found.seen], np.broadcast_to(OFF, (found.seen.sum(), 3)), atol=0.02)
    moved = found.displacement[border.nodes] - OFF
    assert_allclose(moved, 2.0 * border.node_normals, atol=0.05)


def test_border_offsets_by_kind_side_reach_and_mean() -> None:
    border = Scene.before.boundary
    count = len(border.nodes)
    kind = np.full(count, Border.AIR, dtype=np.int8)
    along, normals = np.full(count, -3.0), border.node_normals.copy()
    free = np.ones(len(Scene.before.points), bool)
    lone = np.argsort(border.points[:, 2])[:: count // 8][:8]  # far from each other
    contact, turned, far, held, twice = lone[:5]
    kind[contact] = Border.CONTACT
    normals[turned] *= -1
    along[far] = 16.0
    free[border.nodes[held]] = False
    points = np.concatenate([border.points + along[:, None] * border.node_normals, [border.points[twice]]])
    surface = SurfacePoints(
        points, np.concatenate([normals, normals[[twice]]]), np.ones(count + 1), np.append(kind, np.int8(Border.AIR))
    )
    nodes, moves = _border_offsets(Scene.before, surface, free)
    left_out = set(border.nodes[[contact, turned, far, held]])
    assert set(nodes) == set(border.nodes) - left_out
    place = np.searchsorted(border.nodes, nodes)
    expected = np.where(place == twice, -1.5, -3.0)
    assert_allclose(np.einsum("nd,nd->n", moves, border.node_normals[place]), expected, atol=1e-9)
    assert_allclose(np.linalg.norm(moves, axis=1), np.abs(expected), atol=1e-9)
    nodes, moves = _border_offsets(Scene.before, NO_SURFACE, free)
    assert (nodes.shape, moves.shape) == ((0,), (0, 3))


def test_shares_and_errors_count_believed_nodes_alone() -> None:
    displacement = np.array([[3.0, 0, 0], [0, 4.0, 0], [90, 90, 90], [0, 0, 0]])
    compared, seen = np.array([True, True, True, False]), np.array([True, True, False, False])
    known = Residual(displacement, compared, seen, np.zeros(4), 0.5)
    assert known.agreed_share == pytest.approx(2 / 3)
    assert known.model_error_mm == pytest.approx(np.sqrt(25 / 6))
