"""Every value of every DICOM header, malformed in turn: the image is read right, or refused; nothing else is raised."""

from __future__ import annotations

import copy
import struct
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import Phase, assume, given, settings
from hypothesis import strategies as st
from pydicom import config
from pydicom.dataelem import DataElement
from pydicom.dataset import Dataset
from pydicom.tag import BaseTag

from tests.vatsloc.dicom_drawn import blob, grid, rectangle, segmentation, structures
from tests.vatsloc.dicom_made import FRAME, NK, SLICE_MM, ct_slice, enhanced, save
from tests.vatsloc.test_dicom_pixels import lut
from vatsloc.errors import InputRefused
from vatsloc.formats.dicom.regions import read_regions
from vatsloc.formats.images import read_volume

Place = tuple[BaseTag | int, ...]
"""Tags, and indices of items between them, from a data set to one of its elements."""

SIZES = ("Rows", "Columns", "BitsAllocated", "BitsStored", "PixelSpacing", "RescaleSlope", "NumberOfFrames")
SIZES += ("SpacingBetweenSlices", "SliceThickness", "NumberOfContourPoints")
MALFORMED = {
    "absent": None,
    "empty": b"",
    "null": b"\0\0",
    "text": b"abc ",
    "decimal comma": b"0,75",
    "not a number": b"nan ",
    "infinite": b"-inf",
    "immense": b"1e300 ",
    "dots": b"1.2.3.",
    "an empty value among others": b"1\\\\2 ",
    "bytes": b"\xff\xfe\xfd\xfc\xfb\xfa\xf9\xf8",
    "odd length": b"\x01\x02\x03",
}
HOW = st.one_of(
    st.sampled_from(list(MALFORMED.values())),
    st.sampled_from(["twice", "half", "negative", "zero"]),
    st.binary(min_size=3, max_size=9),  # of one or two bytes, most are some number
)


def places(ds: Dataset) -> Iterator[Place]:
    """Every element of a data set, of the first and last items of its sequences too, and the sequences themselves."""
    for element in ds:
        yield (element.tag,)
        if element.VR == "SQ":
            for n in {0, len(element.value) - 1} if element.value else ():
                yield from ((element.tag, n, *place) for place in places(element.value[n]))


def malformed(ds: Dataset, place: Place, how: bytes | str | None) -> bytes:
    """The file of a data set with one element's bytes replaced, under the same VR.

    They are written as bytes of unknown kind, since the library writes no malformed value, and the VR is put in after.
    """
    ds = copy.deepcopy(ds)
    item = ds
    for tag, n in zip(place[:-1:2], place[1:-1:2], strict=True):
        item[tag].is_undefined_length = True
        item = item[tag].value[n]
        item.is_undefined_length_sequence_item = True
    element = item[place[-1]]
    sizes = element.keyword in SIZES
    if how is None or (how in ("negative", "zero") and not sizes):
        del item[place[-1]]
        return encoded(ds)
    value = how if isinstance(how, bytes) else changed_number(element, how)
    try:
        config.replace_un_with_known_vr = False
        item[place[-1]] = DataElement(element.tag, "UN", b"?" * len(value))
        file = encoded(ds)
    finally:
        config.replace_un_with_known_vr = True
    tag = struct.pack("<HH", element.tag.group, element.tag.element)
    long = element.VR in ("SQ", "OW", "OB")
    written = tag + b"UN\0\0" + struct.pack("<I", len(value)) + b"?" * len(value)
    wanted = tag + element.VR.encode() + struct.pack("<2xI" if long else "<H", len(value)) + value
    assert file.count(written) == 1
    return file.replace(written, wanted)


def changed_number(element: DataElement, how: str) -> bytes:
    """Bytes of a number that was doubled in multiplicity, lost its last value, or is negative or zero."""
    if element.VR in ("SQ", "OW", "OB"):
        return b"\0" * 6
    if element.VR in ("US", "SS"):
        return {"negative": b"\xfd\xff", "zero": b"\0\0", "twice": b"\1\0\1\0", "half": b"\1"}[how]
    values = list(element.value) if element.VM > 1 else [element.value]
    number = {"negative": ["-3"] * len(values), "zero": ["0"] * len(values), "twice": values * 2}
    return "\\".join(map(str, number.get(how, values[:-1]))).encode()


def encoded(ds: Dataset) -> bytes:
    """The bytes of its file."""
    out = BytesIO()
    ds.save_as(out, enforce_file_format=True)
    return out.getvalue()


def check(read: Callable[[], np.ndarray], expected: np.ndarray) -> None:
    """Read right, or refused by one of our own errors that says what to do and where."""
    try:
        got = read()
    except InputRefused as error:
        sentence = str(error)
    else:
        assert np.array_equal(got, expected)
        return
    assert "/" in sentence
    assert sentence.endswith(".")


def series() -> list[Dataset]:
    slices = [ct_slice(np.eye(3), k) for k in range(NK)]
    for k, ds in enumerate(slices):
        ds.InstanceNumber, ds.ImagesInAcquisition, ds.ImageType = k + 1, NK, ["ORIGINAL", "PRIMARY", "AXIAL"]
        ds.PixelPaddingValue, ds.PixelPaddingRangeLimit = -2000, -1990
    return slices


def with_table() -> list[Dataset]:
    slices = series()
    for ds in slices:
        ds.PixelData = np.clip(np.frombuffer(ds.PixelData, "<i2"), 0, None).tobytes()
        lut(ds, 0, np.arange(3000) - 1024, "HU", "OW")
    return slices


def by_offsets() -> list[Dataset]:
    ds = ct_slice(np.eye(3), 0)
    ds.NumberOfFrames, ds.GridFrameOffsetVector = NK, [SLICE_MM * k for k in range(NK)]
    ds.PixelData = ds.PixelData * NK
    return [ds]


IMAGES = {
    "slices": series(),
    "slices with a table": with_table(),
    "frames with groups": [enhanced(np.eye(3), list(range(NK)))],
    "frames by offsets": by_offsets(),
}
WHERE = [(name, place) for name, slices in IMAGES.items() for place in places(slices[len(slices) // 2])]


@pytest.fixture(scope="module")
def images(tmp_path_factory) -> dict[str, tuple[Path, np.ndarray]]:
    """Folder of each image and its HU."""
    folders = {name: save(tmp_path_factory.mktemp("dicom") / "ct", slices) for name, slices in IMAGES.items()}
    return {name: (folder, read_volume(folder).hu) for name, folder in folders.items()}


BOUNDED = settings(max_examples=200, derandomize=True, deadline=None, database=None, phases=[Phase.generate])


@BOUNDED
@given(where=st.sampled_from(WHERE), how=HOW)
def test_a_malformed_value_of_an_image_is_refused_or_does_no_harm(images, where, how):
    name, place = where
    folder, expected = images[name]
    n = len(IMAGES[name]) // 2
    assume(place[-1] != 0x00280103 or how != MALFORMED["null"])  # 0 is another, well-formed Pixel Representation
    file = folder / f"IM{n:03d}"
    kept = file.read_bytes()
    try:
        file.write_bytes(malformed(IMAGES[name][n], place, how))
        check(lambda: read_volume(folder).hu, expected)
    finally:
        file.write_bytes(kept)


DRAWN = {
    "segmentation": segmentation(
        grid(), {"lung": blob(grid(), (7, 11), (1, 9), (1, 7)), "nodule": blob(grid(), (2, 5), (3, 6), (2, 4))}
    ),
    "structures": structures({"nodule": [rectangle(grid(), (2, 5), (3, 6), 2)]}),
}
WHERE_DRAWN = [(name, place) for name, ds in DRAWN.items() for place in places(ds)]


@pytest.fixture(scope="module")
def drawn(tmp_path_factory) -> dict[str, tuple[Path, np.ndarray]]:
    """File of each set of regions and its labels."""
    files = {name: tmp_path_factory.mktemp("drawn") / "drawn.dcm" for name in DRAWN}
    for name, file in files.items():
        file.write_bytes(encoded(DRAWN[name]))
    return {name: (file, read_regions(file, grid(), FRAME).values) for name, file in files.items()}


@BOUNDED
@given(where=st.sampled_from(WHERE_DRAWN), how=HOW)
def test_a_malformed_value_of_a_region_is_refused_or_does_no_harm(drawn, where, how):
    name, place = where
    file, expected = drawn[name]
    file.write_bytes(malformed(DRAWN[name], place, how))
    check(lambda: read_regions(file, grid(), FRAME).values, expected)


@pytest.mark.parametrize(
    "syntax", [b"", b"1.2.840.10008.1.2.9\0", b"1.2.840.10008.1.2\0\0\0", b"\xff" * 20, b"1.2.840.10008.5.1.4\0"]
)
def test_a_malformed_transfer_syntax_is_refused(images, syntax):
    """Of which one is another syntax than the file has."""
    folder, expected = images["slices"]
    file = folder / "IM003"
    kept = file.read_bytes()
    stated = b"UI\x14\0" + b"1.2.840.10008.1.2.1\0"
    assert kept.count(stated) == 1
    try:
        file.write_bytes(kept.replace(stated, b"UI" + struct.pack("<H", len(syntax)) + syntax))
        check(lambda: read_volume(folder).hu, expected)
    finally:
        file.write_bytes(kept)
