"""Blocks of two images that a map aligns to a few millimetres: found by value and sign, right up to a border."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from registration.correspondences import Correspondences
from registration.keypoints.aligned_matching import AlignedSettings, Linearized, match_aligned, organ_of
from registration.volume import Array, Grid, Mask, Volume
from tests.registration.scenes import make_pattern

STRETCH = np.array([[1.2, 0.1, 0.0], [-0.05, 0.9, 0.08], [0.0, -0.1, 1.1]])
SHIFT_MM = np.array([14.0, -9.0, 6.0])
OFF_MM = np.array([2.0, -1.5, 1.0])
"""By how much the map that is given is wrong, in the moving image."""
WALL_MM = 20.0
SLIP_MM = np.array([0.0, 5.0, -4.0])
"""How far what lies beyond the wall, at R > WALL_MM, has moved along it, against the organ."""
pattern = make_pattern(seed=4, waves=200, shortest_mm=9.0)
beyond = make_pattern(seed=5, waves=200, shortest_mm=9.0)


def grid(half_mm: float, spacing: float) -> Grid:
    count = round(2 * half_mm / spacing) + 1
    affine = np.diag([spacing, spacing, spacing, 1.0])
    affine[:3, 3] = -half_mm
    return Grid((count, count, count), affine)


def moved(points: Array) -> Array:
    """Where the organ's tissue lies in the moving image."""
    return points @ STRETCH.T + SHIFT_MM


FAR = AlignedSettings(reach_mm=6.0)


def given(points: Array) -> Linearized:
    """The map that aligns both images but for OFF_MM."""
    return Linearized(moved(points) + OFF_MM, np.broadcast_to(STRETCH, (len(points), 3, 3)))


@lru_cache(maxsize=2)
def images(wall: bool) -> tuple[tuple[Volume, Mask], tuple[Volume, Mask]]:
    """One organ in two images, and where it lies; with a wall, something else lies beyond it and slides."""
    fixed, moving = grid(36.0, 1.5), grid(60.0, 1.5)
    here, back = fixed.points(), (moving.points() - SHIFT_MM) @ np.linalg.inv(STRETCH).T
    hu_here, hu_there = pattern(here), pattern(back)
    organ_here, organ_there = (p[..., 0] <= WALL_MM if wall else np.ones(p.shape[:3], bool) for p in (here, back))
    hu_here = np.where(organ_here, hu_here, 3 * beyond(here))
    hu_there = np.where(organ_there, hu_there, 3 * beyond(back - SLIP_MM))
    return (
        (Volume(hu_here.astype(np.float32), fixed.ras_from_ijk), Mask(organ_here, fixed.ras_from_ijk)),
        (Volume(hu_there.astype(np.float32), moving.ras_from_ijk), Mask(organ_there, moving.ras_from_ijk)),
    )


def matched(wall: bool, points: Array, settings: AlignedSettings = FAR) -> Correspondences:
    """What is found of the organ alone."""
    fixed, moving = images(wall)
    return match_aligned(organ_of(*fixed), organ_of(*moving), points, given, settings)


def test_blocks_are_found_where_the_tissue_went() -> None:
    points = np.random.default_rng(0).uniform(-20, 20, (150, 3))
    found = matched(False, points)
    assert len(found) > 100
    assert np.linalg.norm(found.moving - moved(found.fixed), axis=1).mean() < 0.5
    assert np.median(np.linalg.norm(given(found.fixed).values - moved(found.fixed), axis=1)) > 2.5
    assert (np.abs(found.fixed[:, None] - points[None]).max(axis=2).min(axis=1) <= 0.751).all()
    assert (found.ncc >= 0.6).all()


def test_what_slides_beyond_a_wall_has_no_say() -> None:
    points = np.random.default_rng(1).uniform(-20, 20, (300, 3))
    points[:, 0] = WALL_MM - np.abs(points[:, 0]) / 8
    cut = matched(True, points)
    assert len(cut) > 60
    assert np.linalg.norm(cut.moving - moved(cut.fixed), axis=1).mean() < 0.7
    assert np.linalg.norm((cut.moving - moved(cut.fixed)).mean(axis=0)) < 0.2
    assert (cut.fixed[:, 0] <= WALL_MM).all()
    fixed, moving = (
        organ_of(image, Mask(np.ones_like(region.inside), region.ras_from_ijk)) for image, region in images(wall=True)
    )
    whole = match_aligned(fixed, moving, points, given, FAR)
    right = np.linalg.norm(whole.moving - moved(whole.fixed), axis=1) < 1.0
    assert right.sum() < 0.5 * len(cut)


def test_a_block_farther_off_than_the_reach_is_not_found() -> None:
    points = np.random.default_rng(2).uniform(-20, 20, (60, 3))
    found = matched(False, points, AlignedSettings(reach_mm=1.5))
    assert (np.linalg.norm(found.moving - given(found.fixed).values, axis=1) < 4.5).all()
    assert len(found) < 20


def test_one_block_that_goes_another_way_than_those_about_it_is_left_out() -> None:
    points = np.random.default_rng(3).uniform(-20, 20, (150, 3))
    few, many = (matched(False, points, s) for s in (AlignedSettings(reach_mm=6.0, outlier_mm=0.3), FAR))
    off = [np.linalg.norm(m.moving - moved(m.fixed), axis=1) for m in (few, many)]
    assert 0 < len(few) < len(many)
    assert off[0].max() < off[1].max()


def test_a_region_on_another_grid_is_refused() -> None:
    (fixed, _), (_, region) = images(wall=False)
    with pytest.raises(ValueError, match="lie on"):
        organ_of(fixed, region)
