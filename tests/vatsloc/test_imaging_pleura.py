"""Collapsed lung, pleural air, airways and surfaces in CBCTs whose truth is known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from registration.images.resample import resample_mask
from registration.volume import Mask, Volume
from tests.vatsloc import imaging_thorax as known
from vatsloc.case import read_case
from vatsloc.errors import InputRefused
from vatsloc.imaging.cbct import PreparedCbct, prepare_cbct
from vatsloc.imaging.hilum import track_hilum
from vatsloc.imaging.lungs import segment_lungs
from vatsloc.imaging.pleura import Pneumothorax, _large_pieces, _local_limit, _lung_beside, air_limit, find_pneumothorax
from vatsloc.imaging.surface import Border, deflated_surface, diaphragm_points, inflated_surface
from vatsloc.imaging.thorax import (
    ThoraxPrior,
    carry_prior,
    central_airways,
    inflated_lung,
    require_share,
    visible_share,
    working_scene,
)

SHRUNK = 0.72


def same(points: np.ndarray) -> np.ndarray:
    return points


def to_ellipsoid(points: np.ndarray, scale: float) -> np.ndarray:
    """Signed distance in mm, first order, positive outside the collapsed lung."""
    centre = known.CENTRES["right"] - np.array([known.HALF_AXES[0] * (1 - scale), 0.0, 0.0])
    y = (points - centre) / (known.HALF_AXES * scale)
    f = np.linalg.norm(y, axis=1)
    return f * (f - 1) / np.linalg.norm(y / (known.HALF_AXES * scale), axis=1)


@pytest.fixture(scope="module")
def prior() -> ThoraxPrior:
    scene = known.thorax()
    return carry_prior(segment_lungs(scene.volume, "right"), "right", scene.volume, same)


@pytest.fixture(scope="module")
def deflated() -> PreparedCbct:
    return prepare_cbct(known.cone_beam(known.thorax(scale_right=SHRUNK).volume, (50.0, 0.0), 110.0))


@pytest.fixture(scope="module")
def found(deflated: PreparedCbct, prior: ThoraxPrior) -> Pneumothorax:
    return find_pneumothorax(deflated, prior)


def test_what_is_expected_is_not_written_to(deflated: PreparedCbct, prior: ThoraxPrior) -> None:
    """The hilum's motion reads it at the same time on another thread."""
    grid = working_scene(deflated)[0].grid
    there = ThoraxPrior(*(resample_mask(mask, grid) for mask in (prior.lung, prior.other, prior.airways)))
    before = [mask.inside.copy() for mask in (there.lung, there.other, there.airways)]
    central = central_airways(there, grid)
    assert 0 < central.sum() < before[2].sum()
    assert not (central & ~before[2]).any()
    find_pneumothorax(deflated, there)
    for mask, inside in zip((there.lung, there.other, there.airways), before, strict=True):
        assert_array_equal(mask.inside, inside)


def test_inflated_lung_matches_in_spite_of_a_displaced_prior() -> None:
    scene = known.thorax()
    cbct = prepare_cbct(known.cone_beam(scene.volume, (50.0, 0.0), 110.0))
    shift = np.array([6.0, -5.0, 8.0])
    lungs = segment_lungs(scene.volume, "right")
    moved = inflated_lung(cbct, carry_prior(lungs, "right", cbct.volume, lambda p: p + shift))
    seen = cbct.field.mask.inside
    truth = Mask(scene.lungs["right"].inside & seen, moved.ras_from_ijk)
    assert known.dice(moved, truth) > 0.95


def test_visible_share_is_the_share_of_the_volume() -> None:
    scene = known.thorax()
    lung = scene.lungs["right"]
    half = known.cone_beam(scene.volume, (50.0, 0.0), 110.0)
    cut = Volume(half.hu[:, :, : known.SHAPE[2] // 2].copy(), half.ras_from_ijk)
    cbct = prepare_cbct(cut)
    points = lung.grid.to_ras(np.argwhere(lung.inside).astype(float))
    ijk = np.rint(cbct.field.usable.grid.to_ijk(points)).astype(int)
    within = ijk[:, 2] < cut.hu.shape[2]
    expected = cbct.field.usable.inside[tuple(ijk[within].T)].sum() / len(points)
    assert_allclose(visible_share(lung, cbct.field, same), expected, atol=0.03)


def test_too_small_a_share_is_refused_in_one_sentence() -> None:
    require_share(0.41, "right")
    with pytest.raises(InputRefused) as refused:
        require_share(0.12, "right")
    assert str(refused.value) == (
        "CBCT shows 12 % of the right lung, 40 % needed; re-crop, or lower [gates] min_overlap."
    )


def test_pleural_air_and_collapsed_lung_are_told_apart(found: Pneumothorax) -> None:
    truth = known.thorax(scale_right=SHRUNK).lungs["right"]
    assert found.is_collapsed
    assert found.lung.grid.same_as(truth.grid)
    assert known.dice(found.lung, truth) > 0.95
    old = known.thorax().lungs["right"].inside
    air = Mask(old & ~truth.inside & (known.thorax().volume.hu < -500), truth.ras_from_ijk)
    assert known.dice(found.air, air) > 0.9
    assert not (found.air.inside & known.thorax().lungs["left"].inside).any()


def test_dense_lung_between_air_and_aerated_lung_is_lung() -> None:
    """A layer of 6 mm without air, as lung that collapsed first has it, between the gas and the aerated lung."""
    g = known.grid((40, 40, 40), 2.0)
    r = np.linalg.norm(g.points(), axis=-1)
    aerated, air = r < 24.0, (r > 30.0) & (r < 38.0)
    lung = _lung_beside(aerated, air, g, g)
    assert lung[aerated].mean() > 0.99
    assert lung[(r > 24.5) & (r < 29.5)].mean() > 0.95
    assert not lung[r > 30.0].any()


def test_air_border_lies_on_the_ellipsoid_and_normals_point_out(found: Pneumothorax, deflated: PreparedCbct) -> None:
    air = deflated_surface(found, deflated.field).only(Border.AIR)
    assert len(air) > 1000
    distance = to_ellipsoid(air.points, SHRUNK)
    assert abs(distance.mean()) < 0.3
    assert np.percentile(np.abs(distance), 95) < 1.2
    centre = known.CENTRES["right"] - np.array([known.HALF_AXES[0] * (1 - SHRUNK), 0.0, 0.0])
    outward = (air.points - centre) / (known.HALF_AXES * SHRUNK) ** 2
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    cosine = (outward * air.normals).sum(axis=1)
    assert np.median(cosine) > 0.98
    assert np.percentile(cosine, 5) > 0.8
    assert (air.confidence > 0.9).mean() > 0.95


def test_surface_keeps_away_from_the_rim_and_bad_slices(found: Pneumothorax, deflated: PreparedCbct) -> None:
    points = deflated_surface(found, deflated.field).points
    assert np.hypot(points[:, 0] - 50.0, points[:, 1]).max() < 110.0 - 3.0
    half_height = known.SPACING * (known.SHAPE[2] - 1) / 2
    assert np.abs(points[:, 2]).max() < half_height - 12.0


def test_gap_between_two_pieces_of_lung_is_a_fissure(deflated: PreparedCbct, prior: ThoraxPrior) -> None:
    x = deflated.volume.grid.points()
    gap = (np.abs(x[..., 2] + 10.0) < 2 * known.SPACING) & (x[..., 0] > 45.0) & (np.abs(x[..., 1]) < 60.0)
    lung = known.thorax(scale_right=SHRUNK).lungs["right"].inside
    hu = np.where(gap & lung, np.float32(-1000), deflated.volume.hu)
    parted = PreparedCbct(Volume(hu, deflated.volume.ras_from_ijk), deflated.field, deflated.removed)
    surface = deflated_surface(find_pneumothorax(parted, prior), deflated.field)
    fissure = surface.only(Border.FISSURE)
    flat = np.abs(fissure.normals[:, 2]) > 0.8
    assert flat.mean() > 0.7
    assert_allclose(np.abs(fissure.points[flat, 2] + 10.0).mean(), 5.0, atol=0.4)


@pytest.mark.parametrize(
    ("air_ml", "contrast_hu", "collapsed"),
    [(20.0, 100.0, True), (19.9, 100.0, False), (20.0, 99.9, False), (19.9, 99.9, False)],
)
def test_a_lung_is_collapsed_where_both_air_and_contrast_reach_their_limit(
    found: Pneumothorax, air_ml: float, contrast_hu: float, collapsed: bool
) -> None:
    assert replace(found, air_ml=air_ml, contrast_hu=contrast_hu).is_collapsed is collapsed


def test_air_is_kept_in_pieces_of_half_a_millilitre_that_lie_less_than_half_in_airways() -> None:
    """Bars of 8, 8, 8 and 7 voxels of 1/16 ml: 3, 4 and no voxels of them in airways; the last one is too small."""
    dark, tubes = np.zeros((2, 10, 10), bool), np.zeros((2, 10, 10), bool)
    for row, (length, inside) in enumerate(((8, 3), (8, 4), (8, 0), (7, 0))):
        dark[0, 2 * row, :length] = True
        tubes[0, 2 * row, :inside] = True
    kept = _large_pieces(dark, tubes, 1 / 16)
    assert [bool(kept[0, 2 * row, 0]) for row in range(4)] == [True, False, True, False]
    assert kept.sum() == 16


def test_inflated_lung_is_not_called_collapsed(prior: ThoraxPrior) -> None:
    still = find_pneumothorax(prepare_cbct(known.cone_beam(known.thorax().volume, (50.0, 0.0), 110.0)), prior)
    assert not still.is_collapsed
    assert still.air_ml < 20.0
    assert known.dice(still.lung, known.thorax().lungs["right"]) > 0.85


def test_diaphragm_is_the_lower_border_of_the_space(found: Pneumothorax, deflated: PreparedCbct) -> None:
    dome = diaphragm_points(found.space, found.image, deflated.field)
    assert len(dome) > 50
    assert (dome.normals[:, 2] < -0.5).all()
    y = (dome.points - known.CENTRES["right"]) / known.HALF_AXES
    f = np.linalg.norm(y, axis=1)
    assert np.median(np.abs(f * (f - 1) / np.linalg.norm(y / known.HALF_AXES, axis=1))) < 1.0


def test_the_inflated_lung_s_surface_is_seen_where_the_scan_shows_it() -> None:
    cbct = prepare_cbct(known.cone_beam(known.thorax().volume, (50.0, 0.0), 110.0))
    lung = known.thorax().lungs["right"]
    surface = inflated_surface(lung, cbct.volume, cbct.field)
    assert len(surface) > 500
    y = (surface.points - known.CENTRES["right"]) / known.HALF_AXES
    f = np.linalg.norm(y, axis=1)
    slope = y / known.HALF_AXES
    assert np.median(np.abs(f * (f - 1) / np.linalg.norm(slope, axis=1))) < 0.6
    outward = (surface.normals * slope).sum(axis=1) / np.linalg.norm(slope, axis=1)
    assert np.median(outward) > 0.98
    assert (surface.border == Border.CONTACT).all()
    ijk = np.rint(cbct.field.usable.grid.to_ijk(surface.points)).astype(int)
    assert cbct.field.usable.inside[tuple(ijk.T)].all()


@pytest.mark.parametrize("shift", [(8.0, -4.0, 6.0), (0.0, 0.0, 0.0), (-10.0, 5.0, -7.5)])
def test_hilum_is_tracked_by_value_and_sign(shift: tuple[float, float, float]) -> None:
    scene = known.thorax()
    cbct = prepare_cbct(known.cone_beam(scene.volume, (20.0, 0.0), 120.0))
    affine = scene.airways.ras_from_ijk.copy()
    affine[:3, 3] -= shift
    root = known.CARINA + np.array([25.0, 0.0, -14.0])
    tracked = track_hilum(cbct, Mask(scene.airways.inside, affine), root - np.array(shift), radius_mm=60.0)
    assert_allclose(tracked.shift_mm, shift, atol=1.6)
    assert tracked.contrast_hu > 300.0
    assert tracked.contrast_hu > tracked.runner_up_hu > 0.0  # the tree half over itself


@pytest.mark.parametrize("shading", [-40.0, 0.0, 40.0])
def test_the_level_between_air_and_lung_follows_the_shading_and_nothing_beside_the_chest(shading: float) -> None:
    g = known.grid((28, 20, 20), 2.5)
    x = g.points()[..., 0]
    space = (np.abs(g.points()) < [30, 20, 20]).all(axis=-1)
    hu = np.where(space, np.where(x < 0, -1000.0, -700.0) + shading, -950.0)
    hu[16:19, 9:11, 9:11] = 40.0  # a vessel
    found = _local_limit(Volume(hu.astype(np.float32), g.ras_from_ijk), space, space & (x < 0), -850.0, 300.0)
    assert_allclose(found[(np.abs(x) < 8) & space], -850.0 + shading, atol=8)


@pytest.mark.shared
def test_pleural_air_of_a_twin_is_plausible(shared: Path) -> None:
    name = "twin-c"
    case = read_case(shared / "cases" / name)
    pose = np.array(json.loads((shared / "cases" / name / "truth" / "info.json").read_text())["T"]["deflated"])
    back = np.linalg.inv(pose)
    cbct = prepare_cbct(case.cbct_deflated)
    lungs = segment_lungs(case.ct, case.side)
    seen = find_pneumothorax(
        cbct, carry_prior(lungs, case.side, cbct.volume, lambda p: p @ back[:3, :3].T + back[:3, 3])
    )
    assert seen.is_collapsed
    assert 330.0 < seen.air_ml < 520.0
    dense = np.genfromtxt(shared / "cases" / name / "truth" / "dense_ras_mm.csv", delimiter=",", skip_header=1)
    ijk = np.rint(seen.air.grid.to_ijk(dense[:, 6:9])).astype(int)
    within = ((ijk >= 0) & (ijk < seen.air.grid.shape)).all(axis=1)
    assert seen.air.inside[tuple(ijk[within].T)].mean() < 0.12


def test_nothing_where_the_prior_is_empty(deflated: PreparedCbct, prior: ThoraxPrior) -> None:
    nowhere = Mask(np.zeros_like(prior.lung.inside), prior.lung.ras_from_ijk)
    found = find_pneumothorax(deflated, ThoraxPrior(nowhere, nowhere, nowhere))
    assert not found.is_collapsed
    assert found.lung_ml == 0.0
    assert len(deflated_surface(found, deflated.field)) == 0
    assert len(diaphragm_points(found.space, found.image, deflated.field)) == 0


@pytest.mark.parametrize(("share_of_lung", "seen"), [(0.6, True), (0.15, False)])
def test_air_beside_a_lung_of_every_density_is_told_by_its_own_width(share_of_lung: float, seen: bool) -> None:
    """Gas of 25 HU about -870 beside a lung that thins out from -860 to -350 HU; a lung alone has little so far off."""
    random, n = np.random.default_rng(3), 40000
    lung = random.triangular(-860, -860, -350, int(share_of_lung * n))
    hu = np.concatenate([random.normal(-870, 25, n - len(lung)), lung])
    limit, contrast = air_limit(hu)
    assert (contrast > 0) is seen
    if seen:
        assert contrast == pytest.approx(150, abs=20)
        assert -815 < limit < -765


def test_air_is_told_from_a_lung_that_is_still_light_and_has_a_dense_tail() -> None:
    """Gas about -980 HU, lung about -830 with a tail of vessels up to -350: Otsu's level lies in the lung."""
    random = np.random.default_rng(4)
    lung = np.concatenate([random.normal(-830, 40, 26000), random.triangular(-830, -830, -350, 14000)])
    limit, contrast = air_limit(np.concatenate([random.normal(-980, 25, 8000), lung]))
    assert contrast == pytest.approx(150, abs=25)
    assert -925 < limit < -885
    assert air_limit(lung)[1] == 0.0  # the lung alone


def test_air_that_the_image_clips_is_told_from_a_lung_of_every_density() -> None:
    """Half of the gas about -1010 HU is written as -1024, so its peak has no dark flank."""
    random = np.random.default_rng(5)
    gas, lung = np.maximum(random.normal(-1010, 30, 16000), -1024), random.uniform(-980, -350, 24000)
    limit, contrast = air_limit(np.concatenate([gas, lung]))
    assert contrast == pytest.approx(150, abs=30)
    assert -950 < limit < -900
