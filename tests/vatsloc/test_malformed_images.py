"""Each field of each image format, mutated: the image is read right or refused, and nothing else happens."""

from __future__ import annotations

import gzip
from pathlib import Path

import nibabel
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from registration.maps.field import DisplacementField
from registration.volume import Volume
from tests.vatsloc.image_files import affine_of, metaimage_header
from tests.vatsloc.malformed import bounded, junk, read_or_refused
from vatsloc.errors import InputRefused, VatslocError
from vatsloc.formats.fields import read_field, write_field
from vatsloc.formats.images import read_mask, read_region, read_volume

SHAPE = (4, 5, 6)
AFFINE = affine_of("LPS")
VALUES = np.arange(np.prod(SHAPE), dtype=np.int16).reshape(SHAPE)


def same(volume: Volume) -> bool:
    """Whether an image holds what it held before its header was mutated."""
    return np.array_equal(volume.hu, VALUES) and np.allclose(volume.ras_from_ijk, AFFINE, atol=1e-3)


def nifti_header() -> np.ndarray:
    image = nibabel.Nifti1Image(VALUES, AFFINE)
    image.set_qform(AFFINE, code=1)
    image.header.set_xyzt_units("mm")
    return np.frombuffer(image.to_bytes()[:348], dtype=image.header.structarr.dtype)[0].copy()


HEADER = nifti_header()
FREE = ("scl_slope", "scl_inter", "dim_info", "db_name", "descrip", "aux_file", "intent_name", "magic", "data_type")
PLACES = [
    (name, index) for name in HEADER.dtype.names if name not in FREE for index in np.ndindex(HEADER.dtype[name].shape)
]
NUMBERS = (-1.0, 0.0, 1.0, 3.0, 7.0, 2.0**15 - 1, -(2.0**15), 1e9, 1e30, -1e30, np.nan, np.inf, -np.inf)


def put(header: np.ndarray, name: str, index: tuple[int, ...], number: float) -> None:
    """A number into a field, cut to what its type can hold."""
    kind = HEADER.dtype[name].base
    if kind.kind in "iu":
        info = np.iinfo(kind)
        number = float(np.clip(np.nan_to_num(number, nan=0, posinf=info.max, neginf=info.min), info.min, info.max))
    with np.errstate(over="ignore"):
        if index:
            header[name][index] = number
        else:
            header[name] = number


@bounded(150)
@given(place=st.sampled_from(PLACES), number=st.sampled_from(NUMBERS), packed=st.booleans())
def test_nifti_fields(tmp_path: Path, place: tuple[str, tuple[int, ...]], number: float, packed: bool) -> None:
    header = HEADER.copy()
    put(header, *place, number)
    data = header.tobytes() + bytes(4) + VALUES.tobytes(order="F")
    path = tmp_path / ("ct.nii.gz" if packed else "ct.nii")
    path.write_bytes(gzip.compress(data, 1) if packed else data)
    read_or_refused(lambda: read_volume(path), same)


@bounded(60)
@given(slope=st.sampled_from(NUMBERS), shift=st.sampled_from(NUMBERS))
def test_nifti_scaling_is_applied_or_refused(tmp_path: Path, slope: float, shift: float) -> None:
    header = HEADER.copy()
    put(header, "scl_slope", (), slope)
    put(header, "scl_inter", (), shift)
    (tmp_path / "ct.nii").write_bytes(header.tobytes() + bytes(4) + VALUES.tobytes(order="F"))
    scaled = VALUES if slope == 0 or not np.isfinite(slope) else np.float64(VALUES) * slope + shift
    read_or_refused(
        lambda: read_volume(tmp_path / "ct.nii"), lambda volume: np.allclose(volume.hu, scaled, rtol=1e-5, atol=1e-3)
    )


@bounded(150)
@given(at=st.integers(0, 351), byte=st.integers(0, 255), cut=st.integers(0, 600), packed=st.booleans())
def test_no_byte_of_a_nifti_header_raises_anything_but_a_refusal(
    tmp_path: Path, at: int, byte: int, cut: int, packed: bool
) -> None:
    data = bytearray(HEADER.tobytes() + bytes(4) + VALUES.tobytes(order="F"))
    data[at] = byte
    if cut < 300:
        data = data[: len(data) - cut]
    path = tmp_path / ("ct.nii.gz" if packed else "ct.nii")
    path.write_bytes(gzip.compress(bytes(data), 1) if packed else bytes(data))
    read_or_refused(lambda: read_volume(path), lambda volume: bool(np.isfinite(volume.hu).all()))


@bounded(120)
@given(place=st.sampled_from(PLACES), number=st.sampled_from(NUMBERS))
def test_displacement_field_s_header(tmp_path: Path, place: tuple[str, tuple[int, ...]], number: float) -> None:
    path = tmp_path / "field.nii.gz"
    vectors = np.arange(4 * 5 * 6 * 3, dtype=np.float32).reshape(4, 5, 6, 3)
    write_field(path, DisplacementField(vectors, AFFINE))
    data = bytearray(gzip.decompress(path.read_bytes()))
    header = np.frombuffer(bytes(data[:348]), dtype=HEADER.dtype)[0].copy()
    put(header, *place, number)
    path.write_bytes(gzip.compress(header.tobytes() + bytes(data[348:]), 1))
    read_or_refused(
        lambda: read_field(path),
        lambda field: np.allclose(field.vectors, vectors) and np.allclose(field.ras_from_ijk, AFFINE, atol=1e-3),
    )


META = metaimage_header(VALUES, AFFINE).splitlines()


@bounded(150)
@given(line=st.integers(0, len(META) - 1), value=junk, how=st.sampled_from(("value", "gone", "twice", "no equals")))
def test_metaimage_fields(tmp_path: Path, line: int, value: str, how: str) -> None:
    lines, key = list(META), META[line].partition(" = ")[0]
    if key == "Offset" and value in ("-1 -1 -1", "0 0 0"):
        return  # a right value, of another place
    changed = {
        "value": [f"{key} = {value}"],
        "gone": [],
        "twice": [lines[line], f"{key} = {value}"],
        "no equals": [key],
    }
    lines[line : line + 1] = changed[how]
    path = tmp_path / "ct.mha"
    path.write_bytes(("\n".join(lines) + "\n").encode() + VALUES.tobytes(order="F"))
    read_or_refused(lambda: read_volume(path), same)


LPS = np.diag([-1.0, -1, 1, 1]) @ AFFINE
NRRD = [
    "NRRD0004",
    "type: short",
    "dimension: 3",
    "space: left-posterior-superior",
    "sizes: 4 5 6",
    "space directions: " + " ".join(f"({','.join(repr(float(v)) for v in LPS[:3, m])})" for m in range(3)),
    "kinds: domain domain domain",
    'space units: "mm" "mm" "mm"',
    "endian: little",
    "encoding: raw",
    f"space origin: ({','.join(repr(float(v)) for v in LPS[:3, 3])})",
]


@bounded(150)
@given(line=st.integers(0, len(NRRD) - 1), value=junk, how=st.sampled_from(("value", "gone", "twice", "no colon")))
def test_nrrd_fields(tmp_path: Path, line: int, value: str, how: str) -> None:
    lines, key = list(NRRD), NRRD[line].partition(": ")[0]
    changed = {"value": [f"{key}: {value}"], "gone": [], "twice": [lines[line], f"{key}: {value}"], "no colon": [key]}
    lines[line : line + 1] = changed[how]
    path = tmp_path / "ct.nrrd"
    path.write_bytes(("\n".join(lines) + "\n\n").encode() + VALUES.tobytes(order="F"))
    read_or_refused(lambda: read_volume(path), same)


@bounded(120)
@given(key=st.sampled_from(("Name", "LabelValue", "Layer", "ID")), segment=st.integers(0, 1), value=junk)
def test_fields_of_a_segmentation(tmp_path: Path, key: str, segment: int, value: str) -> None:
    """The nodule is found by its name, or the file is refused; never the lung in its place."""
    named = {"Segment0_Name": "lung", "Segment0_LabelValue": "1", "Segment1_Name": "nodule", "Segment1_LabelValue": "2"}
    named |= {"Segment0_Layer": "0", "Segment1_Layer": "0", f"Segment{segment}_{key}": value}
    labels = np.zeros(SHAPE, dtype=np.int16)
    labels[:3], labels[2, 2, 2] = 1, 2
    path = tmp_path / "seg.seg.nrrd"
    header = "\n".join([*NRRD, *(f"{k}:={v}" for k, v in named.items())])
    path.write_bytes(f"{header}\n\n".encode() + labels.tobytes(order="F"))
    read_or_refused(lambda: read_region(path, "nodule"), lambda mask: np.array_equal(mask.inside, labels == 2))


@pytest.mark.parametrize(
    ("name", "header"),
    [
        ("ct.mha", "\n".join(META).replace("DimSize = 4 5 6", "DimSize = 60000 60000 60000") + "\n"),
        ("ct.nrrd", "\n".join(NRRD).replace("sizes: 4 5 6", "sizes: 60000 60000 60000") + "\n\n"),
    ],
)
def test_sizes_beyond_any_scan_are_refused_before_memory_is_taken(tmp_path: Path, name: str, header: str) -> None:
    (tmp_path / name).write_bytes(header.encode() + VALUES.tobytes())
    with pytest.raises(InputRefused, match="60000 x 60000 x 60000 voxels, more than any scan has"):
        read_volume(tmp_path / name)


@pytest.mark.parametrize("suffix", ["nii", "nii.gz"])
def test_nifti_sizes_beyond_the_file_are_refused_before_memory_is_taken(tmp_path: Path, suffix: str) -> None:
    header = HEADER.copy()
    header["dim"][1:4] = 1000
    data = header.tobytes() + bytes(4) + VALUES.tobytes()
    (tmp_path / f"ct.{suffix}").write_bytes(gzip.compress(data) if suffix == "nii.gz" else data)
    with pytest.raises(InputRefused, match="2000000000 needed for 1000 x 1000 x 1000"):
        read_volume(tmp_path / f"ct.{suffix}")


@pytest.mark.parametrize("name", ["a\0b.nii", "x" * 300 + ".nii.gz"])
def test_names_that_no_file_can_have_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(VatslocError, match=r"correct the path"):
        read_mask(tmp_path / name)
