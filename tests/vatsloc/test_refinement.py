"""Refinement by small blocks on a ball of a lung whose place is known at every point."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from poro.mesh.tetmesh import signed_volumes
from registration.correspondences import Correspondences
from registration.volume import Array, Mask
from tests.vatsloc import ball_scene as scene
from vatsloc.maps import MeshMap
from vatsloc.workflow import refinement as module
from vatsloc.workflow.refinement import Compared, Shape, refine_by_blocks
from vatsloc.workflow.settings import RefinementSettings

AROUND = scene.DEF_FROM_INF @ scene.INF_FROM_CT
ON = RefinementSettings()


class Lung:
    """The collapsed ball, off by up to 3 mm near the pleura and by nothing deeper than 16 mm."""

    mesh = scene.lung_mesh(8.0)
    rest = scene.placed(mesh, scene.INF_FROM_CT, scene.DEF_FROM_INF)
    truth = scene.collapsed(rest.points)
    depth = scene.RADIUS_MM - np.linalg.norm(mesh.points - scene.CENTRE_CT, axis=1)
    wave = np.sin((mesh.points - scene.CENTRE_CT) / 25.0)[:, [1, 2, 0]]
    start = truth + 3.0 * np.clip(1 - depth / 16.0, 0, 1)[:, None] * (0.6 + 0.4 * wave)

    @classmethod
    def shape(cls, anchors: Array, within_mm: float = np.inf) -> Shape:
        return Shape(cls.rest, MeshMap(cls.mesh, cls.start, AROUND), anchors, within_mm)

    @classmethod
    def error(cls, points: Array) -> Array:
        return np.asarray(np.linalg.norm(points - cls.truth, axis=1))


def compared(**other: Any) -> Compared:
    prepared = scene.prepared()
    parts: dict[str, Any] = {"lung_ct": prepared.lung_ct, "lung": scene.lung_deflated(), **other}
    return Compared(scene.ct(), parts["lung_ct"], prepared.deflated, parts["lung"])


def test_the_lung_follows_blocks_up_to_the_pleura() -> None:
    found = refine_by_blocks(compared(), Lung.shape(np.zeros(0, int)), ON)
    before, after = Lung.error(Lung.start), Lung.error(found.points)
    shallow = Lung.depth < 8.0
    assert before[shallow].mean() > 1.8
    assert after[shallow].mean() < 0.65 * before[shallow].mean()
    assert after[~shallow].mean() < 0.45
    assert [one.voxel_mm for one in found.passes] == [1.5, 1.0]
    first = found.passes[0]
    assert first.kept
    assert first.after_mm < first.before_mm
    assert (signed_volumes(found.points, Lung.mesh.tets) > 0).all()


def test_anchors_stay_and_deep_blocks_are_left_out() -> None:
    anchors = np.flatnonzero(Lung.depth > 16.0)
    found = refine_by_blocks(compared(), Lung.shape(anchors, 16.0), ON)
    everywhere = refine_by_blocks(compared(), Lung.shape(np.zeros(0, int)), ON)
    assert found.passes[0].blocks < 0.9 * everywhere.passes[0].blocks
    assert Lung.error(found.points)[anchors].max() < 0.15 < Lung.error(everywhere.points)[anchors].max()
    assert Lung.error(found.points)[Lung.depth < 8.0].mean() < 0.6 * Lung.error(Lung.start)[Lung.depth < 8.0].mean()


def test_a_lung_that_is_right_is_left_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks that scatter about the truth predict those held out no better than the truth does."""
    rng = np.random.default_rng(0)

    def scattered(_around: Any, _starts: Any, to_scan: MeshMap, *_rest: Any) -> Correspondences:
        ct = scene.CENTRE_CT + rng.uniform(-22, 22, (400, 3))
        return Correspondences.of(to_scan(ct) + rng.normal(size=(400, 3)), ct)

    monkeypatch.setattr(module, "_blocks", scattered)
    shape = Shape(Lung.rest, MeshMap(Lung.mesh, Lung.truth, AROUND), np.zeros(0, int))
    found = refine_by_blocks(compared(), shape, ON)
    assert [one.kept for one in found.passes] == [False, False]
    assert all(one.blocks == 400 and one.after_mm >= one.before_mm for one in found.passes)
    assert_array_equal(found.points, Lung.truth)


@pytest.mark.parametrize("lost", ["lung", "lung_ct"])
def test_where_too_few_blocks_are_found_nothing_moves(lost: str) -> None:
    mask = {"lung": scene.lung_deflated(), "lung_ct": scene.prepared().lung_ct}[lost]
    inside = np.zeros_like(mask.inside)
    if lost == "lung_ct":
        inside[tuple(np.argwhere(mask.inside)[0])] = True
    found = refine_by_blocks(compared(**{lost: Mask(inside, mask.ras_from_ijk)}), Lung.shape(np.zeros(0, int)), ON)
    assert found.passes == ()
    assert_array_equal(found.points, Lung.start)


@pytest.mark.parametrize("pulls", [4, 30])
def test_no_element_is_turned_over_by_blocks_that_would_turn_it(pulls: int) -> None:
    """Pulls across one element: its nodes follow less, and the rest of the lung follows."""
    shape = Shape(Lung.rest, MeshMap(Lung.mesh, Lung.truth, AROUND), np.zeros(0, int))
    centre = Lung.mesh.points[Lung.mesh.tets].mean(axis=1)
    tet = int(np.argmin(np.linalg.norm(centre - scene.CENTRE_CT, axis=1)))
    corners = centre[tet] + 0.8 * (Lung.mesh.points[Lung.mesh.tets[tet]] - centre[tet])
    to = shape.map(corners)
    aside = scene.CENTRE_CT + np.array([[22.0, 0, 0], [-22.0, 0, 0]])
    pulled = Correspondences.of(
        np.concatenate(
            [np.repeat(3 * to[[1, 0, 3, 2]] - 2 * to, pulls, axis=0), np.repeat(shape.map(aside) + 2, 60, axis=0)]
        ),
        np.concatenate([np.repeat(corners, pulls, axis=0), np.repeat(aside, 60, axis=0)]),
    )
    followed = module._followed(shape, pulled)
    assert (signed_volumes(followed.map.moved, Lung.mesh.tets) > 0).all()
    assert (np.linalg.norm(followed.map(aside) - shape.map(aside), axis=1) > 3.0).all()


def test_only_nodes_of_elements_that_would_turn_over_follow_less() -> None:
    tets = np.array([[0, 1, 2, 3], [4, 5, 6, 7]])
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    points = np.concatenate([corners, corners + 5])
    field = np.zeros((8, 3))
    field[3] = field[7] = [0, 0, -1.2]
    field[7, 2] = -0.9
    share = module.unfolded(points, field, tets)
    assert_array_equal(share[:4], field[:4] / 2)
    assert_array_equal(share[4:], field[4:])
    mirrored = points * [1, 1, -1]
    assert_array_equal(module.unfolded(mirrored, 0 * field + 1, tets), np.ones((8, 3)))
    assert_array_equal(module.unfolded(points, 1e9 * field, tets)[[3, 7]], np.zeros((2, 3)))
