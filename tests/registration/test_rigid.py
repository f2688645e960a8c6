"""Rigid transforms and the spine: poses by value, from any start, and a slip by one vertebra told apart."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from registration import spine
from registration.maps.rigid import RigidTransform
from registration.spine import RigidStatus, SpineSearch, _near_spine, _refined, register_spine
from registration.volume import Array, Grid, Mask, Volume
from tests.registration.scenes import oriented

CENTRE = np.array([0.0, -60.0, 100.0])
PITCH = 24.0


def spine_hu(points: Array, marked: float = 1.0) -> Array:
    """A column of equal vertebrae every 24 mm along S in soft tissue; ribs lengthen downwards, times `marked`."""
    x, y, z = (points - CENTRE).T
    phase = (z + 2000.5 * PITCH) % PITCH - PITCH / 2
    level = np.floor((z + 2000.5 * PITCH) / PITCH) - 2000
    hu = np.full(len(points), 40.0)
    hu[np.hypot(x, y) > 60] = -800.0
    body = (np.hypot(x, y) < 16) & (np.abs(phase) < 9)
    process = (np.abs(x) < 4) & (y < -14) & (y > -40) & (np.abs(phase + 3) < 6)
    reach = 36 + marked * 7 * level
    rib = (np.abs(phase) < 4) & (np.abs(y + 14) < 4) & (np.abs(x) < reach) & (np.abs(x) > 18)
    hu[body] = 350.0
    hu[process | rib] = 600.0
    return hu


def scene(grid: Grid, move: RigidTransform | None = None, marked: float = 1.0) -> Volume:
    points = grid.points().reshape(-1, 3)
    hu = spine_hu(points if move is None else move(points), marked).reshape(grid.shape)
    return Volume(hu.astype(np.float32), grid.ras_from_ijk)


def column(grid: Grid, move: RigidTransform) -> Mask:
    points = move(grid.points().reshape(-1, 3)) - CENTRE
    return Mask((np.hypot(points[:, 0], points[:, 1] + 5) < 25).reshape(grid.shape), grid.ras_from_ijk)


MOVING = oriented("RAS", (60, 60, 110), 3.0, CENTRE)


def fixed_grid(move: RigidTransform) -> Grid:
    """Where the fixed image must lie to see the spine's middle."""
    return oriented("LPS", (44, 44, 46), 3.0, move.inverse()(CENTRE[None])[0] + np.array([5.0, -5.0, -10.0]))


FAST = SpineSearch(shift_mm=60.0, surroundings_mm=30.0)


@pytest.mark.parametrize(
    ("turn_degrees", "shift"), [((0, 0, 14), (8, -5, 30)), ((12, -8, -10), (-20, 15, -35)), ((-5, 4, 0), (0, 0, 3))]
)
def test_the_pose_comes_back_from_far_away(turn_degrees: Array, shift: Array) -> None:
    move = RigidTransform.about(CENTRE, np.radians(turn_degrees), np.array(shift, dtype=float))
    grid = fixed_grid(move)
    fit = register_spine(scene(grid, move), scene(MOVING), column(grid, move), search=FAST)
    assert fit.status is RigidStatus.FOUND
    probe = CENTRE + np.array([[0, 0, 0], [20, 0, 0], [0, 20, 0], [0, 0, 40.0]])
    assert np.linalg.norm(fit.moving_from_fixed(probe) - move(probe), axis=1).max() < 0.8
    assert fit.runner_up_ncc < fit.ncc - FAST.margin
    assert_allclose(fit.runner_up_shift_mm, PITCH, atol=4.0)


def test_equal_vertebrae_are_called_ambiguous() -> None:
    """Without ribs that tell them apart, one vertebra up or down looks the same, and must not pass for found."""
    move = RigidTransform.about(CENTRE, np.radians([0.0, 5.0, 8.0]), np.array([4.0, 2.0, 10.0]))
    grid = fixed_grid(move)
    fit = register_spine(scene(grid, move, marked=0.0), scene(MOVING, marked=0.0), column(grid, move), search=FAST)
    assert fit.status is RigidStatus.AMBIGUOUS


def test_a_start_nearby_replaces_the_search() -> None:
    move = RigidTransform.about(CENTRE, np.radians([10.0, 0.0, 20.0]), np.array([90.0, 60.0, -80.0]))
    near = RigidTransform.about(CENTRE, np.zeros(3), np.array([3.0, -2.0, 4.0])) @ move
    close = SpineSearch(shift_mm=10.0, angle_degrees=8.0, surroundings_mm=30.0)
    grid = fixed_grid(move)
    fit = register_spine(scene(grid, move), scene(MOVING), column(grid, move), initial=near, search=close)
    assert_allclose(fit.moving_from_fixed(CENTRE[None]), move(CENTRE[None]), atol=0.8)


def test_a_hint_overrides_the_search() -> None:
    """A start one vertebra off, with less than half a vertebra to search, stays there, and the better pose is told."""
    move = RigidTransform.about(CENTRE, np.radians([0.0, 5.0, 8.0]), np.array([4.0, 2.0, 10.0]))
    slipped = RigidTransform.about(CENTRE, np.zeros(3), np.array([0.0, 0.0, PITCH])) @ move
    held = SpineSearch(shift_mm=10.0, surroundings_mm=30.0)
    grid = fixed_grid(move)
    fit = register_spine(scene(grid, move), scene(MOVING), column(grid, move), initial=slipped, search=held)
    assert_allclose(fit.moving_from_fixed(CENTRE[None]), slipped(CENTRE[None]), atol=4.0)
    assert fit.runner_up_ncc > fit.ncc
    assert fit.status is RigidStatus.AMBIGUOUS


def test_the_starts_of_a_search_lie_apart_by_place_or_by_turn() -> None:
    move = RigidTransform.about(CENTRE, np.radians([0.0, 5.0, 8.0]), np.array([4.0, 2.0, 10.0]))
    grid = fixed_grid(move)
    level = spine._levels(scene(grid, move), scene(MOVING), column(grid, move), None, None, 30.0)[0]
    search = SpineSearch(shift_mm=20.0, surroundings_mm=30.0)
    starts = spine._coarse(level, CENTRE, move.inverse(), search, None)
    assert len(starts) == 24
    for n, one in enumerate(starts):
        for other in starts[:n]:
            far = np.linalg.norm(one(CENTRE[None]) - other(CENTRE[None]))
            turn = Rotation.from_matrix(one.matrix[:3, :3] @ other.matrix[:3, :3].T).magnitude()
            assert far > 12.0 or np.degrees(turn) > 15.0


def test_nothing_in_common_is_called_poor() -> None:
    still = RigidTransform.identity()
    noise = Volume(np.random.default_rng(0).normal(0, 200, MOVING.shape).astype(np.float32), MOVING.ras_from_ijk)
    grid = fixed_grid(still)
    fit = register_spine(scene(grid), noise, column(grid, still), search=FAST)
    assert fit.status is RigidStatus.POOR


def test_transforms_compose_and_invert() -> None:
    rng = np.random.default_rng(0)
    a = RigidTransform.about(CENTRE, np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0]))
    b = RigidTransform.about(np.zeros(3), np.array([0.0, -0.5, 0.1]), np.array([-4.0, 0.0, 9.0]))
    x = rng.normal(scale=50, size=(20, 3))
    assert_allclose((a @ b)(x), a(b(x)), atol=1e-10)
    assert_allclose(a.inverse()(a(x)), x, atol=1e-10)
    quarter = RigidTransform.about(np.zeros(3), np.array([0, 0, np.pi / 2]), np.zeros(3))
    assert_allclose(quarter(np.array([[1.0, 0.0, 0.0]])), [[0.0, 1.0, 0.0]], atol=1e-12)
    assert_allclose(quarter.angle_degrees, 90.0)


def test_mirrors_and_scalings_are_refused() -> None:
    with pytest.raises(ValueError, match="proper rotation"):
        RigidTransform(np.diag([-1.0, 1.0, 1.0, 1.0]))
    with pytest.raises(ValueError, match="proper rotation"):
        RigidTransform(np.diag([1.1, 1.0, 1.0, 1.0]))


def test_an_empty_spine_is_refused() -> None:
    grid = fixed_grid(RigidTransform.identity())
    empty = Mask(np.zeros(grid.shape, dtype=bool), grid.ras_from_ijk)
    with pytest.raises(ValueError, match="spine mask is empty"):
        register_spine(scene(grid), scene(MOVING), empty)


@pytest.mark.parametrize("height", [4, 200])
def test_places_near_a_spine_are_those_within_reach_of_a_voxel_of_it(height: int) -> None:
    """A rod along S of few voxels, and one of more than are compared."""
    grid = oriented("RAS", (24, 24, height + 20), 2.0, CENTRE)
    inside = np.zeros(grid.shape, dtype=bool)
    inside[8:16, 8:16, 10 : 10 + height] = True
    spine = Mask(inside, grid.ras_from_ijk)
    first, last = grid.to_ras(np.array([[8.0, 8, 10], [12, 12, 8 + height]]))  # every fourth and second voxel is asked
    beside, beyond = np.array([-1.0, 0, 0]), np.array([0, 0, 1.0])
    points = np.stack([first + 29 * beside, first + 31 * beside, last + 29 * beyond, last + 31 * beyond])
    assert _near_spine(spine, points).tolist() == [True, False, True, False]


def test_of_poses_refined_coarsely_the_best_distinct_ones_are_refined_finely(monkeypatch: pytest.MonkeyPatch) -> None:
    """8 mm make a pose another one; at most so many are taken, and none without any correlation."""

    def shifted(mm: float) -> RigidTransform:
        return RigidTransform.about(np.zeros(3), np.zeros(3), np.array([mm, 0.0, 0.0]))

    score = {0.0: 0.9, 5.0: 0.8, 20.0: 0.7, 40.0: 0.6, 60.0: -1.0}
    poses = {mm: shifted(mm) for mm in score}
    asked: list[tuple[object, float]] = []

    def refine(level: object, pose: RigidTransform, _centre: Array, _steps: int) -> tuple[RigidTransform, float]:
        mm = float(pose.matrix[0, 3])
        asked.append((level, mm))
        return pose, score[mm]

    monkeypatch.setattr(spine, "_refine", refine)
    levels: Any = ("coarse", "fine")
    for most, kept in ((2, [0.0, 20.0]), (5, [0.0, 20.0, 40.0])):
        asked.clear()
        found = _refined(list(poses.values())[::-1], levels, np.zeros(3), most)
        assert [ncc for _, ncc in found] == [score[mm] for mm in kept]
        assert [mm for level, mm in asked if level == "fine"] == kept
