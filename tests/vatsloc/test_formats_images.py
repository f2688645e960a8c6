"""NIfTI, NRRD and MetaImage: where a voxel lies, what it holds, and what is refused."""

from __future__ import annotations

import zlib
from pathlib import Path

import nibabel
import nrrd
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from registration.volume import Grid, Mask, Volume, axis_codes
from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.images import files_behind, read_mask, read_volume
from vatsloc.formats.nifti import write_mask, write_volume
from vatsloc.frames import flip_affine

SHAPE = (4, 5, 6)
ORIENTATIONS = ["RAS", "LAS", "LPS", "PIR", "SAL", "oblique"]


def affine_of(orientation: str) -> np.ndarray:
    axes = np.zeros((3, 3))
    if orientation == "oblique":
        axes = Rotation.from_rotvec([0.2, -0.3, 0.1]).as_matrix() * [-1, 1, 1]
    else:
        for column, letter in enumerate(orientation):
            axes["RLAPSI".index(letter) // 2, column] = 1 if letter in "RAS" else -1
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = axes * [0.5, 1.5, 2.0], [-31.0, 17.0, 5.0]
    return affine


def hu_at(points_ras: np.ndarray) -> np.ndarray:
    """A ramp that tells every direction from every other."""
    return np.asarray(points_ras @ [1.0, 10.0, 100.0] - 500, dtype=np.float32)


def write_nii(path: Path, values: np.ndarray, affine: np.ndarray) -> None:
    image = nibabel.Nifti1Image(values, affine)
    image.header.set_xyzt_units("mm")
    nibabel.save(image, path)


SIGNS_TO_RAS = {
    "left-posterior-superior": (-1, -1),
    "LPS": (-1, -1),
    "left-anterior-superior": (-1, 1),
    "LAS": (-1, 1),
    "right-anterior-superior": (1, 1),
    "RAS": (1, 1),
}


def write_nrrd(
    path: Path, values: np.ndarray, affine: np.ndarray, space: str = "left-posterior-superior", **more
) -> None:
    world = np.diag([*SIGNS_TO_RAS[space], 1, 1]) @ affine
    header = {"space": space, "space directions": world[:3, :3].T, "space origin": world[:3, 3], **more}
    nrrd.write(str(path), values, {key: value for key, value in header.items() if value is not None})


def metaimage_header(values: np.ndarray, affine: np.ndarray, **changes: str | None) -> str:
    lps = flip_affine(affine)
    spacing = np.linalg.norm(lps[:3, :3], axis=0)
    kind = {"int16": "MET_SHORT", "float32": "MET_FLOAT", "uint8": "MET_UCHAR", "float64": "MET_DOUBLE"}[
        str(values.dtype)
    ]
    fields = {
        "ObjectType": "Image",
        "NDims": str(values.ndim),
        "BinaryData": "True",
        "BinaryDataByteOrderMSB": "False",
        "CompressedData": "False",
        "TransformMatrix": " ".join(map(repr, map(float, (lps[:3, :3] / spacing).T.ravel()))),
        "Offset": " ".join(map(repr, map(float, lps[:3, 3]))),
        "ElementSpacing": " ".join(map(repr, map(float, spacing))),
        "DimSize": " ".join(map(str, values.shape)),
        "ElementType": kind,
        **changes,
    }
    data_file = fields.pop("ElementDataFile", "LOCAL")
    return "".join(f"{k} = {v}\n" for k, v in fields.items() if v is not None) + f"ElementDataFile = {data_file}\n"


def write_mha(path: Path, values: np.ndarray, affine: np.ndarray, **changes: str | None) -> None:
    path.write_bytes(metaimage_header(values, affine, **changes).encode() + values.tobytes(order="F"))


WRITERS = {"nii": write_nii, "nii.gz": write_nii, "nrrd": write_nrrd, "mha": write_mha}


def check_ramp(volume: Volume, orientation: str) -> None:
    assert volume.hu.dtype == np.float32
    assert volume.hu.shape == SHAPE
    assert_allclose(volume.ras_from_ijk, affine_of(orientation), atol=1e-5)
    assert_allclose(volume.hu, hu_at(volume.grid.points()), atol=0.01)


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


@pytest.mark.parametrize(("lowest", "stored"), [(-500.0, np.int16), (-40000.0, np.float32)])
def test_written_volume_comes_back_on_its_grid(tmp_path, orientation, lowest, stored):
    grid = Grid(SHAPE, affine_of(orientation))
    hu = np.rint(hu_at(grid.points()))
    hu[0, 0, 0] = lowest
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


def test_nifti_whose_two_frames_disagree_is_refused(tmp_path):
    image = nibabel.Nifti1Image(hu_at(Grid(SHAPE, np.eye(4)).points()), np.eye(4))
    image.set_qform(np.diag([-1.0, -1.0, 1.0, 1.0]), code=1)
    nibabel.save(image, tmp_path / "ct.nii")
    with pytest.raises(InputRefused, match="two frames: qform and sform place the same voxel 8 mm apart"):
        read_volume(tmp_path / "ct.nii")


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


def test_nifti_whose_voxel_size_contradicts_its_matrix_is_refused(tmp_path):
    """The sform says 0.5 x 1.5 x 2 mm, which is read; pixdim says 1 x 1 x 1, which other programs would take."""
    image = nibabel.Nifti1Image(hu_at(Grid(SHAPE, np.eye(4)).points()), None)
    image.set_sform(affine_of("LPS"), code=1)
    nibabel.save(image, tmp_path / "ct.nii")
    sentence = r"two voxel sizes: 1 x 1 x 1 mm as pixdim, 0\.5 x 1\.5 x 2 mm by its matrix; programs differ in which"
    with pytest.raises(InputRefused, match=sentence):
        read_volume(tmp_path / "ct.nii")


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
