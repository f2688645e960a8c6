"""Independent keypoints: descriptions that know no grey values, and what is left over by value, sign and frame."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from registration.keypoints.blobs import blobs
from registration.keypoints.self_similarity import BLOCK_RADIUS, describe, find_similar
from registration.maps.rigid import RigidTransform
from registration.verification import LeftOver, VerifySettings, left_over, rigid_between
from registration.volume import Array, Grid, Mask, Volume
from tests.registration.scenes import image_of, make_pattern, oriented

CENTRE = np.array([10.0, -30.0, 120.0])
GRID = oriented("LPS", (48, 44, 40), 2.0, CENTRE)
PATTERN = make_pattern(3)
EVERYWHERE = Mask(np.ones(GRID.shape, bool), GRID.ras_from_ijk)
SETTINGS = VerifySettings(reach_mm=12.0, cell_mm=8.0)


def inner(margin: int) -> Mask:
    """The grid's voxels at least `margin` from its border."""
    inside = np.zeros(GRID.shape, bool)
    inside[margin:-margin, margin:-margin, margin:-margin] = True
    return Mask(inside, GRID.ras_from_ijk)


def scene(points: Array) -> Array:
    return PATTERN(points)


def test_descriptions_know_neither_gain_nor_offset() -> None:
    image = image_of(scene, GRID).hu
    needed = inner(6).inside
    assert_array_equal(describe(image, needed), describe(0.5 * image + 300, needed))
    assert len(np.unique(describe(image, needed)[needed])) > 1000
    assert not describe(image, needed)[~needed].any()


def test_thermometers_count_levels() -> None:
    """Flat but for one bright voxel: pairs of neighbours that differ are told from those that do not."""
    image = np.zeros((15, 15, 15))
    image[9, 7, 7] = 100.0
    code = int(describe(image, np.ones(image.shape, bool))[7, 7, 7])
    levels = [bin(code >> (5 * m) & 31).count("1") for m in range(12)]
    assert sorted(levels) == [0] * 4 + [5] * 8  # the four pairs with the neighbour at +i differ most, the others least


@pytest.mark.parametrize("shift", [(3, -2, 1), (0, 0, 0), (-4, 5, -3)])
def test_blocks_are_found_where_they_went(shift: tuple[int, int, int]) -> None:
    fixed = image_of(scene, GRID).hu
    moving = np.roll(fixed, shift, axis=(0, 1, 2))
    every = np.ones(fixed.shape, bool)
    starts = np.array([[20, 20, 20], [25, 22, 18], [18, 25, 22]])
    found = find_similar(describe(fixed, every), describe(moving, every), every, starts, 6)
    assert_allclose(found.shift, np.broadcast_to(shift, (3, 3)), atol=0.2)
    assert_array_equal(found.cost, 0)
    assert (found.runner_up > 5).all()
    assert found.is_inner.all()
    near = find_similar(describe(fixed, every), describe(moving, every), every, starts, 2)
    assert near.is_inner.all() == (max(map(abs, shift)) < 2)


@pytest.mark.parametrize("start", [(20, 20, 20), (2, 20, 20), (20, 41, 3), (5, 5, 36)])
def test_the_cost_is_the_mean_hamming_distance_over_voxels_in_both_images(start: tuple[int, int, int]) -> None:
    """Random descriptions; at the image's border the voxels of a block that lie in both images count."""
    rng = np.random.default_rng(4)
    fixed, moving = (rng.integers(0, 1 << 60, GRID.shape).astype(np.uint64) for _ in range(2))
    every, reach = np.ones(GRID.shape, bool), 1
    steps = np.stack(np.meshgrid(*[np.arange(-BLOCK_RADIUS, BLOCK_RADIUS + 1, 2)] * 3), -1).reshape(-1, 3)
    block = steps[np.linalg.norm(steps, axis=1) <= 1.12 * BLOCK_RADIUS]

    def cost(shift: Array) -> float:
        here, there = block + start, block + start + shift
        both = ((np.minimum(here, there) >= 0) & (np.maximum(here, there) < GRID.shape)).all(axis=1)
        apart = fixed[tuple(here[both].T)] ^ moving[tuple(there[both].T)]
        return float(np.mean([int(code).bit_count() for code in apart]))

    shifts = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 3), -1).reshape(-1, 3)
    expected = [cost(shift) for shift in shifts]
    found = find_similar(fixed, moving, every, np.array([start]), reach)
    assert found.cost[0] == pytest.approx(min(expected))
    assert_array_equal(np.rint(found.shift[0]), shifts[int(np.argmin(expected))])


def test_what_is_not_allowed_is_not_found() -> None:
    fixed = image_of(scene, GRID).hu
    code, every = describe(fixed, np.ones(fixed.shape, bool)), np.ones(fixed.shape, bool)
    start = np.array([[20, 20, 20]])
    every[18:23, 18:23, 18:23] = False
    found = find_similar(code, code, every, start, 4)
    assert found.cost[0] > 0
    assert np.abs(found.shift).max() > 2


def test_blobs_are_bright_or_dark_spots_and_no_straight_vessels() -> None:
    i, j, k = np.indices((40, 40, 40)).astype(float)
    vessel = 500 * np.exp(-((i - 10) ** 2 + (j - 10) ** 2) / 8)
    bright = 400 * np.exp(-((i - 28) ** 2 + (j - 28) ** 2 + (k - 12) ** 2) / 8)
    dark = -300 * np.exp(-((i - 28) ** 2 + (j - 12) ** 2 + (k - 28) ** 2) / 8)
    found = blobs(vessel + bright + dark, np.ones((40, 40, 40), bool), 1.25, 100)
    assert_array_equal(found, [[28, 28, 12]])  # one cell: the strongest
    both = blobs(vessel + bright + dark, j > 2, 1.25, 16)
    assert {(28, 28, 12), (28, 12, 28)} <= {tuple(map(int, v)) for v in both}
    hidden = blobs(bright, k > 20, 1.25, 16)
    assert not any(np.abs(v - (28, 28, 12)).max() < 6 for v in hidden)


@pytest.mark.parametrize("left", [(5.0, -3.0, 2.0), (0.0, 0.0, -9.0), (0.0, 0.0, 0.0)])
def test_left_over_by_value_and_sign(left: tuple[float, float, float]) -> None:
    """The moving image shows at x + left what the fixed one shows at x, darker and with less contrast."""
    fixed = image_of(scene, GRID)
    moving = image_of(lambda p: 0.6 * scene(p - np.array(left)) - 200, GRID)
    found = left_over(fixed, moving, inner(8), EVERYWHERE, SETTINGS)
    assert found.recognized_share > 0.6
    assert_allclose(found.shift, left, atol=0.15)
    assert np.linalg.norm(found.vectors - left, axis=1).max() < 1.0
    assert found.turn_degrees < 0.5
    assert inner(8).holds(found.points).all()


def test_a_turn_is_told_as_one() -> None:
    turn = RigidTransform.about(CENTRE, np.radians([0.0, 0.0, 6.0]), np.zeros(3))
    fixed, moving = image_of(scene, GRID), image_of(lambda p: scene(turn.inverse()(p)), GRID)
    found = left_over(fixed, moving, inner(8), EVERYWHERE, SETTINGS)
    assert found.turn_degrees == pytest.approx(6.0, abs=0.4)
    assert_allclose(found.points + found.vectors, turn(found.points), atol=1.5)


def test_another_scene_is_not_recognized() -> None:
    other = make_pattern(77)
    found = left_over(image_of(scene, GRID), image_of(other, GRID), inner(8), EVERYWHERE, SETTINGS)
    assert found.looked_for > 50
    assert found.recognized_share < 0.1


def test_nothing_is_left_over_where_nothing_is_seen() -> None:
    flat = Volume(np.full(GRID.shape, -800, np.float32), GRID.ras_from_ijk)
    nowhere = Mask(np.zeros(GRID.shape, bool), GRID.ras_from_ijk)
    for image, region in ((flat, EVERYWHERE), (image_of(scene, GRID), nowhere)):
        found = left_over(image, image, region, EVERYWHERE, SETTINGS)
        assert (found.looked_for, len(found.points), found.recognized_share) == (0, 0, 0.0)
        assert np.isnan(found.shift).all()
        assert np.isnan(found.turn_degrees)
        assert np.isnan(found.near(CENTRE, 30.0)).all()


def test_images_on_different_grids_are_refused() -> None:
    moved = Grid(GRID.shape, GRID.ras_from_ijk @ np.diag([1.0, 1.0, 1.01, 1.0]))
    with pytest.raises(ValueError, match="one grid"):
        left_over(image_of(scene, GRID), image_of(scene, moved), EVERYWHERE, EVERYWHERE)


def test_what_is_left_near_a_place_is_the_median_of_its_nearest() -> None:
    points = np.array([[0.0, 0, 0], [2, 0, 0], [4, 0, 0], [6, 0, 0], [100, 0, 0]])
    vectors = np.array([[1.0, 0, 2], [1, 0, 2], [3, 0, 4], [9, 0, 9], [50, 50, 50]])
    left = LeftOver(points, vectors, 10)
    assert left.recognized_share == 0.5
    assert_allclose(left.near(np.array([[1.0, 0, 0], [99.0, 0, 0]]), 10.0, 3), [[1, 0, 2], [np.nan] * 3])
    assert_allclose(left.shift, [3, 0, 4])


def test_the_best_rigid_motion_between_points() -> None:
    motion = RigidTransform.about(np.array([5.0, 1, 2]), np.array([0.3, -0.2, 0.5]), np.array([4.0, -9, 1]))
    points = np.random.default_rng(1).normal(size=(12, 3)) * [30, 20, 10]
    assert_allclose(rigid_between(points, motion(points)).matrix, motion.matrix, atol=1e-12)
    flat = points * [1, 1, 0]
    assert np.linalg.det(rigid_between(flat, flat * [1, -1, 1]).matrix[:3, :3]) == pytest.approx(1.0)
