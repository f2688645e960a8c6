"""Keypoints: matched where the image is distinctive, by value and sign; refused where they cannot be believed."""

from __future__ import annotations

import numpy as np
import pytest

from registration.keypoints.matching import MatchSettings, distinctiveness, match_keypoints, moves_with_neighbours
from registration.volume import Mask, Volume
from tests.registration.scenes import image_of, make_pattern, oriented

GRID = oriented("LPS", (44, 40, 36), 2.0, np.array([10.0, -20.0, 30.0]))
EVERYWHERE = Mask(np.ones(GRID.shape, bool), GRID.ras_from_ijk)
PATTERN = make_pattern(seed=3)


@pytest.mark.parametrize("shift_ras", [(5.0, -3.0, 2.0), (-9.0, 4.0, 7.0)])
def test_a_shifted_image_gives_matches_that_differ_by_the_shift(shift_ras: tuple[float, float, float]) -> None:
    shift = np.array(shift_ras)
    fixed = image_of(PATTERN, GRID)
    moving = image_of(lambda points: PATTERN(points - shift), GRID)
    matches = match_keypoints(fixed, moving, EVERYWHERE)
    assert len(matches) > 180  # of some 210; half of them where blocks are looked for about a wrong voxel
    error = np.linalg.norm(matches.moving - matches.fixed - shift, axis=1)
    assert np.median(error) < 0.5  # a quarter of a voxel
    assert error.max() < 2.0


def test_brightness_and_contrast_do_not_matter() -> None:
    fixed = image_of(PATTERN, GRID)
    moving = image_of(lambda points: 300 + 0.4 * PATTERN(points - np.array([4.0, 0.0, -4.0])), GRID)
    matches = match_keypoints(fixed, moving, EVERYWHERE)
    assert np.median(np.abs(matches.moving - matches.fixed - [4.0, 0.0, -4.0])) < 0.4


def test_points_come_from_the_region_and_from_where_the_other_image_is_believed() -> None:
    fixed = image_of(PATTERN, GRID)
    half = GRID.points()[..., 2] > 30.0
    region = Mask(half, GRID.ras_from_ijk)
    matches = match_keypoints(fixed, fixed, EVERYWHERE, moving_region=region)
    assert matches.moving[:, 2].min() > 28.0
    matches = match_keypoints(fixed, fixed, region)
    assert matches.fixed[:, 2].min() > 29.0


def test_noise_without_anything_in_common_is_refused() -> None:
    rng = np.random.default_rng(0)
    one, other = (Volume(rng.normal(-500, 60, GRID.shape).astype(np.float32), GRID.ras_from_ijk) for _ in range(2))
    assert len(match_keypoints(one, other, EVERYWHERE)) == 0


def test_a_flat_image_has_no_points() -> None:
    flat = Volume(np.full(GRID.shape, -700.0, np.float32), GRID.ras_from_ijk)
    assert len(match_keypoints(flat, flat, EVERYWHERE)) == 0


def test_a_motion_beyond_the_reach_is_not_mistaken_for_a_smaller_one() -> None:
    fixed = image_of(PATTERN, GRID)
    moving = image_of(lambda points: PATTERN(points - np.array([20.0, 0.0, 0.0])), GRID)
    assert len(match_keypoints(fixed, moving, EVERYWHERE, MatchSettings(reach_mm=8.0))) < 4


def test_a_corner_is_distinctive_and_an_edge_is_not() -> None:
    r, a, s = (GRID.points() - GRID.to_ras(np.array([22.0, 20.0, 18.0]))).transpose(3, 0, 1, 2)
    edge = 100 * np.tanh(r / 3)
    corner = 100 * np.tanh(r / 3) * np.tanh(a / 3) * np.tanh(s / 3)
    assert distinctiveness(edge, GRID.spacing).max() < 1e-3 * distinctiveness(corner, GRID.spacing).max()


def test_one_that_moves_against_its_neighbours_is_dropped() -> None:
    points = np.random.default_rng(1).uniform(0, 50, (60, 3))
    motion = 0.1 * points
    motion[7] += [9.0, 0.0, 0.0]
    assert np.flatnonzero(~moves_with_neighbours(points, motion, 10, 5.0)).tolist() == [7]


def test_between_two_blurs_patches_of_one_image_alone_have_no_say() -> None:
    """Tissue that lost its air by patches: the fixed image gets a slow pattern of its own, thrice as strong."""
    shift = np.array([5.0, -3.0, 2.0])
    vessels, patches = make_pattern(seed=3, waves=120, shortest_mm=7.0), make_pattern(seed=8, shortest_mm=25.0)
    fixed = image_of(lambda points: vessels(points) + 3 * patches(points), GRID)
    moving = image_of(lambda points: vessels(points - shift), GRID)

    def right(settings: MatchSettings) -> int:
        matches = match_keypoints(fixed, moving, EVERYWHERE, settings)
        return int((np.linalg.norm(matches.moving - matches.fixed - shift, axis=1) < 2.0).sum())

    assert right(MatchSettings(band_voxels=(0.7, 1.6))) > 2 * right(MatchSettings())
