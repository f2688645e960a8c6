"""DICOM by hand-made files: slices in any order, per-slice rescale, multi-frame, and every refusal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pydicom
import pytest
from numpy.testing import assert_allclose
from pydicom.dataset import Dataset
from pydicom.uid import generate_uid
from scipy.spatial.transform import Rotation

from registration.volume import Volume
from tests.vatsloc.dicom_made import (
    COLUMN_MM,
    NI,
    NJ,
    NK,
    ORIGIN_LPS,
    ROW_MM,
    SLICE_MM,
    ct_slice,
    enhanced,
    save,
    slice_hu,
)
from vatsloc.errors import InputRefused
from vatsloc.formats.dicom import PADDING_HU
from vatsloc.formats.images import files_behind, read_volume

ORIENTATIONS = {
    "axial": np.eye(3),
    "feet first": np.diag([1.0, -1.0, -1.0]),
    "coronal": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).T,
    "sagittal": np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]]).T,
    "oblique": Rotation.from_rotvec([0.2, -0.3, 0.1]).as_matrix(),
}
"""Columns: along a row, along a column, along the slice normal; LPS."""


def check_ramp(volume: Volume, tolerance: float = 0.5) -> None:
    assert volume.hu.shape == (NI, NJ, NK)
    points_lps = volume.grid.points() * [-1, -1, 1]
    assert_allclose(volume.hu, points_lps @ [-1.0, -10.0, 7.0], atol=tolerance + 1e-3)


@pytest.fixture(params=ORIENTATIONS)
def axes(request) -> np.ndarray:
    return ORIENTATIONS[request.param]


@pytest.fixture
def axial() -> list[Dataset]:
    return [ct_slice(np.eye(3), k) for k in range(NK)]


def test_slices_are_sorted_by_place_whatever_their_names_and_numbers(tmp_path, axes):
    volume = read_volume(save(tmp_path / "ct", [ct_slice(axes, k) for k in (3, 0, 5, 1, 4, 2)]))
    check_ramp(volume)
    assert_allclose(volume.grid.spacing, [COLUMN_MM, ROW_MM, SLICE_MM], rtol=1e-6)
    assert_allclose(volume.ras_from_ijk[:3, 3], ORIGIN_LPS * [-1, -1, 1], atol=1e-6)


def test_each_slice_has_its_own_rescale(tmp_path):
    slopes, intercepts = [1, 2, 0.5, 1, 1, 4], [0, -1024, -1000, 100, -2000, 7]
    slices = [ct_slice(np.eye(3), k, slopes[k], intercepts[k]) for k in range(NK)]
    check_ramp(read_volume(save(tmp_path / "ct", slices)), tolerance=0.5 + 2.0)
    stored = np.frombuffer(slices[5].PixelData, "<i2").reshape(NJ, NI)
    assert_allclose(read_volume(tmp_path / "ct").hu[:, :, 5].T, stored * 4.0 + 7)


def test_padding_becomes_air(tmp_path, axial):
    axial[2].PixelPaddingValue = -2000
    pixels = np.frombuffer(axial[2].PixelData, "<i2").copy()
    pixels[3] = -2000
    axial[2].PixelData = pixels.tobytes()
    hu = read_volume(save(tmp_path / "ct", axial)).hu
    assert hu[3, 0, 2] == PADDING_HU
    assert (hu == PADDING_HU).sum() == 1


def test_notes_beside_the_slices_are_passed_over(tmp_path, axial):
    save(tmp_path / "ct", axial)
    (tmp_path / "ct" / "readme.txt").write_text("exported on a Monday")
    check_ramp(read_volume(tmp_path / "ct"))
    assert len(files_behind(tmp_path / "ct")) == NK + 1


def test_multi_frame_with_functional_groups(tmp_path, axes):
    save(tmp_path / "cbct", [enhanced(axes, [5, 0, 1, 2, 4, 3])])
    check_ramp(read_volume(tmp_path / "cbct"))
    check_ramp(read_volume(tmp_path / "cbct" / "IM000"))
    (tmp_path / "cbct" / "IM000").rename(tmp_path / "cbct.dcm")
    check_ramp(read_volume(tmp_path / "cbct.dcm"))


@pytest.mark.parametrize("by", ["spacing", "offsets"])
def test_multi_frame_labelled_ct_without_functional_groups(tmp_path, axes, by):
    ds = ct_slice(axes, 0)
    ds.NumberOfFrames = NK
    if by == "spacing":
        ds.SpacingBetweenSlices = SLICE_MM
    else:
        ds.GridFrameOffsetVector = [SLICE_MM * k for k in range(NK)]
    ds.PixelData = np.stack([(slice_hu(axes, k) + 1024).astype("<i2") for k in range(NK)]).tobytes()
    check_ramp(read_volume(save(tmp_path / "cbct", [ds])))


def check_refused(tmp_path: Path, slices: list[Dataset], sentence: str) -> None:
    with pytest.raises(InputRefused, match=sentence):
        read_volume(save(tmp_path / "ct", slices))


def test_missing_slice_is_refused(tmp_path, axial):
    check_refused(
        tmp_path,
        axial[:3] + axial[4:],
        r"misses slices between -39\.0 and -34\.0 mm \(5\.00 mm apart, 2\.50 mm elsewhere",
    )


def test_uneven_spacing_is_refused(tmp_path):
    slices = [ct_slice(np.eye(3), k) for k in (0, 1, 2, 3.2, 4.2, 5.2)]
    check_refused(tmp_path, slices, r"unevenly spaced slices \(2\.50 to 3\.00 mm apart\); export")


def test_positions_rounded_by_the_scanner_are_accepted(tmp_path):
    slices = [ct_slice(np.eye(3), k + 0.015 * (-1) ** k) for k in range(NK)]
    assert_allclose(read_volume(save(tmp_path / "ct", slices)).grid.spacing[2], SLICE_MM, rtol=0.02)


def test_doubled_slice_is_refused(tmp_path, axial):
    check_refused(
        tmp_path, [*axial, ct_slice(np.eye(3), 2)], r"two slices at the same place \(-39\.0 mm\); keep one phase"
    )


def test_slices_that_lean_more_than_a_gantry_does_are_refused(tmp_path, axial):
    for k, ds in enumerate(axial):
        ds.ImagePositionPatient = [ORIGIN_LPS[0], ORIGIN_LPS[1] + 2.5 * k, ORIGIN_LPS[2] + SLICE_MM * k]
    check_refused(tmp_path, axial, r"sheared: two voxel axes are 45\.0 degrees off a right angle; .* undo the tilt")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda ds: setattr(ds, "SeriesInstanceUID", generate_uid()), "misses slices.*single image of another series"),
        (lambda ds: setattr(ds, "FrameOfReferenceUID", generate_uid()), "mixes 2 frames of reference"),
        (lambda ds: setattr(ds, "ImageOrientationPatient", [1, 0, 0, 0, 0, -1]), "different orientation or pixel size"),
        (lambda ds: setattr(ds, "PixelSpacing", [0.6, 0.9]), "different orientation or pixel size"),
        (lambda ds: setattr(ds, "Columns", 2), "mixes slices of 2 x 4 and 5 x 4 pixels"),
        (lambda ds: setattr(ds, "Modality", "MR"), "misses slices.*left out as MR object: IM004"),
        (lambda ds: setattr(ds, "SamplesPerPixel", 3), "misses slices.*left out as colour image"),
        (lambda ds: delattr(ds, "ImagePositionPatient"), "states no ImagePositionPatient; export it again"),
        (lambda ds: delattr(ds, "ImageOrientationPatient"), "states no ImageOrientationPatient"),
        (lambda ds: delattr(ds, "PixelSpacing"), "states no PixelSpacing"),
        (lambda ds: setattr(ds, "PixelData", ds.PixelData[:10]), "pixels that cannot be decoded"),
        (lambda ds: setattr(ds, "NumberOfFrames", 2), "states no SpacingBetweenSlices"),
    ],
)
def test_series_with_one_odd_slice_is_refused(tmp_path, axial, change, sentence):
    change(axial[4])
    check_refused(tmp_path, axial, sentence)


def test_single_slice_is_refused(tmp_path, axial):
    check_refused(tmp_path, axial[:1], "holds one slice, at least 2 needed")


def test_folder_without_dicom_is_refused(tmp_path):
    (tmp_path / "ct").mkdir()
    (tmp_path / "ct" / "readme.txt").write_text("nothing")
    with pytest.raises(InputRefused, match="holds no DICOM images; name the folder"):
        read_volume(tmp_path / "ct")


def test_multi_frame_without_spacing_is_refused(tmp_path):
    ds = ct_slice(np.eye(3), 0)
    ds.NumberOfFrames = NK
    ds.PixelData = ds.PixelData * NK
    check_refused(tmp_path, [ds], "states no SpacingBetweenSlices")


def test_dicom_values_are_read_back_by_the_library_too(tmp_path, axial):
    folder = save(tmp_path / "ct", axial)
    first = pydicom.dcmread(folder / "IM000")
    assert_allclose(read_volume(folder).hu[:, :, 0].T, first.pixel_array + float(first.RescaleIntercept))
