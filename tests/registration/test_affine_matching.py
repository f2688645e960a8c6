"""Masked blocks: the correlation of numpy says the same, and a near look finds what a look at every shift finds."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from registration.keypoints.affine_matching import NEAR, MaskedImage, match_affine_blocks
from registration.volume import Array

SHAPE = (40, 38, 36)
REACH = 4
RNG = np.random.default_rng(3)


def image(spared: float = 0.0) -> MaskedImage:
    """Noise some voxels wide; a share `spared` of it, on one side, does not count."""
    hu = RNG.normal(size=SHAPE)
    for axis in range(3):
        hu = (hu + np.roll(hu, 1, axis) + np.roll(hu, 2, axis) + np.roll(hu, 3, axis)) / 4
    inside = np.arange(SHAPE[2]) >= spared * SHAPE[2]
    return MaskedImage((800 * hu).astype(np.float32), np.broadcast_to(inside, SHAPE).copy())


def moved(fixed: MaskedImage, shift: tuple[int, int, int], inside: Array | None = None) -> MaskedImage:
    """What shows at v + shift what the image shows at v, with a little noise."""
    hu = np.roll(fixed.hu, shift, (0, 1, 2)) + RNG.normal(0, 20, SHAPE)
    return MaskedImage(hu.astype(np.float32), np.roll(fixed.inside, shift, (0, 1, 2)) if inside is None else inside)


def standing(starts: Array) -> Array:
    """Affine maps (n, 3, 4) that leave every voxel where it is."""
    return np.concatenate([np.broadcast_to(np.eye(3), (len(starts), 3, 3)), starts[:, :, None]], axis=2).astype(float)


def inner_starts(number: int) -> Array:
    """Voxels (n, 3) whose blocks and search stay in the image."""
    margin = 3 + REACH + 1
    return np.unique(RNG.integers(margin, np.array(SHAPE) - margin, size=(number, 3)), axis=0)


@pytest.mark.parametrize("spared", [0.0, 0.4])
@pytest.mark.parametrize("shift", [(0, 0, 0), (1, -1, 0), (3, -3, 1)])
def test_a_near_look_finds_what_a_look_at_every_shift_finds(spared: float, shift: tuple[int, int, int]) -> None:
    """(3, -3, 1) is beyond NEAR: only the look farther off finds it, and not every time in texture this fine."""
    fixed = image(spared)
    moving, starts = moved(fixed, shift), inner_starts(60)
    every = match_affine_blocks(fixed, moving, starts, standing(starts), REACH)
    near = match_affine_blocks(fixed, moving, starts, standing(starts), REACH, 0.6)
    found = every.ncc > 0.9
    assert found.sum() > 20
    same = found & (np.abs(near.shift - every.shift).max(axis=1) < 1e-4)
    assert same.sum() >= (1.0 if max(np.abs(shift)) <= 1 else 0.7) * found.sum()
    assert_allclose(near.ncc[same], every.ncc[same], atol=1e-5)
    assert_allclose(every.shift[found], np.broadcast_to(shift, (found.sum(), 3)), atol=0.3)
    assert (near.round_trip[same] == 0).all()
    assert max(np.abs(shift)) <= 1 or max(np.abs(shift)) > NEAR


@pytest.mark.parametrize("sure", [np.inf, 0.6])
def test_the_score_is_the_correlation_of_what_counts_in_both(sure: float) -> None:
    fixed = image(0.4)
    other = np.zeros(SHAPE, bool)
    other[:, 16:] = True
    moving, starts = moved(fixed, (1, 0, 1), other), inner_starts(200)
    found = match_affine_blocks(fixed, moving, starts, standing(starts), REACH, sure)
    checked = 0
    for start, ncc, shift in zip(starts, found.ncc, found.shift, strict=True):
        if ncc < 0.9:
            continue
        cut, to = (tuple(slice(a - 3, a + 4) for a in v) for v in (start, start + np.rint(shift).astype(int)))
        both = fixed.inside[cut] & moving.inside[to]
        assert ncc == pytest.approx(np.corrcoef(fixed.hu[cut][both], moving.hu[to][both])[0, 1], abs=1e-4)
        checked += both.sum() < both.size
    assert checked > 10


def test_a_sure_block_near_by_is_taken_before_a_better_one_farther_off() -> None:
    """And without `sure` the better one is."""
    fixed, start, hu = image(), np.array([[20, 19, 18]]), np.zeros(SHAPE, np.float32)
    near_by, farther = (tuple(slice(a - 3, a + 4) for a in start[0] + off) for off in ((0, 0, 0), (0, 0, 7)))
    hu[farther] = fixed.hu[near_by]
    hu[near_by] = fixed.hu[near_by] + RNG.normal(0, 80, (7, 7, 7))
    moving = MaskedImage(hu, np.ones(SHAPE, bool))
    far = match_affine_blocks(fixed, moving, start, standing(start), 8)
    near = match_affine_blocks(fixed, moving, start, standing(start), 8, 0.6)
    assert np.rint(far.shift[0]).tolist() == [0, 0, 7]
    assert np.rint(near.shift[0]).tolist() == [0, 0, 0]
    assert 0.6 < near.ncc[0] < far.ncc[0] - 0.05
