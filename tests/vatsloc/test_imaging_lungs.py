"""Lungs, sides, airways and refusals in a CT that is known exactly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from registration.volume import Grid, Mask, Volume
from tests.vatsloc import imaging_thorax as known
from vatsloc.case import read_case
from vatsloc.errors import InputRefused
from vatsloc.frames import Side
from vatsloc.imaging.hilum import find_hilum
from vatsloc.imaging.lungs import _air_in_body, _midline, _sides, part_joined, segment_lungs


def ball(centre: tuple[float, float, float], radius: float) -> Mask:
    g = known.grid()
    return Mask(np.linalg.norm(g.points() - np.array(centre), axis=-1) < radius, g.ras_from_ijk)


@pytest.mark.parametrize("touching", [False, True])
def test_lungs_match_the_ellipsoids_and_know_their_sides(touching: bool) -> None:
    scene = known.thorax(touching=touching)
    lungs = segment_lungs(scene.volume, "right")
    assert known.dice(lungs.right, scene.lungs["right"]) > 0.96
    assert known.dice(lungs.left, scene.lungs["left"]) > 0.96
    assert not (lungs.left.inside & lungs.right.inside).any()
    assert abs(lungs.midline_r) < 5.0
    expected = 4 / 3 * np.pi * known.HALF_AXES.prod() / 1000
    assert_allclose(lungs.volume_ml["left"], expected, rtol=0.05)


@pytest.mark.parametrize("flips", [(1, 1, 1), (-1, -1, 1), (1, -1, -1)])
def test_sides_do_not_depend_on_how_voxels_are_stored(flips: tuple[int, int, int]) -> None:
    scene = known.thorax()
    hu, affine = scene.volume.hu, scene.volume.ras_from_ijk.copy()
    for axis, sign in enumerate(flips):
        if sign < 0:
            hu = np.flip(hu, axis)
            affine[:3, 3] += affine[:3, axis] * (hu.shape[axis] - 1)
            affine[:3, axis] *= -1
    lungs = segment_lungs(Volume(np.ascontiguousarray(hu.transpose(2, 0, 1)), affine[:, [2, 0, 1, 3]]), "left")
    inside = lungs.left.grid.to_ras(np.argwhere(lungs.left.inside).astype(float))
    assert_allclose(inside.mean(axis=0), known.CENTRES["left"], atol=3.0)


def test_airways_are_the_tree_and_do_not_leak() -> None:
    scene = known.thorax()
    lungs = segment_lungs(scene.volume, "right")
    assert known.dice(lungs.airways, scene.airways) > 0.85


def test_hilum_lies_where_the_bronchus_enters() -> None:
    scene = known.thorax()
    lungs = segment_lungs(scene.volume, "right")
    hilum = find_hilum(lungs.right, lungs.airways, "right")
    assert hilum.on_airways
    assert_allclose(hilum.point_ras, [33.0, 5.0, 1.0], atol=8.0)
    guessed = find_hilum(lungs.left, Mask(np.zeros_like(lungs.left.inside), lungs.left.ras_from_ijk), "left")
    assert not guessed.on_airways
    assert -45.0 < guessed.point_ras[0] < -20.0


@pytest.mark.parametrize("side", ["right", "left"])
def test_without_airways_the_hilum_is_the_middle_of_the_face_not_what_reaches_farthest_in(side: Side) -> None:
    """A lung whose medial face slants: its back lies 30 mm nearer to the middle than its front."""
    g = known.grid((60, 70, 80), 2.0, (60.0 if side == "right" else -60.0, 0.0, 0.0))
    x = g.points()
    outward = x[..., 0] if side == "right" else -x[..., 0]
    lung = (outward > 30 + 0.25 * x[..., 1]) & (outward < 110) & (np.abs(x[..., 1]) < 60) & (np.abs(x[..., 2]) < 70)
    found = find_hilum(Mask(lung, g.ras_from_ijk), Mask(np.zeros_like(lung), g.ras_from_ijk), side)
    assert abs(found.point_ras[1]) < 0.15 * 120 + 2.0
    assert abs(found.point_ras[2] - 0.05 * 140) < 0.1 * 140 + 2.0
    assert abs(found.point_ras[0]) < 36.0


def test_nodule_at_the_pleura_belongs_to_the_lung() -> None:
    scene = known.thorax()
    place = (known.CENTRES["right"][0] + known.HALF_AXES[0] - 2.0, 10.0, -10.0)
    nodule = ball(place, 7.0)
    hu = np.where(nodule.inside, np.float32(30), scene.volume.hu)
    lungs = segment_lungs(Volume(hu, scene.volume.ras_from_ijk), "right", nodule)
    assert lungs.right.inside[nodule.inside].all()
    assert known.dice(lungs.right, scene.lungs["right"]) > 0.95


def test_nodule_on_another_grid_belongs_to_the_lung_as_well() -> None:
    scene = known.thorax()
    place = np.array([known.CENTRES["right"][0] + known.HALF_AXES[0] + 2.0, 10.0, -10.0])
    nodule = ball(tuple(place), 7.0)
    hu = np.where(nodule.inside, np.float32(30), scene.volume.hu)
    other = known.grid((20, 20, 20), 1.5, tuple(place))
    drawn = Mask(np.linalg.norm(other.points() - place, axis=-1) < 7.0, other.ras_from_ijk)
    lungs = segment_lungs(Volume(hu, scene.volume.ras_from_ijk), "right", drawn)
    assert lungs.right.inside[nodule.inside].mean() > 0.8


def test_dense_patch_in_the_lung_is_kept() -> None:
    scene = known.thorax()
    patch = ball((75.0, 0.0, -40.0), 14.0)
    hu = np.where(patch.inside, np.float32(20), scene.volume.hu)
    lungs = segment_lungs(Volume(hu, scene.volume.ras_from_ijk), "right")
    assert lungs.right.inside[patch.inside].mean() > 0.99


def test_nodule_in_the_other_lung_is_refused() -> None:
    with pytest.raises(InputRefused, match=r'lies in the left lung.*set side = "left"'):
        segment_lungs(known.thorax().volume, "right", nodule_ras=np.array([-70.0, 0.0, 0.0]))


def test_nodule_far_from_both_lungs_is_refused() -> None:
    with pytest.raises(InputRefused, match=r"mm outside the right lung, 15 mm allowed"):
        segment_lungs(known.thorax().volume, "right", nodule_ras=np.array([100.0, -60.0, 100.0]))
    with pytest.raises(InputRefused, match=r"outside the CT; give it in the CT's frame"):
        segment_lungs(known.thorax().volume, "right", nodule_ras=np.array([500.0, 0.0, 0.0]))


def test_ct_without_a_lung_is_refused() -> None:
    scene = known.thorax()
    hu = np.where(scene.lungs["left"].inside | scene.lungs["right"].inside, np.float32(40), scene.volume.hu)
    with pytest.raises(InputRefused, match=r"shows no lung: \d+ ml .* give a chest CT"):
        segment_lungs(Volume(hu, scene.volume.ras_from_ijk), "right")


def test_ct_without_the_operated_lung_is_refused() -> None:
    with pytest.raises(InputRefused, match=r'0 ml of the left lung, 250 ml needed.*side = "left"'):
        segment_lungs(known.thorax(one_lung=True).volume, "left")


def test_ct_cropped_through_the_other_lung_keeps_both() -> None:
    scene = known.thorax(touching=True)
    start = 44
    affine = scene.volume.ras_from_ijk.copy()
    affine[:3, 3] = scene.volume.grid.to_ras(np.array([start, 0.0, 0.0]))
    lungs = segment_lungs(Volume(scene.volume.hu[start:].copy(), affine), "right")
    truth = Mask(scene.lungs["right"].inside[start:], affine)
    assert known.dice(lungs.right, truth) > 0.96


def test_air_at_the_side_of_a_cropped_ct_is_the_lung_s_unless_it_is_as_dark_as_room_air() -> None:
    """Two pockets at either side face, lung at one and room air at the other; and the room in front and behind."""
    hu = np.zeros((20, 24, 10), np.float32)
    hu[:, :3], hu[:, -3:] = -1000.0, -1000.0
    lung, room, inner = np.s_[:6, 6:12], np.s_[-6:, 6:12], np.s_[8:12, 14:18]
    hu[lung], hu[room], hu[inner] = -850.0, -1000.0, -1000.0
    found = _air_in_body(Volume(hu, np.diag([2.0, 2.0, 2.0, 1.0])))
    expected = np.zeros(hu.shape, dtype=bool)
    expected[lung], expected[inner] = True, True
    assert_array_equal(found, expected)


def test_parted_lungs_grow_back_into_all_corners_where_slices_are_thick() -> None:
    g = Grid((50, 24, 12), np.diag([1.0, 1.0, 4.0, 1.0]))
    joined = np.zeros(g.shape, dtype=bool)
    joined[2:22, 2:22, 1:11], joined[26:46, 2:22, 1:11] = True, True
    joined[22:26, 11:13, 5] = True
    found = part_joined(joined, g)
    assert found is not None
    small, large = sorted(found, key=lambda part: np.argwhere(part)[:, 0].mean())
    assert_array_equal((small | large)[:22], joined[:22])
    assert_array_equal((small | large)[26:], joined[26:])
    assert not small[26:].any()
    assert not large[:22].any()


@pytest.mark.parametrize("neck_mm", [-4.0, 0.0, 4.0])
def test_lungs_that_touch_are_parted_where_they_are_thinnest(neck_mm: float) -> None:
    """Two balls that meet away from the midline: a cut along it would take a cap off one of them."""
    g = known.grid((60, 40, 40), 2.0)
    x = g.points()
    left, right = (np.linalg.norm(x - [r, 0, 0], axis=-1) < 26.0 + sign * neck_mm for r, sign in ((-26, 1), (26, -1)))
    found = _sides(g, [left | right], 0.0)
    assert (found["left"] ^ found["right"])[left | right].all()
    assert not (found["left"] | found["right"])[~(left | right)].any()
    for name, ball_inside in (("left", left), ("right", right)):
        assert (found[name] ^ ball_inside).sum() < 0.005 * ball_inside.sum()


def test_the_midline_runs_through_a_windpipe_of_one_slice() -> None:
    g = known.grid((20, 10, 10), 2.0)
    airways = np.zeros(g.shape, dtype=bool)
    airways[11:14, 4:6, 7] = True
    lung = np.zeros(g.shape, dtype=bool)
    lung[2:8] = True
    assert _midline(g, [lung], airways) == g.to_ras(np.array([12.0, 0, 0]))[0]
    airways[11:14, 4:6, 5:9], airways[2:5, 4:6, 1:3] = True, True  # bronchi, in the lower half, are not asked
    assert _midline(g, [lung], airways) == g.to_ras(np.array([12.0, 0, 0]))[0]
    assert _midline(g, [lung], np.zeros(g.shape, dtype=bool)) == g.to_ras(np.array([4.5, 0, 0]))[0]
    assert _midline(g, [lung, np.roll(lung, 8, axis=0)], np.zeros(g.shape, dtype=bool)) == pytest.approx(
        g.to_ras(np.array([8.5, 0, 0]))[0]
    )


@pytest.mark.shared
def test_lungs_of_a_real_ct_are_plausible(shared: Path) -> None:
    case = read_case(shared / "cases" / "twin-a")
    lungs = segment_lungs(case.ct, case.side)
    assert 2.4 < lungs.volume_ml["right"] / 1000 < 2.8
    assert 10.0 < lungs.airways.inside.sum() * lungs.airways.grid.spacing.prod() / 1000 < 80.0
