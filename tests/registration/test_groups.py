"""Groups of matches: those that move as one stay, however far; strays, pairs and small groups go."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_array_equal

from registration.correspondences import Correspondences
from registration.keypoints.groups import GroupSettings, in_groups
from registration.volume import Array

TURN = np.array([[0.8, -0.5, 0.0], [0.5, 0.8, 0.1], [0.0, -0.1, 0.9]])


def cloud(seed: int, n: int, centre: tuple[float, float, float]) -> Array:
    return np.random.default_rng(seed).uniform(-22, 22, (n, 3)) + centre


def turned(points: Array, shift: tuple[float, float, float]) -> Array:
    """Far away, turned by a third of a right angle and smaller."""
    return points @ TURN.T + shift


def scene() -> tuple[Correspondences, Array]:
    """Two parts that moved otherwise, 150 and 60 matches; 40 strays between them; 12 matches that agree elsewhere; and
    which is which, 0 to 3.
    """
    one, two, few = cloud(1, 150, (0, 0, 0)), 0.7 * cloud(2, 60, (100, 0, 0)), 0.4 * cloud(3, 12, (0, 180, 0))
    stray = cloud(4, 40, (0, 0, 0))
    to = np.random.default_rng(5).uniform(-60, 60, (40, 3))
    fixed = np.concatenate([one, two, stray, few])
    moving = np.concatenate([turned(one, (90, 0, 0)), two - [0, 50, 0], to, few + np.array([20.0, 0, 0])])
    return Correspondences.of(fixed, moving), np.repeat([0, 1, 2, 3], [150, 60, 40, 12])


def test_parts_that_move_as_one_stay_and_strays_and_small_groups_go() -> None:
    matches, part = scene()
    kept = np.bincount(part[in_groups(matches, GroupSettings())], minlength=4)
    assert kept[0] > 130
    assert kept[1] > 50
    assert kept[2] <= 1
    assert kept[3] == 0


def test_a_group_has_to_be_large_beside_the_largest_one() -> None:
    matches, part = scene()
    alone = in_groups(matches, GroupSettings(least_share=0.6))
    assert set(part[alone]) == {0}
    small = in_groups(matches, GroupSettings(least_group=8, least_share=0.01, neighbours=8))
    assert (part[small] == 3).sum() > 8


def test_noise_has_no_groups_and_few_matches_none_either() -> None:
    rng = np.random.default_rng(6)
    noise = Correspondences.of(rng.uniform(-40, 40, (300, 3)), rng.uniform(-40, 40, (300, 3)))
    assert_array_equal(in_groups(noise, GroupSettings()), [])
    assert_array_equal(in_groups(noise.only(np.arange(12)), GroupSettings()), [])
    assert_array_equal(in_groups(Correspondences.none(), GroupSettings()), [])
