"""NIfTI, NRRD and MetaImage that cannot be trusted: each refusal by its sentence."""

from __future__ import annotations

import zlib
from contextlib import nullcontext
from pathlib import Path

import nibabel
import nrrd
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from registration.volume import Grid
from tests.vatsloc.image_files import (
    SHAPE,
    WRITERS,
    affine_of,
    check_ramp,
    hu_at,
    metaimage_header,
    write_mha,
    write_nii,
    write_nrrd,
)
from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.images import read_mask, read_volume
from vatsloc.formats.raw import check_voxel_size


def sheared() -> np.ndarray:
    affine = affine_of("LPS")
    affine[:3, 1] += 0.2 * affine[:3, 0]
    return affine


BAD_VALUES = {
    "not finite": lambda v: np.where(v == v.max(), np.nan, v).astype(np.float32),
    "everywhere": lambda v: np.zeros_like(v),
    "not one three-dimensional image": lambda v: np.stack([v, v], axis=-1),
}


@pytest.mark.parametrize("suffix", ["nii.gz", "mha"])
@pytest.mark.parametrize("sentence", BAD_VALUES)
def test_bad_values_are_refused(tmp_path, suffix, sentence):
    values = BAD_VALUES[sentence](hu_at(Grid(SHAPE, affine_of("LPS")).points()))
    more = {"TransformMatrix": " ".join(map(str, np.eye(4).ravel())), "Offset": "0 0 0 0", "ElementSpacing": "1 1 1 1"}
    WRITERS[suffix](
        tmp_path / f"ct.{suffix}", values, affine_of("LPS"), **(more if suffix == "mha" and values.ndim == 4 else {})
    )
    with pytest.raises(InputRefused, match=sentence):
        read_volume(tmp_path / f"ct.{suffix}")


def test_infinite_values_are_counted(tmp_path):
    values = hu_at(Grid(SHAPE, affine_of("LPS")).points())
    values[0, 0, :2] = np.inf
    write_nii(tmp_path / "ct.nii", values, affine_of("LPS"))
    with pytest.raises(InputRefused, match="2 voxels that are not finite numbers; repair or re-export"):
        read_volume(tmp_path / "ct.nii")


@pytest.mark.parametrize("suffix", ["nii", "nrrd"])
def test_sheared_image_is_refused(tmp_path, suffix):
    values = hu_at(Grid(SHAPE, np.eye(4)).points())
    if suffix == "nii":
        image = nibabel.Nifti1Image(values, None)
        image.set_sform(sheared(), code=1)
        nibabel.save(image, tmp_path / "ct.nii")
    else:
        write_nrrd(tmp_path / "ct.nrrd", values, sheared())
    with pytest.raises(InputRefused, match=r"sheared: two voxel axes are 3\.8 degrees off .* resample it"):
        read_volume(tmp_path / f"ct.{suffix}")


@pytest.mark.parametrize(
    ("column", "sentence"),
    [
        ([0.0, 0.0, 0.0], "voxels of 0.5 x 0 x 2 mm"),
        ([-1.0, 0.0, 0.0], "same direction"),
        ([np.nan, 0, 0], "not finite"),
    ],
)
def test_degenerate_affine_is_refused(tmp_path, column, sentence):
    affine = affine_of("LPS")
    affine[:3, 1] = column
    image = nibabel.Nifti1Image(hu_at(Grid(SHAPE, np.eye(4)).points()), None)
    image.header["srow_x"], image.header["srow_y"], image.header["srow_z"] = affine[:3]
    image.header["sform_code"], image.header["qform_code"] = 1, 0
    nibabel.save(image, tmp_path / "ct.nii")
    with pytest.raises(InputRefused, match=sentence):
        read_volume(tmp_path / "ct.nii")


def test_nifti_without_a_frame_is_refused(tmp_path):
    image = nibabel.Nifti1Image(hu_at(Grid(SHAPE, np.eye(4)).points()), None)
    nibabel.save(image, tmp_path / "ct.nii")
    with pytest.raises(InputRefused, match=r"states no frame .* export it with its position in space"):
        read_volume(tmp_path / "ct.nii")


@pytest.mark.parametrize(
    ("axes", "shift", "apart"),
    [([-1, -1, 1], [0, 0, 0], 8), ([1, 1, 1], [3, -4, 12], 12), ([1, 1, 1], [0.5, -0.9, 0.9], 0)],
)
def test_nifti_whose_two_frames_disagree_is_refused(tmp_path, axes, shift, apart):
    image = nibabel.Nifti1Image(hu_at(Grid(SHAPE, np.eye(4)).points()), np.eye(4))
    other = np.diag([*axes, 1.0])
    other[:3, 3] = shift
    image.set_qform(other, code=1)
    nibabel.save(image, tmp_path / "ct.nii")
    if apart:
        with pytest.raises(InputRefused, match=f"two frames: qform and sform place the same voxel {apart} mm apart"):
            read_volume(tmp_path / "ct.nii")
    else:
        assert_array_equal(read_volume(tmp_path / "ct.nii").ras_from_ijk, np.eye(4))


@pytest.mark.parametrize("unit", ["meter", "micron"])
def test_nifti_in_other_units_is_refused(tmp_path, unit):
    image = nibabel.Nifti1Image(hu_at(Grid(SHAPE, np.eye(4)).points()), np.eye(4))
    image.header.set_xyzt_units(unit)
    nibabel.save(image, tmp_path / "ct.nii")
    with pytest.raises(InputRefused, match=f"in {unit}, not mm"):
        read_volume(tmp_path / "ct.nii")


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        ({"space": "scanner-xyz"}, 'space "scanner-xyz"'),
        ({"space origin": None}, "no space origin"),
        ({"space units": ["m", "m", "m"]}, "in m, not mm"),
    ],
)
def test_nrrd_without_a_patient_frame_is_refused(tmp_path, more, sentence):
    values = hu_at(Grid(SHAPE, np.eye(4)).points())
    space = more.pop("space", None)
    write_nrrd(tmp_path / "ct.nrrd", values, np.eye(4), **more)
    if space is not None:
        data = (tmp_path / "ct.nrrd").read_bytes().replace(b"left-posterior-superior", space.encode())
        (tmp_path / "ct.nrrd").write_bytes(data)
    with pytest.raises(InputRefused, match=sentence):
        read_volume(tmp_path / "ct.nrrd")


def test_nrrd_without_space_is_refused(tmp_path):
    nrrd.write(str(tmp_path / "ct.nrrd"), hu_at(Grid(SHAPE, np.eye(4)).points()), {"spacings": [1.0, 1.0, 1.0]})
    with pytest.raises(InputRefused, match=r"states no space; export it with space left-posterior-superior"):
        read_volume(tmp_path / "ct.nrrd")


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"Offset": None}, "no TransformMatrix or no Offset"),
        ({"TransformMatrix": None}, "no TransformMatrix or no Offset"),
        ({"ElementSpacing": "1 1"}, "ElementSpacing = 1 1, 3 numbers needed"),
        ({"DimSize": "4 5 7"}, "480 bytes of voxels, 560 needed"),
        ({"ElementType": "MET_OTHER"}, "ElementType MET_OTHER"),
        ({"ElementNumberOfChannels": "3"}, "several channels"),
        ({"CompressedData": "True"}, "cannot be decompressed"),
        ({"ElementDataFile": "gone.raw"}, "gone.raw, named by ct.mha, cannot be read; put it beside"),
        ({"ElementDataFile": "slice%03d.raw 1 6 1"}, "slice by slice"),
        ({"DistanceUnits": "um"}, "in um, not mm"),
        ({"NDims": "2"}, "has 2 axes"),
        ({"NDims": "3.5"}, "NDims = 3.5, whole numbers needed"),
        ({"ElementSpacing": "0,5 1,5 2"}, "ElementSpacing = 0,5 1,5 2, 3 numbers needed"),
        ({"ElementSpacing": "-0.5 1.5 2"}, "ElementSpacing = -0.5 1.5 2, sizes above 0 needed"),
        ({"TransformMatrix": "0.5 0 0 0 1.5 0 0 0 2"}, "axes of length 0.5 x 1.5 x 2, 1 needed, beside ElementSpacing"),
        ({"BinaryDataByteOrderMSB": ""}, "BinaryDataByteOrderMSB = nothing, True or False needed"),
        ({"ElementNumberOfChannels": "one"}, "ElementNumberOfChannels = one, 1 numbers needed"),
    ],
)
def test_bad_metaimage_is_refused(tmp_path, changes, sentence):
    write_mha(tmp_path / "ct.mha", hu_at(Grid(SHAPE, affine_of("LPS")).points()), affine_of("LPS"), **changes)
    with pytest.raises(InputRefused, match=sentence):
        read_volume(tmp_path / "ct.mha")


@pytest.mark.parametrize("suffix", ["nii", "nii.gz", "nrrd", "mha", "mhd"])
def test_garbage_is_refused_as_unreadable(tmp_path, suffix):
    (tmp_path / f"ct.{suffix}").write_bytes(b"\x93not an image\x00" * 50)
    with pytest.raises(InputRefused, match=r"readable"):
        read_volume(tmp_path / f"ct.{suffix}")


@pytest.mark.parametrize("suffix", ["nii", "nii.gz", "nrrd", "mha"])
def test_truncated_file_is_refused(tmp_path, suffix):
    path = tmp_path / f"ct.{suffix}"
    WRITERS[suffix](path, hu_at(Grid((20, 20, 20), affine_of("LPS")).points()), affine_of("LPS"))
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    with pytest.raises(InputRefused, match=r"export it again"):
        read_volume(path)


def test_missing_and_unknown_files_are_case_errors(tmp_path):
    with pytest.raises(CaseError, match=r"ct\.nii does not exist; correct the path"):
        read_volume(tmp_path / "ct.nii")
    (tmp_path / "ct.jpg").write_bytes(b"")
    with pytest.raises(CaseError, match="no known image suffix; use"):
        read_volume(tmp_path / "ct.jpg")


def test_complex_values_are_refused(tmp_path):
    nibabel.save(nibabel.Nifti1Image(np.ones(SHAPE, dtype=np.complex64), np.eye(4)), tmp_path / "ct.nii")
    with pytest.raises(InputRefused, match="complex64, not one number per voxel"):
        read_volume(tmp_path / "ct.nii")


@pytest.mark.parametrize(
    ("value", "sentence"), [(0, "empty mask; draw the region"), (-1000, "values down to -1000, so it is no mask")]
)
def test_bad_mask_is_refused(tmp_path, value, sentence):
    write_nii(tmp_path / "mask.nii", np.full(SHAPE, value, dtype=np.int16), np.eye(4))
    with pytest.raises(InputRefused, match=sentence):
        read_mask(tmp_path / "mask.nii")


def test_nifti_whose_voxel_size_contradicts_its_matrix_is_refused(tmp_path):
    """The sform says 0.5 x 1.5 x 2 mm, which is read; pixdim says 1 x 1 x 1, which other programs would take."""
    image = nibabel.Nifti1Image(hu_at(Grid(SHAPE, np.eye(4)).points()), None)
    image.set_sform(affine_of("LPS"), code=1)
    nibabel.save(image, tmp_path / "ct.nii")
    sentence = r"two voxel sizes: 1 x 1 x 1 mm as pixdim, 0\.5 x 1\.5 x 2 mm by its matrix; programs differ in which"
    with pytest.raises(InputRefused, match=sentence):
        read_volume(tmp_path / "ct.nii")


@pytest.mark.parametrize(("off_mm", "refused"), [(0.9, False), (1.1, True)])
def test_two_statements_of_the_voxel_size_may_place_a_corner_a_millimetre_apart(off_mm, refused):
    stated = np.array([0.5, 1.5 + off_mm / 100, 2.0])
    with pytest.raises(InputRefused, match="two voxel sizes") if refused else nullcontext():
        check_voxel_size(stated, np.diag([0.5, 1.5, 2.0, 1.0]), (51, 101, 41), "pixdim", Path("ct.nii"))


@pytest.mark.parametrize("size", [0.0, -1.5, np.nan, np.inf])
def test_nifti_voxel_sizes_that_the_library_would_mend_are_refused(tmp_path, size):
    grid = Grid(SHAPE, affine_of("LPS"))
    write_nii(tmp_path / "ct.nii", hu_at(grid.points()), grid.ras_from_ijk)
    data = bytearray((tmp_path / "ct.nii").read_bytes())
    data[84:88] = np.float32(size).tobytes()  # pixdim[2]
    (tmp_path / "ct.nii").write_bytes(bytes(data))
    with pytest.raises(InputRefused, match=r"has voxels of 0\.5 x .* x 2 mm \(pixdim\); export it with its voxel size"):
        read_volume(tmp_path / "ct.nii")


def test_nifti_that_holds_more_than_it_states_is_refused(tmp_path):
    """Four of the five planes along j would be read with rows shifted."""
    grid = Grid(SHAPE, affine_of("LPS"))
    write_nii(tmp_path / "ct.nii", hu_at(grid.points()), grid.ras_from_ijk)
    data = bytearray((tmp_path / "ct.nii").read_bytes())
    data[44:46] = np.int16(4).tobytes()  # dim[2]
    (tmp_path / "ct.nii").write_bytes(bytes(data))
    with pytest.raises(InputRefused, match="holds 480 bytes of voxels, 384 needed for 4 x 4 x 6"):
        read_volume(tmp_path / "ct.nii")


def test_nrrd_spacings_that_contradict_the_directions_are_refused(tmp_path):
    grid = Grid(SHAPE, affine_of("LPS"))
    write_nrrd(tmp_path / "same.nrrd", hu_at(grid.points()), grid.ras_from_ijk, spacings=[0.5, 1.5, 2.0])
    check_ramp(read_volume(tmp_path / "same.nrrd"), "LPS")
    write_nrrd(tmp_path / "ct.nrrd", hu_at(grid.points()), grid.ras_from_ijk, spacings=[0.5, 0.5, 2.0])
    with pytest.raises(InputRefused, match=r"0\.5 x 0\.5 x 2 mm as spacings, 0\.5 x 1\.5 x 2 mm by its matrix"):
        read_volume(tmp_path / "ct.nrrd")


def test_values_beyond_single_precision_are_refused(tmp_path):
    values = np.full(SHAPE, 1e300)
    values[0] = 0
    write_nii(tmp_path / "ct.nii", values, affine_of("LPS"))
    with pytest.raises(InputRefused, match="values beyond single precision; export it in Hounsfield units"):
        read_volume(tmp_path / "ct.nii")


@pytest.mark.parametrize(("extra", "got"), [(-7, "473"), (7, "more than 480")])
def test_compressed_voxels_of_another_number_are_refused(tmp_path, extra, got):
    values = hu_at(Grid(SHAPE, affine_of("LPS")).points())
    header = metaimage_header(values, affine_of("LPS"), CompressedData="True", ElementDataFile="ct.zraw")
    (tmp_path / "ct.mhd").write_text(header)
    voxels = values.tobytes(order="F")
    (tmp_path / "ct.zraw").write_bytes(zlib.compress(voxels[:extra] if extra < 0 else voxels + bytes(extra)))
    with pytest.raises(InputRefused, match=rf"ct\.zraw holds {got} bytes of voxels, 480 needed; copy or export"):
        read_volume(tmp_path / "ct.mhd")
