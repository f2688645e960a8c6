"""Match propagation: past the reach of a search, up to borders, along each side of a jump and not across it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from registration.correspondences import Correspondences
from registration.keypoints.affine_matching import MaskedImage, match_affine_blocks
from registration.keypoints.matching import MatchSettings
from registration.keypoints.propagation import PropagationSettings, has_consensus, local_affines, propagate_matches
from registration.volume import Array, Grid, Mask, Volume
from tests.registration.scenes import Pattern, image_of, make_pattern, oriented, tilted

GRID = oriented("LPS", (50, 46, 44), 2.0, np.array([10.0, -20.0, 30.0]))
MIDDLE = GRID.to_ras((np.array(GRID.shape) - 1) / 2)
PATTERN = make_pattern(seed=4, waves=150, shortest_mm=9.0)
SETTINGS = PropagationSettings(MatchSettings())
BEND = 0.005


def bent(points: Array) -> Array:
    """Where the moving image shows a point of the fixed one, mm: a shear that grows along the first axis, from 0.1 to
    0.8 between the seeds and the far end of GRID, where it has moved points by 32 mm.
    """
    x = points - MIDDLE
    return MIDDLE + np.stack([x[..., 0], 0.9 * x[..., 1], x[..., 2] + BEND * (x[..., 0] + 40) ** 2], axis=-1)


def unbent(points: Array) -> Array:
    """The way back."""
    y = points - MIDDLE
    return MIDDLE + np.stack([y[..., 0], y[..., 1] / 0.9, y[..., 2] - BEND * (y[..., 0] + 40) ** 2], axis=-1)


def bent_image(grid: Grid, pattern: Pattern = PATTERN) -> Volume:
    return image_of(lambda points: pattern(unbent(points)), grid)


def everywhere(grid: Grid) -> Mask:
    return Mask(np.ones(grid.shape, bool), grid.ras_from_ijk)


def seeds(low: float = -40.0, high: float = -22.0) -> Correspondences:
    """Correspondences that are right, in a slice of the scene along the first axis."""
    x = np.random.default_rng(2).uniform([low, -30, -30], [high, 30, 30], (30, 3)) + MIDDLE
    return Correspondences.of(x, bent(x))


def test_keypoints_are_matched_far_beyond_the_reach_from_what_the_seeds_tell() -> None:
    wide = oriented("RAS", (54, 50, 80), 2.0, MIDDLE + np.array([0, 0, 20]))
    moving, fixed = bent_image(wide), image_of(PATTERN, GRID)
    matches = propagate_matches(fixed, moving, everywhere(GRID), everywhere(wide), seeds(), SETTINGS)
    far = matches.fixed[:, 0] - MIDDLE[0] > 15
    motion = bent(matches.fixed) - matches.fixed
    assert motion[far, 2].min() > motion[: len(seeds()), 2].max() + MatchSettings().reach_mm
    assert far.sum() > 40
    error = np.linalg.norm(matches.moving - bent(matches.fixed), axis=1)
    assert np.median(error[len(seeds()) :]) < 0.5  # a quarter of a voxel
    assert error.max() < 2.5


def test_seeds_come_first_and_stay() -> None:
    matches = propagate_matches(
        image_of(PATTERN, GRID), bent_image(GRID), everywhere(GRID), everywhere(GRID), seeds(), SETTINGS
    )
    assert len(matches) > len(seeds())
    assert_allclose(matches.moving[: len(seeds())], seeds().moving)
    assert_allclose(matches.fixed[: len(seeds())], seeds().fixed)


def test_another_orientation_of_the_moving_image_changes_nothing() -> None:
    turn = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1.0]])
    errors = []
    for grid in (GRID, tilted(oriented("PSR", (50, 46, 44), 2.0, MIDDLE), turn)):
        matches = propagate_matches(
            image_of(PATTERN, GRID), bent_image(grid), everywhere(GRID), everywhere(grid), seeds(), SETTINGS
        )
        assert len(matches) > 80
        errors.append(np.median(np.linalg.norm(matches.moving - bent(matches.fixed), axis=1)[len(seeds()) :]))
    assert max(errors) < 0.5


def test_beside_a_border_what_lies_beyond_does_not_count() -> None:
    inside = np.linalg.norm(GRID.points() - MIDDLE, axis=-1) < 38.0
    before = np.linalg.norm(unbent(GRID.points()) - MIDDLE, axis=-1) < 38.0
    fixed, moving = image_of(PATTERN, GRID), bent_image(GRID)
    air = Volume(np.where(inside, fixed.hu, -1000).astype(np.float32), GRID.ras_from_ijk)
    wall = Volume(np.where(before, moving.hu, 50).astype(np.float32), GRID.ras_from_ijk)
    start = seeds(-25, -5).only(np.linalg.norm(seeds(-25, -5).fixed - MIDDLE, axis=1) < 30)
    regions = [Mask(region, GRID.ras_from_ijk) for region in (before, inside)]
    right = {}
    for name, (one, other) in {"lung": regions, "all": (everywhere(GRID), everywhere(GRID))}.items():
        matches = propagate_matches(air, wall, other, one, start, SETTINGS)
        new = matches.only(np.arange(len(start), len(matches)))
        error = np.linalg.norm(new.moving - bent(new.fixed), axis=1)
        far = np.linalg.norm(new.fixed - MIDDLE, axis=1)
        right[name] = ((far > 31.0) & (far < 38.0) & (error < 2.0)).sum()
        if name == "lung":
            assert np.median(error[far > 31.0]) < 1.0  # half a voxel
    assert right["lung"] > 2 * right["all"]


@pytest.mark.parametrize("both", [True, False])
def test_matches_propagate_on_each_side_of_a_jump_by_itself(both: bool) -> None:
    slide = np.array([0.0, 0.0, 20.0])

    def moving_of(points: Array) -> Array:
        return points + np.where(points[..., :1] > MIDDLE[0], 0.5, -0.5) * slide

    moving = image_of(lambda y: PATTERN(y - np.where(y[..., :1] > MIDDLE[0], 0.5, -0.5) * slide), GRID)
    x = np.random.default_rng(6).uniform([-40, -25, -20], [40, 25, 20], (80, 3))
    x = MIDDLE + x[(np.abs(x[:, 0]) > 22) & (both | (x[:, 0] < 0))]
    start = Correspondences.of(x, moving_of(x))
    matches = propagate_matches(image_of(PATTERN, GRID), moving, everywhere(GRID), everywhere(GRID), start, SETTINGS)
    new = matches.only(np.arange(len(start), len(matches)))
    error = np.linalg.norm(new.moving - moving_of(new.fixed), axis=1)
    across = new.fixed[:, 0] - MIDDLE[0]
    assert (error[np.abs(across) > 8] > 3).mean() < 0.02  # nearer, a block shows both sides
    assert ((across > 8).sum() > 20) == both


def test_nothing_propagates_from_images_without_anything_in_common_or_from_too_few() -> None:
    rng = np.random.default_rng(0)
    noise = Volume(rng.normal(-500, 60, GRID.shape).astype(np.float32), GRID.ras_from_ijk)
    fixed = image_of(PATTERN, GRID)
    assert len(propagate_matches(fixed, noise, everywhere(GRID), everywhere(GRID), seeds(), SETTINGS)) == len(seeds())
    few = seeds().only(np.arange(SETTINGS.neighbours))
    assert propagate_matches(fixed, bent_image(GRID), everywhere(GRID), everywhere(GRID), few, SETTINGS) is few
    nowhere = replace(everywhere(GRID), inside=np.zeros(GRID.shape, bool))
    assert len(propagate_matches(fixed, bent_image(GRID), nowhere, everywhere(GRID), seeds(), SETTINGS)) == len(seeds())


def test_local_affines_are_exact_for_an_affine_motion_and_keep_to_their_own_side_of_a_jump() -> None:
    gradient = np.array([[1.2, 0.1, 0], [-0.2, 0.9, 0.3], [0, 0.1, 1.1]])
    x = np.random.default_rng(1).uniform(-40, 40, (200, 3))
    assert_allclose(
        local_affines(Correspondences.of(x, x @ gradient.T), 12), np.tile(gradient, (200, 1, 1)), atol=1e-10
    )
    jump = np.where(x[:, :1] > 0, 40.0, 0.0) * np.array([0, 0, 1.0])
    affines = local_affines(Correspondences.of(x, x @ gradient.T + jump), 12)
    assert np.median(np.abs(affines - gradient).max(axis=(1, 2))[np.abs(x[:, 0]) < 8]) < 0.15


def test_a_match_that_its_neighbours_do_not_expect_finds_no_consensus() -> None:
    x = np.random.default_rng(1).uniform(-40, 40, (100, 3))
    matches = Correspondences.of(x, x + 3.0)
    new = Correspondences.of(np.zeros((2, 3)), np.array([[3.0, 3, 3], [3, 3, 12]]))
    assert has_consensus(new, matches, local_affines(matches, 12), SETTINGS).tolist() == [True, False]


def test_a_block_is_found_by_value_and_sign_in_an_image_that_is_turned() -> None:
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1.0]])
    fixed = image_of(PATTERN, GRID)
    moving = image_of(lambda points: PATTERN(MIDDLE + (points - MIDDLE) @ turn), GRID)
    start = np.array([[25, 23, 22]])
    matrix = np.linalg.inv(GRID.ras_from_ijk[:3, :3]) @ turn @ GRID.ras_from_ijk[:3, :3]
    truth = GRID.to_ijk((MIDDLE + turn @ (GRID.to_ras(start[0].astype(float)) - MIDDLE))[None])[0]
    shift = np.array([2.0, -1.0, 1.0])
    affines = np.concatenate([matrix, (truth - matrix @ shift)[:, None]], axis=1)[None]
    whole = np.ones(GRID.shape, bool)
    found = match_affine_blocks(MaskedImage(fixed.hu, whole), MaskedImage(moving.hu, whole), start, affines, 4)
    assert_allclose(found.shift[0], shift, atol=0.25)
    assert found.ncc[0] > 0.95
    assert found.round_trip[0] == 0
