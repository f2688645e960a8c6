"""DICOM by hand-made files: slices in any order, per-slice rescale, multi-frame, and every refusal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pydicom
import pytest
from numpy.testing import assert_allclose
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.sequence import Sequence
from pydicom.uid import CTImageStorage, EnhancedCTImageStorage, ExplicitVRLittleEndian, generate_uid
from scipy.spatial.transform import Rotation

from registration.volume import Volume
from vatsloc.errors import InputRefused
from vatsloc.formats.dicom import PADDING_HU
from vatsloc.formats.images import files_behind, read_volume

NI, NJ, NK = 5, 4, 6
COLUMN_MM, ROW_MM, SLICE_MM = 0.8, 0.6, 2.5
ORIGIN_LPS = np.array([-20.0, 13.0, -44.0])
SERIES, FRAME = generate_uid(), generate_uid()

ORIENTATIONS = {
    "axial": np.eye(3),
    "feet first": np.diag([1.0, -1.0, -1.0]),
    "coronal": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).T,
    "sagittal": np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]]).T,
    "oblique": Rotation.from_rotvec([0.2, -0.3, 0.1]).as_matrix(),
}
"""Columns: along a row, along a column, along the slice normal; LPS."""


def hu_at(points_lps: np.ndarray) -> np.ndarray:
    return np.rint(points_lps @ [-1.0, -10.0, 7.0])


def position(axes: np.ndarray, k: float) -> np.ndarray:
    return ORIGIN_LPS + axes[:, 2] * SLICE_MM * k


def slice_hu(axes: np.ndarray, k: float) -> np.ndarray:
    """(rows, columns), as DICOM stores it."""
    j, i = np.meshgrid(np.arange(NJ), np.arange(NI), indexing="ij")
    points = position(axes, k) + i[..., None] * axes[:, 0] * COLUMN_MM + j[..., None] * axes[:, 1] * ROW_MM
    return hu_at(points)


def base(axes: np.ndarray, sop_class: str = CTImageStorage) -> Dataset:
    ds = Dataset()
    ds.file_meta = FileMetaDataset()
    ds.file_meta.MediaStorageSOPClassUID = sop_class
    ds.file_meta.MediaStorageSOPInstanceUID = generate_uid()
    ds.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    ds.SOPClassUID, ds.SOPInstanceUID = sop_class, ds.file_meta.MediaStorageSOPInstanceUID
    ds.Modality, ds.SeriesInstanceUID, ds.FrameOfReferenceUID = "CT", SERIES, FRAME
    ds.Rows, ds.Columns, ds.SamplesPerPixel, ds.PhotometricInterpretation = NJ, NI, 1, "MONOCHROME2"
    ds.BitsAllocated, ds.BitsStored, ds.HighBit, ds.PixelRepresentation = 16, 16, 15, 1
    return ds


def ct_slice(axes: np.ndarray, k: float, slope: float = 1.0, intercept: float = -1024.0) -> Dataset:
    ds = base(axes)
    ds.ImagePositionPatient = [f"{v:.8g}" for v in position(axes, k)]
    ds.ImageOrientationPatient = [f"{v:.10g}" for v in axes[:, :2].T.ravel()]
    ds.PixelSpacing = [ROW_MM, COLUMN_MM]
    ds.RescaleSlope, ds.RescaleIntercept = slope, intercept
    ds.InstanceNumber = 1
    ds.PixelData = np.rint((slice_hu(axes, k) - intercept) / slope).astype("<i2").tobytes()
    return ds


def save(folder: Path, slices: list[Dataset]) -> Path:
    folder.mkdir(exist_ok=True)
    for n, ds in enumerate(slices):
        ds.save_as(folder / f"IM{n:03d}", enforce_file_format=True)
    return folder


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


def enhanced(axes: np.ndarray, order: list[int]) -> Dataset:
    """Multi-frame with functional groups: orientation and spacing shared, position and rescale per frame."""
    ds = base(axes, EnhancedCTImageStorage)
    ds.NumberOfFrames = len(order)
    shared, measures, orientation = Dataset(), Dataset(), Dataset()
    measures.PixelSpacing = [ROW_MM, COLUMN_MM]
    orientation.ImageOrientationPatient = [f"{v:.10g}" for v in axes[:, :2].T.ravel()]
    shared.PixelMeasuresSequence, shared.PlaneOrientationSequence = Sequence([measures]), Sequence([orientation])
    ds.SharedFunctionalGroupsSequence = Sequence([shared])
    frames, pixels = [], []
    for k in order:
        frame, place, rescale = Dataset(), Dataset(), Dataset()
        place.ImagePositionPatient = [f"{v:.8g}" for v in position(axes, k)]
        rescale.RescaleSlope, rescale.RescaleIntercept = 1, -100 * k
        frame.PlanePositionSequence, frame.PixelValueTransformationSequence = Sequence([place]), Sequence([rescale])
        frames.append(frame)
        pixels.append((slice_hu(axes, k) + 100 * k).astype("<i2"))
    ds.PerFrameFunctionalGroupsSequence = Sequence(frames)
    ds.PixelData = np.stack(pixels).tobytes()
    return ds


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


def refused(tmp_path: Path, slices: list[Dataset], sentence: str) -> None:
    with pytest.raises(InputRefused, match=sentence):
        read_volume(save(tmp_path / "ct", slices))


def test_missing_slice_is_refused(tmp_path, axial):
    refused(
        tmp_path,
        axial[:3] + axial[4:],
        r"misses slices between -39\.0 and -34\.0 mm \(5\.00 mm apart, 2\.50 mm elsewhere",
    )


def test_uneven_spacing_is_refused(tmp_path):
    slices = [ct_slice(np.eye(3), k) for k in (0, 1, 2, 3.2, 4.2, 5.2)]
    refused(tmp_path, slices, r"unevenly spaced slices \(2\.50 to 3\.00 mm apart\); export")


def test_positions_rounded_by_the_scanner_are_accepted(tmp_path):
    slices = [ct_slice(np.eye(3), k + 0.015 * (-1) ** k) for k in range(NK)]
    assert_allclose(read_volume(save(tmp_path / "ct", slices)).grid.spacing[2], SLICE_MM, rtol=0.02)


def test_doubled_slice_is_refused(tmp_path, axial):
    refused(tmp_path, [*axial, ct_slice(np.eye(3), 2)], r"two slices at the same place \(-39\.0 mm\); keep one phase")


def test_gantry_tilt_is_refused(tmp_path, axial):
    for k, ds in enumerate(axial):
        ds.ImagePositionPatient = [ORIGIN_LPS[0], ORIGIN_LPS[1] + 0.5 * k, ORIGIN_LPS[2] + SLICE_MM * k]
    refused(tmp_path, axial, r"sheared: two voxel axes are 11\.3 degrees off a right angle; .* undo the tilt")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda ds: setattr(ds, "SeriesInstanceUID", generate_uid()), "mixes 2 series; keep the slices of one series"),
        (lambda ds: setattr(ds, "FrameOfReferenceUID", generate_uid()), "mixes 2 frames of reference"),
        (lambda ds: setattr(ds, "ImageOrientationPatient", [1, 0, 0, 0, 0, -1]), "different orientation or pixel size"),
        (lambda ds: setattr(ds, "PixelSpacing", [0.6, 0.9]), "different orientation or pixel size"),
        (lambda ds: setattr(ds, "Columns", 2), "mixes slices of 2 x 4 and 5 x 4 pixels"),
        (lambda ds: setattr(ds, "Modality", "MR"), "is MR, not CT; export the CT"),
        (lambda ds: setattr(ds, "SamplesPerPixel", 3), "colour image"),
        (lambda ds: delattr(ds, "ImagePositionPatient"), "states no ImagePositionPatient; export it with its position"),
        (lambda ds: delattr(ds, "ImageOrientationPatient"), "states no ImageOrientationPatient"),
        (lambda ds: delattr(ds, "PixelSpacing"), "states no PixelSpacing"),
        (lambda ds: setattr(ds, "PixelData", ds.PixelData[:10]), "pixels that cannot be decoded"),
        (lambda ds: setattr(ds, "NumberOfFrames", 2), "some are multi-frame; keep one image per folder"),
    ],
)
def test_series_with_one_odd_slice_is_refused(tmp_path, axial, change, sentence):
    change(axial[4])
    refused(tmp_path, axial, sentence)


def test_single_slice_is_refused(tmp_path, axial):
    refused(tmp_path, axial[:1], "holds one slice, at least 2 needed")


def test_folder_without_dicom_is_refused(tmp_path):
    (tmp_path / "ct").mkdir()
    (tmp_path / "ct" / "readme.txt").write_text("nothing")
    with pytest.raises(InputRefused, match="holds no DICOM images; name the folder"):
        read_volume(tmp_path / "ct")


def test_multi_frame_without_spacing_is_refused(tmp_path):
    ds = ct_slice(np.eye(3), 0)
    ds.NumberOfFrames = NK
    ds.PixelData = ds.PixelData * NK
    refused(tmp_path, [ds], "states no SpacingBetweenSlices")


def test_dicom_values_are_read_back_by_the_library_too(tmp_path, axial):
    folder = save(tmp_path / "ct", axial)
    first = pydicom.dcmread(folder / "IM000")
    assert_allclose(read_volume(folder).hu[:, :, 0].T, first.pixel_array + float(first.RescaleIntercept))
