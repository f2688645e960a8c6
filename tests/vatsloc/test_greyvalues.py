"""Images that are not in HU: made thoraces scaled as C-arms export them, and what is left alone or refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from registration.volume import Volume
from tests.vatsloc.imaging_thorax import Thorax, cone_beam, dice, thorax
from vatsloc.calibration import in_hounsfield
from vatsloc.errors import InputRefused
from vatsloc.imaging.cbct import field_of_view
from vatsloc.imaging.greyvalues import Calibration, calibrate, calibrated, fill_value, in_hu, peaks
from vatsloc.imaging.lungs import Lungs, segment_lungs

SCALES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "stored, 0 to 4095": lambda hu: np.clip(np.rint(hu + 1024), 0, 4095),
    "HU + 1000": lambda hu: np.clip(np.rint(hu + 1000), 0, 4095),
    "attenuation, 1/mm": lambda hu: np.maximum(0.0195 * (hu / 1000 + 1), 0),
    "attenuation, 1/cm": lambda hu: np.maximum(0.205 * (hu / 1000 + 1), 0),
    "0 to 1": lambda hu: (hu - hu.min()) / np.ptp(hu),
    "8 bits": lambda hu: np.rint(255 * (np.clip(hu, -1024, 1500) + 1024) / 2524),
}
FILLS = {"its own air": None, "0": 0.0, "-1000": -1000.0, "-1024": -1024.0}


@pytest.fixture(scope="module")
def scene() -> Thorax:
    return thorax(scale_right=0.7)


@pytest.fixture(scope="module")
def lungs(scene: Thorax) -> Lungs:
    return segment_lungs(scene.volume, "right")


def scaled(image: Volume, kind: str) -> Volume:
    return Volume(SCALES[kind](image.hu.astype(float)).astype(np.float32), image.ras_from_ijk)


def level(image: Volume, truth: np.ndarray, hu: float) -> float:
    """Median of the image where the truth is within 15 of that HU."""
    return float(np.median(image.hu[np.abs(truth - hu) < 15]))


@pytest.mark.parametrize("kind", SCALES)
def test_a_scaled_ct_gets_its_hu_back(scene: Thorax, kind: str) -> None:
    grey = scaled(scene.volume, kind)
    assert not in_hu(grey)
    hu = calibrated(grey, calibrate(grey))
    assert level(hu, scene.volume.hu, -1000) == pytest.approx(-1000, abs=30)
    assert level(hu, scene.volume.hu, 40) == pytest.approx(40, abs=30)


@pytest.mark.parametrize("kind", SCALES)
def test_a_scaled_ct_shows_the_same_lungs(scene: Thorax, lungs: Lungs, kind: str) -> None:
    grey = scaled(scene.volume, kind)
    found = segment_lungs(calibrated(grey, calibrate(grey)), "right")
    assert min(dice(found.left, lungs.left), dice(found.right, lungs.right)) > 0.99


@pytest.mark.parametrize("fill", FILLS)
@pytest.mark.parametrize("kind", SCALES)
def test_what_fills_the_corners_of_a_cone_beam_ct_is_not_taken_for_air(scene: Thorax, kind: str, fill: str) -> None:
    radius = 105.0
    seen = cone_beam(scene.volume, (30.0, 0.0), radius, cupping=(0.0, 0.0))
    x = seen.grid.points()
    outside = np.hypot(x[..., 0] - 30.0, x[..., 1]) > radius
    grey = scaled(seen, kind).hu
    if FILLS[fill] is not None:
        grey[outside] = FILLS[fill]
    image = Volume(grey, seen.ras_from_ijk)
    assert fill_value(grey) == grey[0, 0, 0]
    hu = calibrated(image, calibrate(image))
    truth = np.where(outside, np.nan, scene.volume.hu)
    assert level(hu, truth, -1000) == pytest.approx(-1000, abs=30)
    assert level(hu, truth, 40) == pytest.approx(40, abs=30)
    assert (hu.hu[outside] == -1000).all()


def test_the_field_of_view_is_found_in_any_unit(scene: Thorax) -> None:
    seen = cone_beam(scene.volume, (30.0, 0.0), 105.0)
    grey = Volume(SCALES["attenuation, 1/mm"](seen.hu).astype(np.float32), seen.ras_from_ijk)
    assert np.array_equal(field_of_view(grey).usable.inside, field_of_view(seen).usable.inside)


def test_an_image_in_hu_stays_as_it_is_bit_for_bit(scene: Thorax) -> None:
    for image in (scene.volume, cone_beam(scene.volume, (30.0, 0.0), 105.0)):
        said: list[str] = []
        done, maps = in_hounsfield({"ct": image}, {"ct": Path("ct.nii")}, {}, said)
        assert done["ct"] is image
        assert (maps, said) == ({}, [])
        assert peaks(image) == pytest.approx((-1000, 40), abs=60)  # the cone beam's has 80 HU of cupping


def test_a_calibration_is_said_with_its_numbers(scene: Thorax) -> None:
    said: list[str] = []
    grey = scaled(scene.volume, "HU + 1000")
    _, maps = in_hounsfield({"cbct_deflated": grey}, {"cbct_deflated": Path("d.nii")}, {}, said)
    entry = maps["cbct_deflated"].entry()
    assert entry["slope"] == pytest.approx(1, abs=0.03)
    assert entry["intercept"] == pytest.approx(-1000, abs=30)
    assert said[0].startswith("d.nii is not in HU: its air reads ")


def test_stated_slope_and_intercept_come_first_and_are_checked(scene: Thorax) -> None:
    grey = scaled(scene.volume, "attenuation, 1/mm")
    stated = {"ct": Calibration(1000 / 0.0195, -1000.0)}
    done, maps = in_hounsfield({"ct": grey}, {"ct": Path("ct.nii")}, stated, [])
    assert level(done["ct"], scene.volume.hu, 40) == pytest.approx(40, abs=2)
    assert maps["ct"].air is None
    with pytest.raises(InputRefused, match=r"ct\.nii is no chest image in HU under ct_slope = 2 .* correct them"):
        in_hounsfield({"ct": grey}, {"ct": Path("ct.nii")}, {"ct": Calibration(2.0, 0.0)}, [])


@pytest.mark.parametrize(
    ("values", "why"),
    [
        (lambda hu: np.where(hu > -500, 1.0, 0.0), "constant|not both|one peak|bone"),
        (lambda hu: np.clip(hu, 0, 80), "one peak|bone|not both|air|soft tissue"),
        (lambda hu: np.random.default_rng(1).normal(500, 30, hu.shape), "one peak|bone|not both|air|soft tissue"),
        (lambda hu: 3000 - hu, "bone|air|not both"),
        (lambda hu: np.clip(hu, -120, None) + 1000, "not both|air|too bright"),
    ],
)
def test_an_image_without_the_two_peaks_is_refused_by_name(
    scene: Thorax, values: Callable[[np.ndarray], np.ndarray], why: str
) -> None:
    image = Volume(values(scene.volume.hu).astype(np.float32), scene.volume.ras_from_ijk)
    with pytest.raises(InputRefused, match=rf"inflated\.nrrd .*cannot be calibrated: .*({why}).*cbct_inflated_slope"):
        in_hounsfield({"cbct_inflated": image}, {"cbct_inflated": Path("inflated.nrrd")}, {}, [])
