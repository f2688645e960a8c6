"""Correspondences are believed for a reason: votes of the nearest matches, the way there and back, motion like the
neighbours'.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from registration.correspondences import Correspondences
from registration.keypoints import propagation
from registration.keypoints.affine_matching import BlockMatches, MaskedImage, match_affine_blocks
from registration.keypoints.matching import MatchSettings, match_keypoints, moves_with_neighbours
from registration.keypoints.propagation import (
    PropagationSettings,
    _best_of_each,
    _proposals,
    has_consensus,
    local_affines,
    propagate_matches,
)
from registration.volume import Array, Mask, Volume
from tests.registration.scenes import image_of, make_pattern, oriented

SETTINGS = PropagationSettings(MatchSettings())
TURN = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
SHIFT = np.array([9.0, -4.0, 2.0])
GRID = oriented("LPS", (40, 38, 36), 2.0, np.array([10.0, -20.0, 30.0]))
MIDDLE = GRID.to_ras((np.array(GRID.shape) - 1) / 2)
PATTERN = make_pattern(seed=8, waves=150, shortest_mm=10.0)
EVERYWHERE = Mask(np.ones(GRID.shape, bool), GRID.ras_from_ijk)


def turned(points: Array) -> Array:
    """Where the moving image shows a point of the fixed one."""
    return np.asarray((points - MIDDLE) @ TURN.T + MIDDLE + SHIFT)


def ring(count: int, radius: float, seed: int = 0) -> Array:
    """Points about MIDDLE."""
    x = np.random.default_rng(seed).normal(size=(count, 3))
    return np.asarray(MIDDLE + radius * x / np.linalg.norm(x, axis=1, keepdims=True))


@pytest.mark.parametrize(("votes", "believed"), [(0, False), (1, False), (2, True), (3, True), (8, True)])
def test_a_new_match_needs_votes_of_two_of_its_eight_nearest(votes: int, believed: bool) -> None:
    x = ring(8, 10.0)
    moving = turned(x)
    moving[votes:] += [0.0, 0.0, 40.0]  # these expect it elsewhere
    farther = ring(5, 14.0, seed=1)  # these would vote for it, but are not asked
    matches = Correspondences.of(np.concatenate([x, farther]), np.concatenate([moving, turned(farther)]))
    affines = np.tile(TURN, (13, 1, 1))
    new = Correspondences.of(MIDDLE[None], turned(MIDDLE[None]))
    assert has_consensus(new, matches, affines, SETTINGS).tolist() == [believed]


def test_a_vote_expects_a_match_within_five_millimetres_turned_as_the_voter_is() -> None:
    x = ring(8, 10.0)
    matches, affines = Correspondences.of(x, turned(x)), np.tile(TURN, (8, 1, 1))
    at = np.tile(MIDDLE, (2, 1))
    off = Correspondences.of(at, turned(at) + np.array([[0, 4.9, 0], [0, 5.1, 0]]))
    assert has_consensus(off, matches, affines, SETTINGS).tolist() == [True, False]
    aside = np.tile(MIDDLE + np.array([6.0, 0, 0]), (1, 1))
    assert has_consensus(Correspondences.of(aside, turned(aside)), matches, affines, SETTINGS).tolist() == [True]
    straight = np.tile(np.eye(3), (8, 1, 1))  # gradients that do not know the turn miss by up to 2 x 10 mm
    assert (np.linalg.norm(turned(at[:1]) - (turned(x) + MIDDLE - x), axis=1) > 5).sum() > 6
    assert has_consensus(Correspondences.of(at[:1], turned(at[:1])), matches, straight, SETTINGS).tolist() == [False]


def test_fewer_matches_than_voters_are_all_asked() -> None:
    x = ring(3, 8.0)
    matches = Correspondences.of(x, turned(x))
    new = Correspondences.of(MIDDLE[None], turned(MIDDLE[None]))
    assert has_consensus(new, matches, np.tile(TURN, (3, 1, 1)), SETTINGS).tolist() == [True]


def test_one_that_moves_against_the_others_does_not_bend_their_gradients() -> None:
    x = MIDDLE + np.random.default_rng(3).uniform(-20, 20, (60, 3))
    moving = turned(x)
    moving[17] += [15.0, -10.0, 5.0]
    affines = local_affines(Correspondences.of(x, moving), 12)
    others = np.arange(60) != 17
    assert np.abs(affines[others] - TURN).max() < 0.15
    assert not moves_with_neighbours(x, moving - x, 10, 12.0)[17]


def test_a_proposal_lies_where_its_match_and_the_gradient_about_it_say_and_is_made_once() -> None:
    x = ring(6, 12.0, seed=4)
    matches = Correspondences.of(x, turned(x))
    affines, none = np.tile(TURN, (6, 1, 1)), np.zeros(0, np.int64)
    keypoints = MIDDLE + np.array([[1.0, 2, -1], [5, 0, 0], [60, 0, 0], [0, 5, 0]])
    is_open = np.array([True, True, True, False])
    proposals, tried = _proposals(keypoints, is_open, matches, affines, none, SETTINGS)
    # All matches agree, so one proposes for each open keypoint within reach: its nearest.
    assert_array_equal(proposals.keypoint, [0, 1])
    assert_allclose(proposals.moving, turned(keypoints[:2]), atol=1e-9)
    assert_array_equal(proposals.match, np.linalg.norm(keypoints[:2, None] - x, axis=2).argmin(axis=1))
    matches.moving[proposals.match[0]] += [0, 0, 30.0]  # now that match differs, and another one proposes beside it
    more, _ = _proposals(keypoints[:1], is_open[:1], matches, affines, none, SETTINGS)
    assert len(more.keypoint) == 2
    assert_allclose(sorted(more.moving[:, 2] - turned(keypoints[:1])[0, 2]), [0, 30.0], atol=1e-9)
    again, _ = _proposals(keypoints[:1], is_open[:1], matches, affines, tried, SETTINGS)
    assert proposals.match[0] not in again.match


def test_of_several_proposals_for_a_keypoint_the_best_correlation_counts() -> None:
    best = _best_of_each(np.array([4, 7, 4, 7, 9]), np.array([0.7, 0.9, 0.8, 0.6, -1.0]))
    assert sorted(best.tolist()) == [1, 2]


class Blocks:
    """Stands in for `match_affine_blocks`: every block lies one voxel along each axis from where it was proposed."""

    shift = np.array([1.0, 1.0, 1.0])

    def __init__(self, ncc: float, round_trip: float) -> None:
        self.ncc, self.round_trip = ncc, round_trip
        self.calls: list[tuple[Any, ...]] = []

    def __call__(self, *values: Any) -> BlockMatches:
        self.calls.append(values)
        count = len(values[2])
        return BlockMatches(np.tile(self.shift, (count, 1)), np.full(count, self.ncc), np.full(count, self.round_trip))


@pytest.mark.parametrize(
    ("ncc", "round_trip", "propagates"), [(0.7, 0.0, True), (0.59, 0.0, False), (0.7, 1.0, True), (0.7, 1.1, False)]
)
def test_a_block_that_correlates_too_little_or_does_not_lead_back_is_no_match(
    monkeypatch: pytest.MonkeyPatch, ncc: float, round_trip: float, propagates: bool
) -> None:
    blocks = Blocks(ncc, round_trip)
    monkeypatch.setattr(propagation, "match_affine_blocks", blocks)
    x = MIDDLE + np.random.default_rng(5).uniform(-15, 15, (20, 3))
    fixed, moving = image_of(PATTERN, GRID), image_of(PATTERN, GRID)
    matches = propagate_matches(fixed, moving, EVERYWHERE, EVERYWHERE, Correspondences.of(x, turned(x)), SETTINGS)
    assert blocks.calls
    assert (len(matches) > 20) is propagates
    new = matches.only(np.arange(20, len(matches)))
    if not propagates:
        return
    # A voxel of the fixed image on from the proposal, turned as the neighbours say; the first step is off by no more.
    step = TURN @ (GRID.ras_from_ijk[:3, :3] @ blocks.shift)
    first_round = np.linalg.norm(new.fixed[:, None] - x, axis=2).min(axis=1) < 25.0
    off = np.linalg.norm(new.moving - turned(new.fixed) - step, axis=1)
    assert (off[first_round] < 0.1).mean() > 0.3
    assert_array_equal(new.ncc, np.full(len(new), ncc))


@pytest.fixture(scope="module")
def moved() -> Volume:
    """The moving image: what the fixed one shows at x, this one shows at turned(x)."""
    return image_of(lambda y: PATTERN((y - MIDDLE - SHIFT) @ TURN + MIDDLE), GRID)


def test_a_wrong_match_among_right_ones_stays_alone(moved: Volume) -> None:
    x = MIDDLE + np.random.default_rng(6).uniform([-16, -16, -16], [16, 16, 16], (30, 3))
    moving = turned(x)
    moving[11] += [-14.0, 9.0, 12.0]
    seeds = Correspondences.of(x, moving)
    matches = propagate_matches(image_of(PATTERN, GRID), moved, EVERYWHERE, EVERYWHERE, seeds, SETTINGS)
    new = matches.only(np.arange(30, len(matches)))
    assert len(new) > 10
    assert np.linalg.norm(new.moving - turned(new.fixed), axis=1).max() < 2.0


def test_a_block_found_by_chance_does_not_lead_back() -> None:
    """The moving image shows the block of another point, a step aside: there and back ends at that point."""
    fixed = image_of(PATTERN, GRID)
    start, aside = np.array([[20, 19, 18]]), np.array([3, -2, 0])
    lonely = np.full(GRID.shape, -700.0, np.float32) + np.random.default_rng(1).normal(0, 1, GRID.shape)
    here, there = start[0], start[0] + aside
    cut = lambda at: tuple(slice(a - 3, a + 4) for a in at)  # noqa: E731
    lonely[cut(here)] = fixed.hu[cut(there)]
    whole = np.ones(GRID.shape, bool)
    affines = np.concatenate([np.eye(3), start[0][:, None]], axis=1)[None].astype(float)
    blended = 0.6 * fixed.hu + 0.4 * np.roll(fixed.hu, tuple(-aside), (0, 1, 2))
    found = match_affine_blocks(
        MaskedImage(np.where(np.abs(np.indices(GRID.shape).T - here).max(axis=3).T <= 3, blended, fixed.hu), whole),
        MaskedImage(lonely.astype(np.float32), whole),
        start,
        affines,
        5,
    )
    assert found.ncc[0] > 0.5
    assert found.round_trip[0] == pytest.approx(np.linalg.norm(aside))


def test_matches_say_where_the_moving_image_shows_a_point_of_the_fixed_one() -> None:
    """By value and sign, on axes that point to the left, back and head; a wrong part moves otherwise and is dropped."""
    shift = np.array([6.0, -4.0, 2.0])
    fixed = image_of(PATTERN, GRID)
    moving = image_of(lambda points: PATTERN(points - shift), GRID)
    matches = match_keypoints(fixed, moving, EVERYWHERE)
    assert len(matches) > 30
    assert_allclose(np.median(matches.moving - matches.fixed, axis=0), shift, atol=0.2)
    assert np.linalg.norm(matches.moving - matches.fixed - shift, axis=1).max() < MatchSettings().outlier_mm
    assert (matches.ncc >= MatchSettings().least_ncc).all()
    back = match_keypoints(moving, fixed, EVERYWHERE)
    assert_allclose(np.median(back.moving - back.fixed, axis=0), -shift, atol=0.2)
