"""Pieces that overlap are pressed apart: both give way, what is known stays, and nothing is pushed through a wall."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from poro import separation
from poro.arrays import Array
from poro.contact import ContactStatus, LevelSet
from poro.fem import Tissue
from poro.mesh import closest_points, interpolate, locate
from poro.mesh.pieces import Pieces, stuff_pieces
from poro.separation import Held, facing_pieces, hold_apart

RADIUS_MM, EDGE_MM, JOINED_MM = 30.0, 6.0, 10.0
OPEN = LevelSet(np.full((4, 4, 4), 1e3), np.zeros(3), 1e3)
NOTHING = Held(np.zeros((0, 3)), np.zeros(0))
_SPREAD = np.random.default_rng(5).uniform([-15, -15, -20], [15, 15, -4], (150, 3))
LOWER = Held(_SPREAD, np.full(len(_SPREAD), 0.1))
"""Points that hold the lower piece."""


def halves(edge_mm: float = EDGE_MM, joined_mm: float = 0.0) -> Pieces:
    """A ball cut at z = 0, one about its centre if asked for."""
    affine = np.diag([2.0, 2.0, 2.0, 1.0])
    affine[:3, 3] = -40.0
    ijk = np.stack(np.meshgrid(*[np.arange(41)] * 3, indexing="ij"), axis=-1)
    inside = np.linalg.norm(ijk * 2.0 - 40.0, axis=-1) < RADIUS_MM
    joint = np.array([-20.0, 0, 0])
    return stuff_pieces(
        inside, affine, edge_mm, lambda x: x[:, 2], lambda x: np.linalg.norm(x - joint, axis=1) < joined_mm
    )


def pushed(pieces: Pieces, by_mm: float) -> Array:
    """The upper piece moved into the lower one, less and less towards where they are joined."""
    points = pieces.mesh.points
    upper = pieces.node_piece() == 0
    _, shared = pieces.part(1)
    joined = np.intersect1d(np.flatnonzero(upper), shared)
    far = np.full(len(points), 1.0)
    if len(joined):
        far = np.clip(np.linalg.norm(points - points[joined].mean(axis=0), axis=1) / RADIUS_MM - 0.5, 0, 1)
    return -by_mm * (upper * far)[:, None] * np.eye(3)[2]


def deepest(pieces: Pieces, u: Array) -> float:
    """How deep nodes of a piece lie in the other one, mm."""
    moved = pieces.mesh.points + u
    worst = 0.0
    for number in (0, 1):
        (part, nodes), (_, others) = pieces.part(number), pieces.part(1 - number)
        surface = part.boundary.moved(moved[nodes][part.boundary.nodes])
        alone = np.setdiff1d(others, nodes)
        worst = max(worst, -closest_points(surface, moved[alone]).distance.min())
    return worst


def test_a_cut_ball_at_rest_does_not_overlap() -> None:
    pieces = halves()
    gaps = facing_pieces(pieces, pieces.mesh.points).gaps(np.zeros_like(pieces.mesh.points))
    assert gaps.meets.sum() > 0.8 * len(pieces.pairs)
    first = facing_pieces(pieces, pieces.mesh.points).nodes
    inner = gaps.meets & (np.linalg.norm(pieces.mesh.points[first], axis=1) < RADIUS_MM - 1.5 * EDGE_MM)
    assert inner.sum() > 40
    assert_allclose(gaps.gap[inner], 0, atol=1e-9)
    assert np.abs(gaps.gap[gaps.meets]).max() < 0.1  # at the rounded rim
    found = hold_apart(pieces, np.zeros_like(pieces.mesh.points), Tissue(), NOTHING, OPEN)
    assert found.before_mm3 < 1.0
    assert np.abs(found.u).max() < 0.1


def test_two_halves_give_way_alike_and_touch() -> None:
    pieces, by_mm = halves(), 3.0
    u = pushed(pieces, by_mm)
    found = hold_apart(pieces, u, Tissue(), NOTHING, OPEN)
    assert found.contact is not None
    assert found.contact.status is ContactStatus.CONVERGED
    cut = facing_pieces(pieces, pieces.mesh.points).gaps(np.zeros_like(u)).area.sum()
    assert found.before_mm3 == pytest.approx(by_mm * cut, rel=0.02)
    assert found.after_mm3 < 1e-3 * found.before_mm3
    assert deepest(pieces, u) > 2.9
    assert deepest(pieces, u + found.u) < 0.05
    upper = pieces.node_piece() == 0
    mean = [found.u[side].mean(axis=0) for side in (upper, ~upper)]
    assert_allclose(mean[0], [0, 0, by_mm / 2], atol=0.1)
    assert_allclose(mean[1], [0, 0, -by_mm / 2], atol=0.1)
    force = found.contact.nodal_force
    assert (found.contact.force >= 0).all()
    assert_allclose(force.sum(axis=0), 0, atol=1e-9 * np.abs(force).sum())


def test_a_piece_that_is_known_stays_and_the_other_one_gives_way() -> None:
    pieces, by_mm = halves(), 2.0
    u = pushed(pieces, by_mm)
    found = hold_apart(pieces, u, Tissue(), LOWER, OPEN)
    assert np.abs(interpolate(locate(pieces.mesh, LOWER.points), found.u)).max() < 0.1
    assert found.u[pieces.node_piece() == 0, 2].mean() == pytest.approx(by_mm, abs=0.1)
    assert found.after_mm3 < 0.02 * found.before_mm3


def test_pieces_that_share_nodes_stay_together_there_and_part_elsewhere() -> None:
    pieces = halves(joined_mm=JOINED_MM)
    u = pushed(pieces, 3.0)
    found = hold_apart(pieces, u, Tissue(), LOWER, OPEN)
    assert found.before_mm3 > 2000
    assert np.linalg.norm(found.u, axis=1).max() < 6
    assert found.after_mm3 < 0.01 * found.before_mm3
    assert deepest(pieces, u + found.u) < 0.3
    assert len(np.unique(pieces.mesh.tets)) == len(pieces.mesh.points)


def test_no_piece_is_pushed_through_the_wall(monkeypatch: pytest.MonkeyPatch) -> None:
    """The wall stands at the lower piece's foot, so that only the upper one can give way: by all of the overlap."""
    monkeypatch.setattr(separation, "NEAR_MM", 100.0)
    pieces, by_mm = halves(), 3.0
    u = pushed(pieces, by_mm)
    grid = np.broadcast_to((np.arange(60) * 5.0 - 100 + RADIUS_MM)[None, None], (40, 40, 60)).copy()
    found = hold_apart(pieces, u, Tissue(), NOTHING, LevelSet(grid, np.full(3, -100.0), 5.0))
    lower = pieces.node_piece() == 1
    foot = pieces.mesh.points[lower, 2].min()
    assert (pieces.mesh.points + u + found.u)[lower, 2].min() > min(foot, -RADIUS_MM) - 0.05
    assert found.u[~lower, 2].mean() > 0.65 * by_mm  # half of it without a wall
    assert found.after_mm3 < 0.01 * found.before_mm3


def test_pieces_apart_are_left_as_they_are() -> None:
    pieces = halves()
    found = hold_apart(pieces, -pushed(pieces, 4.0), Tissue(), NOTHING, OPEN)
    assert found.contact is None
    assert found.before_mm3 == 0
    assert_array_equal(found.u, 0)
