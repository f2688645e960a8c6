"""Volumes of several multi-frame files, series in folders below, and slices of a tilted gantry."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydicom.dataset import Dataset
from pydicom.uid import generate_uid
from scipy.spatial.transform import Rotation

from tests.vatsloc.dicom_made import (
    COLUMN_MM,
    NI,
    NJ,
    NK,
    ROW_MM,
    SLICE_MM,
    ct_slice,
    enhanced,
    hu_at,
    position,
    save,
)
from vatsloc.errors import InputRefused
from vatsloc.formats.dicom.pixels import PADDING_HU
from vatsloc.formats.images import files_behind, read_volume, read_volume_and_warnings

AXIAL, OBLIQUE = np.eye(3), Rotation.from_rotvec([0.2, -0.3, 0.1]).as_matrix()


def check_ramp(path: Path, series: str | None = None) -> None:
    volume = read_volume(path, series)
    assert volume.hu.shape == (NI, NJ, NK)
    assert_allclose(volume.hu, hu_at(volume.grid.points() * [-1, -1, 1]), atol=1e-3)


def concatenation(*orders: list[int]) -> list[Dataset]:
    parts = [enhanced(AXIAL, order) for order in orders]
    uid = generate_uid()
    for n, ds in enumerate(parts):
        ds.ConcatenationUID, ds.InConcatenationNumber, ds.InConcatenationTotalNumber = uid, n + 1, len(parts)
    return parts


def test_files_of_a_concatenation_are_one_volume(tmp_path):
    check_ramp(save(tmp_path / "ct", concatenation([3, 0], [5, 1, 2], [4])))


@pytest.mark.parametrize("there", [1, 2])
def test_a_concatenation_of_which_files_are_missing_is_refused(tmp_path, there):
    files = concatenation([0, 1], [2, 3], [4, 5])[:there]
    with pytest.raises(InputRefused, match=f"holds {there} of the 3 files of one concatenated image; export the whole"):
        read_volume(save(tmp_path / "ct", files))


def test_a_concatenation_that_lacks_slices_is_refused_for_that(tmp_path):
    with pytest.raises(InputRefused, match="misses slices between"):
        read_volume(save(tmp_path / "ct", concatenation([0, 1], [4, 5])))


def test_multi_frame_files_whose_slices_continue_each_other_are_one_volume(tmp_path):
    check_ramp(save(tmp_path / "ct", [enhanced(AXIAL, [3, 4, 5]), enhanced(AXIAL, [0, 1, 2])]))
    check_ramp(save(tmp_path / "mixed", [enhanced(AXIAL, [1, 2, 3, 4, 5]), ct_slice(AXIAL, 0)]))


@pytest.mark.parametrize(
    ("second", "listed"),
    [
        ([list(range(NK))], "6 slices in IM000; 6 slices in IM001"),
        ([[8, 9, 10]], "6 slices in IM000; 3 slices in IM001"),
        ([[0], [1]], "6 slices in IM000; 2 files of one slice"),
    ],
    ids=["two kernels", "with a gap", "single slices beside"],
)
def test_several_volumes_in_one_series_are_listed(tmp_path, second, listed):
    folder = save(tmp_path / "ct", [enhanced(AXIAL, list(range(NK))), *(enhanced(AXIAL, order) for order in second)])
    with pytest.raises(InputRefused, match=f"several volumes in one series: {listed}; name one file in"):
        read_volume(folder)
    check_ramp(folder / "IM000")


def test_series_are_looked_for_in_folders_below(tmp_path):
    (tmp_path / "export" / "study" / ".cache").mkdir(parents=True)
    slices = [ct_slice(AXIAL, k) for k in range(NK)]
    (tmp_path / "export" / "readme.txt").write_text("exported on a Monday")
    save(tmp_path / "export" / "study" / "upper", slices[3:])
    save(tmp_path / "export" / "study" / "lower", slices[:3])
    save(tmp_path / "export" / "study" / ".cache" / "again", slices)
    check_ramp(tmp_path / "export")
    assert len(files_behind(tmp_path / "export")) == NK + 1


def test_series_in_folders_below_are_listed_and_chosen(tmp_path):
    (tmp_path / "export").mkdir()
    save(tmp_path / "export" / "1", [ct_slice(AXIAL, k) for k in range(NK)])
    other = [ct_slice(AXIAL, k) for k in range(4)]
    for ds in other:
        ds.SeriesInstanceUID, ds.SeriesDescription = generate_uid(), "Lung"
        ds.SeriesInstanceUID = other[0].SeriesInstanceUID
    save(tmp_path / "export" / "2", other)
    with pytest.raises(InputRefused, match="holds 2 series"):
        read_volume(tmp_path / "export")
    assert read_volume(tmp_path / "export", "Lung").hu.shape == (NI, NJ, 4)


def test_folders_below_slices_are_let_be(tmp_path):
    folder = save(tmp_path / "ct", [ct_slice(AXIAL, k) for k in range(NK)])
    save(folder / "derived", [ct_slice(AXIAL, k) for k in range(NK)])
    check_ramp(folder)


@pytest.mark.parametrize("axes", [AXIAL, OBLIQUE], ids=["axial", "oblique"])
@pytest.mark.parametrize(
    ("rows", "columns"), [(1, 0), (-2, 0), (0, 1), (0.5, -0.25)], ids=["down", "up", "aside", "between pixels"]
)
def test_slices_of_a_tilted_gantry_are_put_upright(tmp_path, axes, rows, columns):
    """Each slice shows the ramp where it lies, `rows` and `columns` pixels off the last."""
    lean = rows * ROW_MM * axes[:, 1] + columns * COLUMN_MM * axes[:, 0]
    slices = [ct_slice(axes, k) for k in range(NK)]
    j, i = np.meshgrid(np.arange(NJ), np.arange(NI), indexing="ij")
    for k, ds in enumerate(slices):
        first = position(axes, k) + k * lean
        ds.ImagePositionPatient = [f"{v:.8g}" for v in first]
        points = first + i[..., None] * axes[:, 0] * COLUMN_MM + j[..., None] * axes[:, 1] * ROW_MM
        ds.PixelData = (hu_at(points) + 1024).astype("<i2").tobytes()
    volume, said = read_volume_and_warnings(save(tmp_path / "ct", slices))
    tilt = np.degrees(np.arctan(np.hypot(rows * ROW_MM, columns * COLUMN_MM) / SLICE_MM))
    assert said == (f"ct: its slices, of a gantry tilted by {tilt:.1f} degrees, were put upright.",)
    assert_allclose(volume.grid.spacing, [COLUMN_MM, ROW_MM, SLICE_MM], rtol=1e-6)
    wider = np.ceil(np.abs([columns * (NK - 1), rows * (NK - 1)])).astype(int)
    assert volume.hu.shape == (NI + wider[0], NJ + wider[1], NK)
    shown = volume.hu > PADDING_HU + 500
    assert_allclose(volume.hu[shown], hu_at(volume.grid.points() * [-1, -1, 1])[shown], atol=1.01)
    assert shown.sum() >= (NI - (columns % 1 > 0)) * (NJ - (rows % 1 > 0)) * NK
    if rows % 1 == columns % 1 == 0:
        assert shown.sum() == NI * NJ * NK
        assert_allclose(volume.hu[~shown], PADDING_HU)
