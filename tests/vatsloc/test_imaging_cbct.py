"""Field of view, cupping and spine in images whose truth is known."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from registration.volume import Volume
from tests.vatsloc import imaging_thorax as known
from vatsloc.errors import InputRefused
from vatsloc.imaging.cbct import Cupping, _lean_and_fat, _ridge, field_of_view, prepare_cbct, tissue_hu
from vatsloc.imaging.spine import _column, segment_spine


def test_cylinder_and_bad_slices_are_found() -> None:
    cbct = known.cone_beam(known.thorax().volume, (30.0, -10.0), 90.0)
    field = field_of_view(cbct)
    centre = cbct.grid.to_ras(np.array([*field.centre_ij, 0.0]))
    assert field.axis == 2
    assert_allclose(centre[:2], [30.0, -10.0], atol=0.5)
    assert_allclose(field.radius_mm, 90.0, atol=1.5)
    slices = np.flatnonzero(field.usable.inside.any(axis=(0, 1)))
    ends = int(np.ceil(12.0 / known.SPACING))
    assert (slices[0], slices[-1]) == (ends, known.SHAPE[2] - ends - 1)
    off = np.linalg.norm(cbct.grid.points()[..., :2] - [30.0, -10.0], axis=-1)
    for mask, reach in ((field.mask, 90.0), (field.usable, 90.0 - 2 * known.SPACING)):
        assert_allclose(off[mask.inside].max(), reach, atol=1.5)


def test_cylinder_cut_by_the_image_keeps_its_circle() -> None:
    whole = known.cone_beam(known.thorax().volume, (30.0, -10.0), 120.0)
    field = field_of_view(whole)
    centre = whole.grid.to_ras(np.array([*field.centre_ij, 0.0]))
    assert_allclose(centre[:2], [30.0, -10.0], atol=2.0)
    assert_allclose(field.radius_mm, 120.0, atol=3.0)


def test_image_without_a_rim_is_seen_whole() -> None:
    field = field_of_view(known.thorax().volume)
    assert field.mask.inside.all()
    assert field.radius_mm == np.inf


def test_short_or_empty_cbct_is_refused() -> None:
    cbct = known.cone_beam(known.thorax().volume, (30.0, -10.0), 90.0)
    with pytest.raises(InputRefused, match=r"8 slices with content, 11 needed"):
        field_of_view(Volume(cbct.hu[:, :, :8].copy(), cbct.ras_from_ijk))
    with pytest.raises(InputRefused, match="constant everywhere"):
        field_of_view(Volume(np.full((20, 20, 20), -1000, dtype=np.float32), cbct.ras_from_ijk))


@pytest.mark.parametrize("cupping", [(-90.0, 10.0), (-40.0, -40.0), (0.0, 60.0)])
def test_cupping_is_recovered_and_removed(cupping: tuple[float, float]) -> None:
    truth = known.thorax().volume
    cbct = known.cone_beam(truth, (30.0, -20.0), 100.0, cupping)
    done = prepare_cbct(cbct)
    radius = np.linspace(20.0, 90.0, 8)
    assert_allclose(done.removed.at(radius), np.interp(radius, [0.0, 100.0], cupping), atol=15.0)
    soft = done.field.usable.inside & (np.abs(truth.hu - 40) < 30)
    assert_allclose(np.median(done.volume.hu[soft]), 40.0, atol=10.0)
    assert_allclose(done.removed.after["soft"], 40.0, atol=12.0)


def test_lost_contrast_is_given_back() -> None:
    truth = known.thorax().volume
    squeezed = Volume((40 + 0.8 * (truth.hu - 40)).astype(np.float32), truth.ras_from_ijk)
    done = prepare_cbct(known.cone_beam(squeezed, (30.0, -20.0), 100.0, (-50.0, 0.0)))
    assert_allclose(done.removed.gain, 0.8, atol=0.03)
    seen = done.field.usable.inside & known.thorax().lungs["right"].inside
    raw = known.cone_beam(squeezed, (30.0, -20.0), 100.0, (-50.0, 0.0)).hu[seen]
    assert_allclose(done.removed.before["lung"], np.median(raw), atol=30.0)
    assert_allclose(done.removed.after["lung"], -850.0, atol=30.0)
    entry = done.removed.entry()
    assert_allclose(entry["gain"], 0.8, atol=0.03)
    assert_allclose([entry["hu_before"]["lung"], entry["hu_after"]["lung"]], [np.median(raw), -850.0], atol=30.0)
    assert entry["end_slices_mm"] == 12.0
    lung = known.thorax().lungs["right"].inside & done.field.usable.inside
    assert_allclose(np.median(done.volume.hu[lung]), -850.0, atol=30.0)


def test_a_tissue_that_is_not_seen_is_none_in_the_entry() -> None:
    nowhere = {"air": np.nan, "lung": -850.0, "soft": 40.0}
    entry = Cupping(np.zeros(2), np.zeros(2), 1.0, nowhere, nowhere).entry()
    assert entry["hu_before"] == {"air": None, "lung": -850.0, "soft": 40.0}


def test_a_peak_may_be_as_wide_as_two_steps_of_the_histogram() -> None:
    hu = np.repeat([-852.0, -844.0, 36.0, 44.0], 50)
    assert tissue_hu(hu) == {"air": pytest.approx(np.nan, nan_ok=True), "lung": -852.0, "soft": 36.0}


def test_spine_is_the_column_of_vertebrae_in_ct_and_cbct() -> None:
    scene = known.thorax()
    done = prepare_cbct(known.cone_beam(scene.volume, (30.0, -20.0), 100.0))
    for spine, seen in (
        (segment_spine(scene.volume), np.ones(known.SHAPE, dtype=bool)),
        (segment_spine(done.volume, done.field.usable), done.field.usable.inside),
    ):
        assert_allclose(spine.centres_ras[:, 0], 0.0, atol=4.0)
        assert_allclose(spine.centres_ras[:, 1], -58.0, atol=8.0)
        assert spine.mask.inside[scene.vertebrae.inside & seen].mean() > 0.97
        assert spine.mask.inside.sum() < 4.0 * (scene.vertebrae.inside & seen).sum()


@pytest.mark.parametrize("more_below", [True, False])
def test_the_column_runs_through_the_most_bone_wherever_along_it_that_is(more_below: bool) -> None:
    """Bone at one place in the lower half and at another, too far to bend to, in the upper half."""
    g = known.grid((80, 24, 48), 2.5)
    soft = Volume(np.full(g.shape, 40.0, dtype=np.float32), g.ras_from_ijk)
    excess, seen = np.zeros(g.shape, dtype=np.float32), np.ones(g.shape, dtype=bool)
    excess[8:12, 4:8, :24] = 100.0 if more_below else 98.0
    excess[66:70, 4:8, 24:] = 98.0 if more_below else 100.0
    path = _column(soft, excess, seen, np.arange(g.shape[2]))
    assert_allclose(path[:20] if more_below else path[28:], [[9.5 if more_below else 67.5, 5.5]] * 20, atol=1.0)


def test_image_without_bone_has_no_spine() -> None:
    scene = known.thorax()
    hu = np.where(scene.volume.hu > 150, np.float32(40), scene.volume.hu)
    with pytest.raises(InputRefused, match="No spine found"):
        segment_spine(Volume(hu, scene.volume.ras_from_ijk))


def test_a_steel_port_is_not_taken_for_the_spine() -> None:
    """A trocar between the ribs, and what its streaks brighten about it."""
    scene = known.thorax()
    x = scene.volume.grid.points()
    off = np.linalg.norm(x[..., :2] - [90.0, -40.0], axis=-1)
    hu = np.where(off < 14.0, np.float32(600), scene.volume.hu)
    hu = np.where(off < 4.0, np.float32(3000), hu)
    done = prepare_cbct(known.cone_beam(Volume(hu, scene.volume.ras_from_ijk), (25.0, 10.0), 105.0))
    spine = segment_spine(done.volume, done.field.usable)
    assert_allclose(spine.centres_ras[:, 0], 0.0, atol=6.0)
    assert not spine.mask.inside[off < 4.0].any()


def test_a_bright_sternum_is_not_taken_for_the_spine() -> None:
    scene = known.thorax()
    x = scene.volume.grid.points()
    plate = (np.abs(x[..., 0]) < 20.0) & (x[..., 1] > 72.0) & (x[..., 1] < 84.0)
    hu = np.where(plate, np.float32(900), scene.volume.hu)
    done = prepare_cbct(known.cone_beam(Volume(hu, scene.volume.ras_from_ijk), (25.0, 10.0), 105.0))
    spine = segment_spine(done.volume, done.field.usable)
    assert_allclose(spine.centres_ras[:, 1], -58.0, atol=10.0)


@pytest.mark.parametrize("seed", range(5))
def test_the_ridge_is_the_best_of_all_paths_that_are_not_too_steep(seed: int) -> None:
    score, steepest = np.random.default_rng(seed).uniform(0, 1, (5, 6)), 2
    paths = np.array(list(product(range(6), repeat=5)))
    steps = np.abs(np.diff(paths, axis=1))
    total = score[np.arange(5), paths].sum(axis=1) - 0.05 * steps.sum(axis=1)
    assert_array_equal(_ridge(score, steepest), paths[np.where(steps.max(axis=1) <= steepest, total, -np.inf).argmax()])


def test_a_ring_s_likelihood_is_that_of_normal_densities_on_a_floor() -> None:
    """All of a ring at one grey value, which is lean tissue's or fat's: a density of 1 / (32 sqrt(2 pi)) there."""
    level = np.arange(-400.0, 400.0, 5.0)
    share = (level == 40.0).astype(float)[None]
    peak = 1 / (32 * np.sqrt(2 * np.pi))
    lean, fat = _lean_and_fat(share, level, np.array([40.0, 145.0]))[0]
    assert lean == pytest.approx(np.log(0.15 / 560 + 0.85 * peak))
    beside = peak * np.exp(-0.5 * (105 / 32) ** 2)
    assert fat == pytest.approx(np.log(0.15 / 560 + 0.85 * (0.25 * beside + 0.75 * peak)) - 0.15 * 0.75)
