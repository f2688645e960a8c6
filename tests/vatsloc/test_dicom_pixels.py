"""Pixels of DICOM files: every compression, sign, bits, padding and table, down to the last HU."""

from __future__ import annotations

from pathlib import Path

import cv2
import gdcm
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from pydicom.dataset import Dataset
from pydicom.encaps import encapsulate, generate_frames
from pydicom.sequence import Sequence
from pydicom.uid import HTJ2KLossless, JPEGBaseline8Bit, RLELossless

from tests.vatsloc.dicom_made import NK, compressed, ct_slice, enhanced, save
from vatsloc.errors import InputRefused
from vatsloc.formats.dicom import PADDING_HU
from vatsloc.formats.dicom.pixels import _undecodable
from vatsloc.formats.images import read_volume, read_volume_and_warnings

T = gdcm.TransferSyntax
LOSSLESS = {
    "JPEG Lossless": T.JPEGLosslessProcess14,
    "JPEG Lossless SV1": T.JPEGLosslessProcess14_1,
    "JPEG-LS": T.JPEGLSLossless,
    "JPEG-LS near": T.JPEGLSNearLossless,  # this encoder loses nothing
    "JPEG 2000 lossless": T.JPEG2000Lossless,
    "JPEG 2000": T.JPEG2000,  # this encoder loses nothing
}
SHAPE = (24, 19)


def slices_of(hu: np.ndarray, signed: bool, bits: int) -> list[Dataset]:
    """hu: (slices, rows, columns), stored as HU if signed, else as HU + 1024."""
    found = []
    for k, plane in enumerate(hu):
        ds = ct_slice(np.eye(3), k, intercept=0 if signed else -1024)
        ds.Rows, ds.Columns = plane.shape
        ds.BitsStored, ds.HighBit, ds.PixelRepresentation = bits, bits - 1, int(signed)
        ds.PixelData = (plane + (0 if signed else 1024)).astype("<u2").tobytes()
        found.append(ds)
    return found


def noise(low: int, high: int) -> np.ndarray:
    hu = np.random.default_rng(7).integers(low, high + 1, (3, *SHAPE))
    hu[:, 0, 0], hu[:, -1, -1] = low, high
    return hu


def read(folder: Path, slices: list[Dataset]) -> np.ndarray:
    """(slices, rows, columns)."""
    return read_volume(save(folder, slices)).hu.T


@pytest.mark.parametrize("syntax", [*LOSSLESS, "RLE"])
def test_compressed_slices_are_read_to_the_last_hu(tmp_path, syntax):
    """Each slice of another sign or number of bits.

    The last one comes without its sign, from a program that compressed 12 bits as they lay in memory. Ref: pydicom
    issue 1149.
    """
    kinds = [(True, 16, noise(-32768, 32767)), (True, 12, noise(-2048, 2047)), (False, 16, noise(-1024, 64511))]
    kinds += [(False, 12, noise(-1024, 3071)), (True, 12, noise(-2048, 2047))]
    hu = np.stack([kind[2][k % 3] for k, kind in enumerate(kinds)])
    slices = [slices_of(hu, signed, bits)[k] for k, (signed, bits, _) in enumerate(kinds)]
    slices[-1].PixelRepresentation, slices[-1].PixelData = 0, (hu[-1] & 0xFFF).astype("<u2").tobytes()
    for ds in slices:
        if syntax == "RLE":
            ds.compress(RLELossless, generate_instance_uid=False)
        else:
            compressed(ds, LOSSLESS[syntax], tmp_path)
    slices[-1].PixelRepresentation = 1
    assert_array_equal(read(tmp_path / "ct", slices), hu)


def test_compressed_multi_frame_file_is_read(tmp_path):
    ds = enhanced(np.eye(3), list(range(NK)))
    expected = read_volume(save(tmp_path / "plain", [ds])).hu
    compressed(ds, LOSSLESS["JPEG Lossless SV1"], tmp_path)
    assert_array_equal(read_volume(save(tmp_path / "packed", [ds])).hu, expected)


def test_unsigned_words_of_signed_pixels_are_read_uncompressed_too(tmp_path):
    hu = noise(-2048, 2047)
    assert_array_equal(read(tmp_path / "ct", slices_of(hu & 0xFFF, True, 12)), hu)


def test_bits_above_those_stored_are_refused(tmp_path):
    slices = slices_of(noise(-1024, 3071), False, 12)
    slices[1].PixelData = (np.frombuffer(slices[1].PixelData, "<u2") | 0x8000).tobytes()
    with pytest.raises(InputRefused, match=r"IM001 has pixels from 32768 to 36863, 0 to 4095 by its BitsStored"):
        read(tmp_path / "ct", slices)


def test_of_what_a_decoder_said_the_last_line_is_told() -> None:
    told = str(_undecodable(None, "tried two decoders:\nthe stream is cut short.\n", Path("IM7")))
    assert told.startswith("IM7 has pixels that cannot be decoded")
    assert ": the stream is cut short); export it" in told
    assert "tried" not in told
    assert "no reason given" in str(_undecodable(None, " \n", Path("IM7")))


def test_unknown_compression_is_refused_with_its_name(tmp_path):
    slices = slices_of(noise(0, 9), True, 16)
    compressed(slices[1], LOSSLESS["JPEG 2000 lossless"], tmp_path).file_meta.TransferSyntaxUID = HTJ2KLossless
    with pytest.raises(
        InputRefused, match=r"IM001 has pixels that cannot be decoded \(transfer syntax High-Throughput .* export it un"
    ):
        read(tmp_path / "ct", slices)


@pytest.mark.parametrize("at", [6, 15, 40, -200], ids=["precision", "segment", "Huffman table", "cut short"])
def test_damaged_streams_end_the_decoder_but_not_the_run(tmp_path, at):
    """GDCM aborts at the second of these, and reads where it must not at the first."""
    slices = slices_of(noise(-1000, 1000), True, 16)
    for ds in slices:
        compressed(ds, LOSSLESS["JPEG Lossless SV1"], tmp_path)
    stream = bytearray(next(generate_frames(slices[1].PixelData, number_of_frames=1)))
    if at > 0:
        stream[at] = 200
    slices[1].PixelData = encapsulate([bytes(stream if at > 0 else stream[:at])])
    with pytest.raises(InputRefused, match=r"IM001 has pixels that cannot be decoded .*JPEG Lossless.*export it"):
        read(tmp_path / "ct", slices)


@pytest.mark.parametrize("length", [-1, 1])
def test_uncompressed_pixels_of_another_length_are_refused(tmp_path, length):
    slices = slices_of(noise(-1000, 1000), True, 16)
    row = b"\0" * 2 * SHAPE[1]
    slices[1].PixelData = slices[1].PixelData + row if length > 0 else slices[1].PixelData[: -len(row)]
    with pytest.raises(InputRefused, match=r"IM001 has pixels that cannot be decoded \(\d+ bytes, 912 needed\)"):
        read(tmp_path / "ct", slices)


def test_loss_by_compression_is_said(tmp_path):
    slices = slices_of(noise(-1000, 1000), True, 16)
    for ds in slices:
        ds.LossyImageCompression = "01"
    warnings = read_volume_and_warnings(save(tmp_path / "ct", slices))[1]
    assert warnings == ("ct: its grey values were compressed with loss, so small detail may be missing.",)


PADDED = {
    "signed": (True, 16, -2000, "SS"),
    "signed, written as unsigned": (True, 16, 63536, "US"),
    "signed 12 bits, written as unsigned": (True, 12, 2096, "US"),
    "unsigned": (False, 16, 63536, "US"),
    "unsigned, written as signed": (False, 16, -2000, "SS"),
    "unsigned, beyond its bits": (False, 12, 63536, "US"),
}


@pytest.mark.parametrize("case", PADDED)
def test_padding_of_either_sign_becomes_air(tmp_path, case):
    signed, bits, value, vr = PADDED[case]
    hu = noise(-1000, 1000)
    slices = slices_of(hu, signed, bits)
    words = np.frombuffer(slices[1].PixelData, "<i2").reshape(SHAPE).copy()
    words[2:5, 7] = -2000
    slices[1].PixelData = words.tobytes()
    slices[1].add_new(0x00280120, vr, value)
    expected = hu.copy()
    expected[1, 2:5, 7] = PADDING_HU
    assert_array_equal(read(tmp_path / "ct", slices), expected)


@pytest.mark.parametrize(("value", "limit"), [(-2000, -1990), (-1990, -2000)])
def test_a_range_of_padding_becomes_air(tmp_path, value, limit):
    hu = noise(-1000, 1000)
    slices = slices_of(np.where(hu < -900, hu - 1092 + 1, hu), True, 16)
    slices[0].PixelPaddingValue, slices[0].PixelPaddingRangeLimit = value, limit
    got = read(tmp_path / "ct", slices)
    shifted = np.where(hu < -900, hu - 1091, hu)
    padded = (shifted >= -2000) & (shifted <= -1990)
    padded[1:] = False
    assert padded.any()
    assert_array_equal(got, np.where(padded, PADDING_HU, shifted))


def test_padding_that_reads_as_tissue_is_believed_at_the_edge_alone(tmp_path):
    hu = noise(400, 1000)
    hu[:, 10:12, 10:12] = 0
    hu[:, :3, :3] = 0
    slices = slices_of(hu, True, 16)
    for ds in slices:
        ds.PixelPaddingValue = 0
    expected = hu.copy()
    expected[:, :3, :3] = PADDING_HU
    assert_array_equal(read(tmp_path / "ct", slices), expected)


def lut(ds: Dataset, first: int, entries: np.ndarray, kind: str, vr: str) -> None:
    item = Dataset()
    n = len(entries) % 65536
    item.add_new(0x00283002, "SS" if first < 0 else "US", [n, first, 16])
    item.ModalityLUTType = kind
    words = entries.astype("<u2")
    item.add_new(0x00283006, vr, words.tobytes() if vr == "OW" else words.tolist())
    ds.ModalityLUTSequence = Sequence([item])
    del ds.RescaleSlope, ds.RescaleIntercept


@pytest.mark.parametrize("vr", ["US", "OW"])
def test_modality_lut_in_hu(tmp_path, vr):
    stored = noise(0, 500)
    slices = slices_of(stored, True, 16)
    table = np.arange(601) ** 2 // 100 - 1024
    for ds in slices:
        ds.PixelRepresentation = 0
        lut(ds, 0, table, "HU", vr)
    assert_array_equal(read(tmp_path / "ct", slices), table[stored])


def test_modality_lut_from_a_negative_value_holds_its_ends(tmp_path):
    stored = noise(-150, 150)
    slices = slices_of(stored, True, 16)
    table = np.arange(201) * 3
    for ds in slices:
        lut(ds, -100, table, "US", "OW")
    assert_array_equal(read(tmp_path / "ct", slices), table[np.clip(stored + 100, 0, 200)])


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda ds: delattr(ds, "RescaleIntercept"), "states RescaleSlope but no RescaleIntercept"),
        (lambda ds: delattr(ds, "RescaleSlope"), "states RescaleIntercept but no RescaleSlope"),
        (lambda ds: setattr(ds, "RescaleSlope", -1), "a positive slope"),
        (lambda ds: setattr(ds, "RescaleSlope", 1e6), "a positive slope"),
        (lambda ds: setattr(ds, "RescaleIntercept", -1e6), "a positive slope"),
        (lambda ds: setattr(ds, "RescaleType", "Z_EFF"), "RescaleType = Z_EFF, HU needed"),
        (lambda ds: setattr(ds, "HighBit", 11), "HighBit = 11, a whole number from 15 to 15"),
        (lambda ds: setattr(ds, "PhotometricInterpretation", "PALETTE COLOR"), "MONOCHROME2 needed"),
    ],
)
def test_what_is_not_hu_is_refused(tmp_path, change, sentence):
    slices = slices_of(noise(-1000, 1000), True, 16)
    change(slices[1])
    with pytest.raises(InputRefused, match=f"IM001 states .*{sentence}|IM001 {sentence}"):
        read(tmp_path / "ct", slices)


def test_jpeg_of_8_bits_is_read_within_its_loss(tmp_path):
    grey = np.tile(np.linspace(0, 255, SHAPE[1]), (SHAPE[0], 1)).astype(np.uint8)
    slices = slices_of(np.zeros((3, *SHAPE), int), False, 16)
    for ds in slices:
        ds.BitsAllocated, ds.BitsStored, ds.HighBit, ds.RescaleSlope = 8, 8, 7, 8
        ds.file_meta.TransferSyntaxUID = JPEGBaseline8Bit
        ds.PixelData = encapsulate([cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()])
    assert np.abs(read(tmp_path / "ct", slices) - (grey * 8.0 - 1024)).max() <= 3 * 8


def test_jpeg_of_12_bits_with_loss_is_refused_with_its_name(tmp_path):
    slices = slices_of(noise(-1024, 3071), False, 12)
    for ds in slices:
        compressed(ds, T.JPEGExtendedProcess2_4, tmp_path)
    with pytest.raises(InputRefused, match=r"IM000 .*JPEG Extended .*12-bit precision\); export it uncompressed"):
        read(tmp_path / "ct", slices)
