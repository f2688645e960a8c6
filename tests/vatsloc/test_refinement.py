"""Refinement by small blocks on a ball of a lung whose place is known at every point."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from poro.mesh.closest import depth_below
from poro.mesh.tetmesh import TetMesh, signed_volumes
from registration.correspondences import Correspondences
from registration.volume import Array, Mask
from tests.vatsloc import ball_scene as scene
from vatsloc.imaging.surface import Border, SurfacePoints
from vatsloc.maps import MeshMap
from vatsloc.workflow import refinement as module
from vatsloc.workflow.hold_out import held_out
from vatsloc.workflow.refinement import Compared, Shape, prospect, refine_by_blocks
from vatsloc.workflow.settings import RefinementSettings
from vatsloc.workflow.smoothed import Smoother

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
    found = refine_by_blocks(prospect(compared(), Lung.rest, ON), Lung.shape(np.zeros(0, int)))
    before, after = Lung.error(Lung.start), Lung.error(found.points)
    shallow = Lung.depth < 8.0
    assert before[shallow].mean() > 1.8
    assert after[shallow].mean() < 0.65 * before[shallow].mean()
    assert after[~shallow].mean() < 0.45
    assert [one.voxel_mm for one in found.passes] == [1.5, 1.0]
    assert found.passes[0].settled
    first = found.passes[0]
    assert first.kept
    assert first.after_mm < first.before_mm
    assert (signed_volumes(found.points, Lung.mesh.tets) > 0).all()


unsmoothed = Smoother(())


def wall_of(points: Array, normals: Array) -> SurfacePoints:
    return SurfacePoints(points, normals, np.ones(len(points)), np.full(len(points), Border.CONTACT))


def test_a_lung_beside_its_wall_is_drawn_to_it_along_the_normal_alone() -> None:
    """A surface that is shifted by 2 mm in x, 1 mm too large, with one part 8 mm off and one that faces away."""
    truth = TetMesh(Lung.truth, Lung.mesh.tets).boundary
    normals = truth.node_normals.copy()
    outside = truth.points - 1.0 * normals
    height = truth.points[:, 2]
    far, turned = height > np.quantile(height, 0.8), height < np.quantile(height, 0.2)
    outside[far] += 8.0 * normals[far]
    normals[turned] *= -1
    shift = np.array([2.0, 0, 0])
    moved = MeshMap(Lung.mesh, Lung.truth + shift, AROUND)
    shape = Shape(Lung.rest, moved, np.zeros(0, int), wall=wall_of(outside, normals))
    nodes, gap, along = module._off_wall(shape)
    top, bottom = height > np.quantile(height, 0.97), height < np.quantile(height, 0.03)
    assert not np.isin(truth.nodes[top | bottom], nodes).any()
    assert np.isin(truth.nodes[~far & ~turned], nodes).mean() > 0.9
    row = {node: n for n, node in enumerate(truth.nodes)}
    own = truth.node_normals[[row[node] for node in nodes]]
    straight = np.einsum("nd,nd->n", along, own) > 0.999  # the nearest point is the node's own
    assert straight.mean() > 0.3
    expected = -1.0 - own[straight] @ shift
    assert_allclose(gap[straight] - gap[straight].mean(), expected - expected.mean(), atol=0.05)
    assert abs(np.median(gap)) < 1e-12


def test_without_a_wall_in_reach_nothing_is_drawn() -> None:
    nowhere = Lung.truth[:50] + 300.0
    for wall in (None, wall_of(nowhere[:0], nowhere[:0]), wall_of(nowhere, np.tile([1.0, 0, 0], (50, 1)))):
        nodes, gap, normals = module._off_wall(replace(Lung.shape(np.zeros(0, int)), wall=wall))
        assert (len(nodes), len(gap), normals.shape) == (0, 0, (0, 3))


def test_the_wall_brings_the_surface_nearer_than_blocks_alone() -> None:
    border = TetMesh(Lung.truth, Lung.mesh.tets).boundary
    shape = Lung.shape(np.zeros(0, int))
    alone = refine_by_blocks(prospect(compared(), Lung.rest, ON), shape)
    held = refine_by_blocks(
        prospect(compared(), Lung.rest, ON), replace(shape, wall=wall_of(border.points, border.node_normals))
    )

    def off_surface(points: Array) -> float:
        return float(np.abs(((points - Lung.truth)[border.nodes] * border.node_normals).sum(axis=1)).mean())

    assert off_surface(held.points) < 0.8 * off_surface(alone.points)
    assert Lung.error(held.points)[Lung.depth > 8.0].mean() < 1.1 * Lung.error(alone.points)[Lung.depth > 8.0].mean()


def test_anchors_stay_and_deep_blocks_are_left_out() -> None:
    anchors = np.flatnonzero(Lung.depth > 16.0)
    found = refine_by_blocks(prospect(compared(), Lung.rest, ON), Lung.shape(anchors, 16.0))
    everywhere = refine_by_blocks(prospect(compared(), Lung.rest, ON), Lung.shape(np.zeros(0, int)))
    assert found.passes[0].blocks < 0.9 * everywhere.passes[0].blocks
    assert Lung.error(found.points)[anchors].max() < 0.15 < Lung.error(everywhere.points)[anchors].max()
    assert Lung.error(found.points)[Lung.depth < 8.0].mean() < 0.6 * Lung.error(Lung.start)[Lung.depth < 8.0].mean()


def test_blocks_about_a_cut_are_not_followed() -> None:
    def above(points: Array) -> Array:
        return np.asarray((points - scene.CENTRE_CT)[:, 2] - 7.0)

    uncut = refine_by_blocks(prospect(compared(), Lung.rest, ON), Lung.shape(np.zeros(0, int)))
    cut = refine_by_blocks(prospect(compared(), Lung.rest, ON), replace(Lung.shape(np.zeros(0, int)), cut=above))
    assert uncut.followed is not None
    assert cut.followed is not None
    assert (np.abs(above(uncut.followed.moving)) < module.BESIDE_CUT_MM).sum() > 20
    assert np.abs(above(cut.followed.moving)).min() >= module.BESIDE_CUT_MM
    beside = (np.abs(above(uncut.followed.moving)) < module.BESIDE_CUT_MM).mean()
    assert len(cut.followed) == pytest.approx((1 - beside) * len(uncut.followed), rel=0.05)


def test_of_the_scan_s_points_those_are_followed_that_lie_near_the_pleura_before_the_collapse() -> None:
    """Points of tissue are taken back to the CT, where the lung is a ball, by maps in closed form."""
    within = 8.0
    mapped = MeshMap(Lung.mesh, Lung.truth, AROUND)
    everywhere = prospect(compared(), Lung.rest, ON.model_copy(update={"cell_mm": 8.0})).points
    points, chosen = (
        module._within_reach(everywhere, Shape(Lung.rest, mapped, np.zeros(0, int), reach))
        for reach in (np.inf, within)
    )
    before = AROUND.inverse()(scene.expanded(points))
    depth = scene.RADIUS_MM - np.linalg.norm(before - scene.CENTRE_CT, axis=1)
    limit = within + module.PASSES[0][1]
    taken = (points[:, None] == chosen[None]).all(axis=2).any(axis=1)
    clear = np.abs(depth - limit) > 1.0
    assert (depth[clear] > limit).sum() > 20
    assert_array_equal(taken[clear], depth[clear] < limit)


def test_blocks_that_those_held_out_contradict_are_not_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks say 2 mm to the one side, those held out 2 mm to the other."""
    rng = np.random.default_rng(0)

    def torn(*_asked: Any) -> Correspondences:
        now = shape.map(scene.CENTRE_CT + rng.uniform(-22, 22, (400, 3)))
        aside = np.where(held_out(now, module.APART_MM)[:, None], [-2.0, 0, 0], [2.0, 0, 0])
        return Correspondences.of(now, shape.map.inverse()(now - aside))

    monkeypatch.setattr(module, "match_aligned", torn)
    shape = Shape(Lung.rest, MeshMap(Lung.mesh, Lung.truth, AROUND), np.zeros(0, int))
    found = refine_by_blocks(prospect(compared(), Lung.rest, ON), shape)
    assert [one.kept for one in found.passes] == [False, False, False]
    assert all(one.blocks == 400 and one.after_mm > 1.2 * one.before_mm for one in found.passes)
    assert_array_equal(found.points, Lung.truth)


@pytest.mark.parametrize(("worse", "kept"), [(1.01, True), (1.03, False)])
def test_a_pass_is_followed_that_leaves_hardly_more_at_held_out_blocks(
    worse: float, kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They judge a lung that followed only the others."""
    misfits = iter([1.0, worse] * 3)
    monkeypatch.setattr(module, "_misfit", lambda *_given: next(misfits))
    found = refine_by_blocks(prospect(compared(), Lung.rest, ON), Lung.shape(np.zeros(0, int)))
    assert [one.kept for one in found.passes] == [kept] * 3
    assert (found.points == Lung.start).all() != kept


@pytest.mark.parametrize(
    ("misfit", "is_cut", "voxels"),
    [(0.6, False, [1.5, 1.0]), (0.7, False, [1.5, 1.5, 1.0]), (0.6, True, [1.5, 1.5, 1.0])],
)
def test_the_same_voxels_serve_once_more_where_held_out_blocks_are_missed_and_in_a_cut_lung(
    misfit: float, is_cut: bool, voxels: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_misfit", lambda *_given: misfit)
    shape = Lung.shape(np.zeros(0, int))
    if is_cut:
        shape = replace(shape, cut=lambda points: np.full(len(points), 50.0))
    found = refine_by_blocks(prospect(compared(), Lung.rest, ON), shape)
    assert [one.voxel_mm for one in found.passes] == voxels


def test_what_blocks_tell_comes_nearer_to_where_there_are_none_round_by_round(monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(5).uniform(-24, 24, (500, 3))
    points = scene.CENTRE_CT + points[np.linalg.norm(points, axis=1) < scene.RADIUS_MM - 12.0]
    at = MeshMap(Lung.mesh, Lung.truth, AROUND)(points)
    shape = Lung.shape(np.zeros(0, int))
    smooth, rim = module._smoother(shape), Lung.depth < 6.0
    errors = []
    for rounds in (1, 2, 4):
        monkeypatch.setattr(module, "ROUNDS", rounds)
        depth = depth_below(Lung.mesh.boundary, points)
        moved = module._followed(shape, Correspondences.of(at, points), depth, smooth).map.moved
        errors.append(Lung.error(moved)[rim].mean())
    assert errors[0] < Lung.error(Lung.start)[rim].mean()
    assert errors[1] < 0.95 * errors[0]
    assert errors[2] < 0.95 * errors[1]


@pytest.mark.parametrize("lost", ["lung", "lung_ct"])
def test_where_too_few_blocks_are_found_nothing_moves(lost: str) -> None:
    mask = {"lung": scene.lung_deflated(), "lung_ct": scene.prepared().lung_ct}[lost]
    inside = np.zeros_like(mask.inside)
    if lost == "lung_ct":
        inside[tuple(np.argwhere(mask.inside)[0])] = True
    found = refine_by_blocks(
        prospect(compared(**{lost: Mask(inside, mask.ras_from_ijk)}), Lung.rest, ON), Lung.shape(np.zeros(0, int))
    )
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
    followed = module._followed(shape, pulled, depth_below(Lung.mesh.boundary, pulled.moving), unsmoothed)
    assert (signed_volumes(followed.map.moved, Lung.mesh.tets) > 0).all()
    assert (np.linalg.norm(followed.map(aside) - shape.map(aside), axis=1) > 3.0).all()


def test_no_element_is_turned_over_by_smoothing() -> None:
    """Nodes scattered by what is meant to smooth them."""
    shape = Shape(Lung.rest, MeshMap(Lung.mesh, Lung.truth, AROUND), np.zeros(0, int))
    scatter = np.random.default_rng(3).normal(0, 6.0, Lung.truth.shape)
    turned = signed_volumes(Lung.truth + scatter, Lung.mesh.tets) <= 0
    found = module._unturned(shape, Lung.truth + scatter).map.moved
    assert turned.any()
    assert (signed_volumes(found, Lung.mesh.tets) > 0).all()
    assert np.linalg.norm(found - Lung.truth, axis=1).max() > 2.0


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
