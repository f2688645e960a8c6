"""Stored pixels of DICOM files, and what they are in HU.

Compressed pixels are decoded by GDCM in a process of its own (`decoder`), since a damaged stream can end it.
Ref: DICOM PS3.3, C.7.5.1.1.2 (padding), C.7.6.3 (pixels), C.11.1 (modality LUT and rescale).
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from pydicom.uid import UID, RLELossless
from scipy import ndimage

from registration.volume import Array
from vatsloc.errors import InputRefused
from vatsloc.formats.dicom.decoder import decode
from vatsloc.formats.dicom.header import Header, read_header

PADDING_HU = -1024.0
"""Stands in for voxels outside the reconstruction circle, which carry no measurement."""
TISSUE_HU = (-300.0, 300.0)
"""A padding value that reads as tissue is believed only in regions that touch the edge of the slice."""
_NOT_HU = ("OD", "MGML", "Z_EFF", "ED", "EDW", "PCT")
"""Rescale types of other quantities: density of an image, of a material, atomic number. Ref: PS3.3, C.11.1.1.2."""


@dataclass(frozen=True)
class Scale:
    """From stored pixels to HU: by the table if there is one, then slope * pixels + intercept.

    table: (n,) float32 for stored values from `first`; padding: lowest and highest stored value without meaning;
    stated: by which of its attributes, "" where there is none and pixels are taken for HU.
    """

    slope: float
    intercept: float
    table: Array | None
    first: int
    padding: tuple[int, int] | None
    stated: str

    def __call__(self, stored: Array) -> Array:
        """HU, float32, of whole numbers as stored, (rows, columns)."""
        hu = self._measured(stored)
        if self.padding is not None:
            padded = (stored >= self.padding[0]) & (stored <= self.padding[1])
            if padded.any():
                reads = self._measured(np.array(self.padding, dtype=stored.dtype))
                if reads.max() >= TISSUE_HU[0] and reads.min() <= TISSUE_HU[1]:
                    padded = _touching_edge(padded)
                hu[padded] = PADDING_HU
        return hu

    def _measured(self, stored: Array) -> Array:
        if self.table is not None:
            index = np.clip(stored.astype(np.int64) - self.first, 0, len(self.table) - 1)
            return self.table[index]
        return np.asarray(stored * np.float32(self.slope) + np.float32(self.intercept), dtype=np.float32)


def scale_of(header: Header, rescale: Header) -> Scale:
    """Scale of a file whose rescale lies in `rescale`, the header itself or a functional group.

    Raises InputRefused for a slope without an intercept, one that is not positive, and quantities other than HU.
    """
    if ("RescaleSlope" in rescale) != ("RescaleIntercept" in rescale):
        there, absent = sorted(("RescaleSlope", "RescaleIntercept"), key=lambda name: name not in rescale)
        raise InputRefused(f"{header.file} states {there} but no {absent}; export it again with its rescale to HU.")
    slope, intercept = rescale.number("RescaleSlope", 1.0), rescale.number("RescaleIntercept", 0.0)
    if not (0 < slope < 1e6 and abs(intercept) < 1e6):
        found = f"{slope:g} with RescaleIntercept = {intercept:g}"
        raise rescale.wrong("RescaleSlope", found, "a positive slope and an intercept below a million")
    kind = rescale.text("RescaleType").strip().upper()
    if kind in _NOT_HU:
        raise rescale.wrong("RescaleType", kind, "HU")
    table, first = _table(header)
    by = "RescaleSlope" if "RescaleSlope" in rescale else ""
    return Scale(slope, intercept, table, first, _padding(header), by if table is None else "ModalityLUTSequence")


def check_pixels(header: Header) -> None:
    """Raise InputRefused unless the attributes that say how pixels are stored are there and agree."""
    header.whole("Rows", 1, 65535)
    header.whole("Columns", 1, 65535)
    header.whole("SamplesPerPixel", 1, 1)
    header.whole("PixelRepresentation", 0, 1)
    allocated = header.whole("BitsAllocated", 1, 32)
    if allocated not in (8, 16, 32):
        raise header.wrong("BitsAllocated", allocated, "8, 16 or 32")
    stored = header.whole("BitsStored", 1, allocated)
    header.whole("HighBit", stored - 1, stored - 1)
    if header.text("PhotometricInterpretation") not in ("MONOCHROME1", "MONOCHROME2"):
        raise header.wrong("PhotometricInterpretation", header.text("PhotometricInterpretation"), "MONOCHROME2")


def stored_pixels(headers: Sequence[Header]) -> Iterator[Array]:
    """Pixels of each file in turn, whole numbers with their sign, (frames, rows, columns).

    Raises InputRefused for pixels that cannot be decoded, are cut short or do not fit what their header says.
    """
    compressed = [header for header in headers if _needs_process(header)]
    decoded = _decoded_apart([header.file for header in compressed])
    for header in headers:
        raw = next(decoded) if _needs_process(header) else _decoded_here(header)
        n = header.whole("NumberOfFrames", 1, 100_000, 1)
        shape = (n, header.whole("Rows", 1, 65535), header.whole("Columns", 1, 65535))
        if raw.size != np.prod(shape) or raw.dtype.kind not in "iu":
            raise InputRefused(f"{header.file} has pixels of shape {raw.shape}, {shape} needed; export it again.")
        yield _signed(raw.reshape(shape), header)


def _syntax(header: Header) -> UID:
    meta = getattr(header.dataset, "file_meta", None)
    syntax = None if meta is None else Header(meta, header.file).text("TransferSyntaxUID")
    if not syntax:
        raise InputRefused(f"{header.file} states no TransferSyntaxUID; export it again with its whole header.")
    return UID(syntax)


def _needs_process(header: Header) -> bool:
    syntax = _syntax(header)
    try:
        return bool(syntax.is_encapsulated) and syntax != RLELossless
    except ValueError as error:  # no transfer syntax at all, or a private one
        raise _undecodable(header, "it is not known") from error


def _decoded_here(header: Header) -> Array:
    whole = read_header(header.file, pixels=True)
    if whole is None or "PixelData" not in whole:
        raise InputRefused(f"{header.file} holds no PixelData; copy or export it again.")
    try:
        syntax = _syntax(header)
        if not syntax.is_encapsulated:
            _check_length(whole)
        return decode(whole.dataset)
    except InputRefused:
        raise
    except Exception as error:
        raise _undecodable(header, str(error)) from error


def _check_length(header: Header) -> None:
    """Raise InputRefused unless the uncompressed pixels have the very size that the header states."""
    sizes = [header.whole(name, 1, 2**31, 1) for name in ("NumberOfFrames", "Rows", "Columns", "BitsAllocated")]
    needed = -(-int(np.prod(sizes, dtype=np.int64)) // 8)
    length = len(header.value("PixelData") or b"")
    if length not in (needed, needed + needed % 2):
        raise InputRefused(
            f"{header.file} has pixels that cannot be decoded ({length} bytes, {needed} needed); "
            "copy or export it again."
        )


def _decoded_apart(files: list[Path]) -> Iterator[Array]:
    if not files:
        return
    command = [sys.executable, "-P", str(Path(__file__).with_name("decoder.py"))]
    with tempfile.TemporaryFile() as asked:
        asked.write(json.dumps([str(file) for file in files]).encode())
        asked.seek(0)
        with subprocess.Popen(command, stdin=asked, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
            assert process.stdout is not None
            try:
                for file in files:
                    yield _answer(process.stdout, file)
            finally:
                process.kill()


def _answer(stream: IO[bytes], file: Path) -> Array:
    line = stream.readline()
    told: dict[str, Any] = json.loads(line) if line.endswith(b"\n") else {"error": "its stream is damaged"}
    pixels = stream.read(told.get("bytes", 0))
    if "error" in told or len(pixels) < told["bytes"]:
        raise _undecodable(read_header(file), told.get("error", "its stream is damaged"), file)
    return np.frombuffer(pixels, told["dtype"]).reshape(told["shape"])


def _undecodable(header: Header | None, reason: str, file: Path | None = None) -> InputRefused:
    syntax = _syntax(header) if header is not None else UID("")
    first = (reason.strip().splitlines() or ["no reason given"])[-1].strip().rstrip(".")
    name = f"{syntax.name}, {syntax}" if syntax.name != syntax else f"{syntax}"
    return InputRefused(
        f"{file or (header and header.file)} has pixels that cannot be decoded (transfer syntax {name}: {first}); "
        "export it uncompressed or as JPEG Lossless."
    )


def _signed(raw: Array, header: Header) -> Array:
    """Pixels with the sign that their header states.

    Signed pixels of fewer bits often come without it, as the decoder of another program left them. Bits above those
    that are stored mean nothing else, but for the padding value. Raises InputRefused where they are set.
    """
    bits, allocated = header.whole("BitsStored", 1, 32), header.whole("BitsAllocated", 1, 32)
    if allocated == 1:
        return raw
    signed = header.whole("PixelRepresentation", 0, 1) == 1
    if raw.dtype.itemsize * 8 != allocated or (raw.dtype.kind == "i") != signed:
        raise header.wrong("BitsAllocated", allocated, f"{raw.dtype.itemsize * 8} by its pixels")
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    if raw.min() >= low and raw.max() <= high:
        return raw
    least, most = _padding(header) or (1, 0)
    padded = (raw >= least) & (raw <= most)
    if padded.all():
        return raw
    lowest, highest = int(raw[~padded].min()), int(raw[~padded].max())
    if signed and lowest >= 0 and highest < 1 << bits:
        return np.where(~padded & (raw > high), raw.astype(np.int32) - (1 << bits), raw)
    if lowest < low or highest > high:
        raise InputRefused(
            f"{header.file} has pixels from {lowest} to {highest}, {low} to {high} by its BitsStored = {bits}; "
            "export it again."
        )
    return raw


def _padding(header: Header) -> tuple[int, int] | None:
    """Lowest and highest stored value that is padding, in the sign of the pixels whatever sign it is written with."""
    if "PixelPaddingValue" not in header:
        return None
    limit = 2**31
    value = header.whole("PixelPaddingValue", -limit, 2 * limit)
    other = header.whole("PixelPaddingRangeLimit", -limit, 2 * limit, value)
    signed = header.whole("PixelRepresentation", 0, 1) == 1
    bits, allocated = header.whole("BitsStored", 1, 32), header.whole("BitsAllocated", 8, 32)
    wrapped = []
    for v in (value, other):
        size = 1 << (bits if 0 <= v < 1 << bits else allocated)
        wrapped.append(v % size - (size if signed and v % size >= size // 2 else 0))
    return min(wrapped), max(wrapped)


def _table(header: Header) -> tuple[Array | None, int]:
    """Modality LUT as float32 and the stored value of its first entry; None where there is none.

    Entries of a table in HU are taken as signed, since the standard lets them be and no tissue has 32768 HU.
    """
    items = header.items("ModalityLUTSequence")
    if not items:
        return None, 0
    item = items[0]
    n, first, bits = (int(v) for v in item.numbers("LUTDescriptor", 3))
    n = n % 65536 or 65536
    if bits not in (8, 16):
        raise item.wrong("LUTDescriptor", f"{bits} bits an entry", "8 or 16")
    data = item.value("LUTData")
    if isinstance(data, bytes):  # written as OW
        if len(data) != 2 * n:
            raise item.wrong("LUTData", f"{len(data)} bytes", f"{2 * n} by its LUTDescriptor")
        data = np.frombuffer(data, "<u2" if header.dataset.original_encoding[1] is not False else ">u2")
    entries = np.atleast_1d(np.asarray(data if data is not None else [], dtype=np.int64))
    if entries.shape != (n,):
        raise item.wrong("LUTData", f"{entries.size} entries", f"{n} by its LUTDescriptor")
    kind = item.text("ModalityLUTType").strip().upper()
    if kind not in ("HU", "US"):
        raise item.wrong("ModalityLUTType", kind or "nothing", "HU or US")
    if kind == "HU":
        entries = np.where(entries >= 32768, entries - 65536, entries)
    if header.whole("PixelRepresentation", 0, 1) == 1 and first >= 32768:
        first -= 65536
    return entries.astype(np.float32), first


def _touching_edge(region: Array) -> Array:
    """Parts of a region in a slice, (rows, columns), that touch its edge."""
    parts, _ = ndimage.label(region)
    at_edge = np.unique(np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]]))
    return np.asarray(np.isin(parts, at_edge[at_edge > 0]))
