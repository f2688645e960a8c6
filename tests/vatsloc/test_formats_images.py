"""NIfTI, NRRD and MetaImage: where a voxel lies, and what it holds."""

from __future__ import annotations

import zlib

import nibabel
import nrrd
import numpy as np
import pytest
from numpy.testing import assert_allclose

from registration.volume import Grid, Mask, Volume, axis_codes
from tests.vatsloc.image_files import (
    ORIENTATIONS,
    SHAPE,
    SIGNS_TO_RAS,
    WRITERS,
    affine_of,
    check_ramp,
    hu_at,
    metaimage_header,
    write_nii,
    write_nrrd,
)
from vatsloc.formats.images import files_behind, read_mask, read_volume
from vatsloc.formats.nifti import write_mask, write_volume
from vatsloc.frames import flip_affine


@pytest.fixture(params=ORIENTATIONS)
def orientation(request) -> str:
    return request.param


@pytest.mark.parametrize("suffix", WRITERS)
def test_every_voxel_of_every_format_lies_where_it_should(tmp_path, orientation, suffix):
    path = tmp_path / f"ct.{suffix}"
    grid = Grid(SHAPE, affine_of(orientation))
    WRITERS[suffix](path, hu_at(grid.points()), grid.ras_from_ijk)
    check_ramp(read_volume(path), orientation)


@pytest.mark.parametrize("space", SIGNS_TO_RAS)
def test_nrrd_space_sets_the_signs(tmp_path, orientation, space):
    grid = Grid(SHAPE, affine_of(orientation))
    write_nrrd(tmp_path / "ct.nrrd", hu_at(grid.points()), grid.ras_from_ijk, space)
    check_ramp(read_volume(tmp_path / "ct.nrrd"), orientation)


def test_nrrd_with_a_leading_axis_of_length_one(tmp_path):
    grid = Grid(SHAPE, affine_of("LPS"))
    lps = flip_affine(grid.ras_from_ijk)
    directions = np.vstack([np.full(3, np.nan), lps[:3, :3].T])
    header = {"space": "LPS", "space directions": directions, "space origin": lps[:3, 3]}
    nrrd.write(str(tmp_path / "ct.nrrd"), hu_at(grid.points())[None], header)
    check_ramp(read_volume(tmp_path / "ct.nrrd"), "LPS")


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("byte_order", ["<", ">"])
def test_mhd_with_its_voxels_in_a_neighbour(tmp_path, orientation, compressed, byte_order):
    grid = Grid(SHAPE, affine_of(orientation))
    values = hu_at(grid.points())
    data = values.astype(f"{byte_order}f4").tobytes(order="F")
    (tmp_path / "ct.zraw").write_bytes(zlib.compress(data) if compressed else data)
    changes = {
        "CompressedData": str(compressed),
        "BinaryDataByteOrderMSB": str(byte_order == ">"),
        "ElementDataFile": "ct.zraw",
    }
    (tmp_path / "ct.mhd").write_text(metaimage_header(values, grid.ras_from_ijk, **changes))
    check_ramp(read_volume(tmp_path / "ct.mhd"), orientation)
    assert files_behind(tmp_path / "ct.mhd") == [tmp_path / "ct.mhd", tmp_path / "ct.zraw"]


def test_nhdr_counts_its_data_file_as_input(tmp_path):
    grid = Grid(SHAPE, affine_of("RAS"))
    write_nrrd(tmp_path / "ct.nhdr", hu_at(grid.points()), grid.ras_from_ijk)
    check_ramp(read_volume(tmp_path / "ct.nhdr"), "RAS")
    assert [f.name for f in files_behind(tmp_path / "ct.nhdr")] == ["ct.nhdr", "ct.raw.gz"]


def test_nifti_scaling_is_applied(tmp_path):
    image = nibabel.Nifti1Image(np.full(SHAPE, 3, dtype=np.int16) + np.arange(6, dtype=np.int16), np.eye(4))
    image.header.set_slope_inter(2.0, -1024.0)
    nibabel.save(image, tmp_path / "ct.nii")
    assert_allclose(read_volume(tmp_path / "ct.nii").hu[1, 2], 2.0 * (3 + np.arange(6)) - 1024)


def test_nifti_with_only_a_qform_is_placed_by_it(tmp_path, orientation):
    grid = Grid(SHAPE, affine_of(orientation))
    image = nibabel.Nifti1Image(hu_at(grid.points()), None)
    image.set_sform(np.diag([9.0, 9.0, 9.0, 1.0]), code=0)
    image.set_qform(grid.ras_from_ijk, code=1)
    nibabel.save(image, tmp_path / "ct.nii")
    check_ramp(read_volume(tmp_path / "ct.nii"), orientation)


@pytest.mark.parametrize("suffix", ["nii", "nii.gz", "mha"])
def test_time_axis_of_length_one_is_dropped(tmp_path, suffix):
    grid = Grid(SHAPE, affine_of("LPS"))
    values, more = hu_at(grid.points())[..., None], {}
    if suffix == "mha":
        axes = np.eye(4)
        axes[:3, :3] = np.diag([1.0, 1, 1])
        more = {
            "TransformMatrix": " ".join(map(str, axes.ravel())),
            "Offset": "31 -17 5 0",
            "ElementSpacing": "0.5 1.5 2 1",
        }
    WRITERS[suffix](tmp_path / f"ct.{suffix}", values, grid.ras_from_ijk, **more)
    check_ramp(read_volume(tmp_path / f"ct.{suffix}"), "LPS")


@pytest.mark.parametrize(
    ("one", "stored"),
    [(-500.0, np.int16), (-32768.0, np.int16), (-32769.0, np.float32), (32767.0, np.int16), (32768.0, np.float32)],
)
def test_written_volume_comes_back_on_its_grid(tmp_path, orientation, one, stored):
    grid = Grid(SHAPE, affine_of(orientation))
    hu = np.rint(hu_at(grid.points()))
    hu[0, 0, 0] = one
    write_volume(tmp_path / "out.nii.gz", Volume(hu, grid.ras_from_ijk))
    header = nibabel.load(tmp_path / "out.nii.gz").header
    assert header.get_data_dtype() == stored
    assert (int(header["sform_code"]), int(header["qform_code"]), header.get_xyzt_units()[0]) == (1, 1, "mm")
    assert_allclose(header.get_qform(), header.get_sform(), atol=1e-4)
    back = read_volume(tmp_path / "out.nii.gz")
    assert_allclose(back.hu, hu)
    assert_allclose(back.ras_from_ijk, grid.ras_from_ijk, atol=1e-5)


def test_written_mask_comes_back_in_the_axes_asked_for(tmp_path, orientation):
    inside = np.zeros(SHAPE, dtype=bool)
    inside[1, 2, 3] = True
    mask = Mask(inside, affine_of(orientation))
    write_mask(tmp_path / "mask.nii.gz", mask, "RAS")
    back = read_mask(tmp_path / "mask.nii.gz")
    assert axis_codes(back.ras_from_ijk) == "RAS"
    assert_allclose(back.grid.to_ras(np.argwhere(back.inside)), mask.grid.to_ras(np.array([[1, 2, 3]])), atol=1e-5)


def test_same_volume_gives_the_same_bytes(tmp_path):
    volume = Volume(hu_at(Grid(SHAPE, np.eye(4)).points()), np.eye(4))
    for name in ("one.nii.gz", "two.nii.gz"):
        write_volume(tmp_path / name, volume)
    assert (tmp_path / "one.nii.gz").read_bytes() == (tmp_path / "two.nii.gz").read_bytes()


def test_values_that_are_not_finite_are_not_written(tmp_path):
    with pytest.raises(ValueError, match="not finite"):
        write_volume(tmp_path / "out.nii.gz", Volume(np.full(SHAPE, np.nan, dtype=np.float32), np.eye(4)))


def test_mask_takes_labels_and_probabilities_from_one_half(tmp_path):
    values = np.zeros(SHAPE, dtype=np.float32)
    values[0, 0, :4] = [0.4, 0.5, 1, 255]
    write_nii(tmp_path / "mask.nii", values, np.eye(4))
    assert np.argwhere(read_mask(tmp_path / "mask.nii").inside).tolist() == [[0, 0, 1], [0, 0, 2], [0, 0, 3]]


@pytest.mark.parametrize(("header_size", "before"), [("7", b"foreign"), ("-1", b"whatever precedes"), ("0", b"")])
def test_mhd_may_name_a_file_with_a_header_of_its_own(tmp_path, header_size, before):
    grid = Grid(SHAPE, affine_of("LPS"))
    values = hu_at(grid.points())
    (tmp_path / "ct.raw").write_bytes(before + values.tobytes(order="F"))
    changes = {"ElementDataFile": "ct.raw", "HeaderSize": header_size}
    (tmp_path / "ct.mhd").write_text(metaimage_header(values, grid.ras_from_ijk, **changes))
    check_ramp(read_volume(tmp_path / "ct.mhd"), "LPS")
