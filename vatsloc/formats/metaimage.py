"""MetaImage (.mha, .mhd): a text header in LPS, then raw or zlib-compressed voxels.

Ref: MetaIO file format; Offset is the centre of the first voxel, TransformMatrix holds one voxel axis after the other.
"""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np

from registration.volume import Array
from vatsloc.errors import InputRefused
from vatsloc.formats.guard import guarded
from vatsloc.formats.raw import RawImage, by, check_size
from vatsloc.frames import flip_affine

_TYPES = {
    "MET_CHAR": "i1",
    "MET_UCHAR": "u1",
    "MET_SHORT": "i2",
    "MET_USHORT": "u2",
    "MET_INT": "i4",
    "MET_UINT": "u4",
    "MET_LONG_LONG": "i8",
    "MET_ULONG_LONG": "u8",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}
_MAX_HEADER_BYTES = 65536
_YES, _NO = ("true", "t", "1"), ("false", "f", "0")
MAX_LENGTH_ERROR = 1e-3
"""How far from 1 an axis of the TransformMatrix may be; the voxel size is stated apart."""


@guarded("MetaImage")
def read_metaimage(path: Path) -> RawImage:
    """Image of a .mha or .mhd file. Raises InputRefused when it is unreadable or its place in space is not stated."""
    header, header_bytes = read_header(path)
    n_axes = _whole(header, "NDims", path, 1)[0]
    if n_axes not in (3, 4):
        raise InputRefused(f"{path} has {n_axes} axes, not 3; export a single volume.")
    if "ElementNumberOfChannels" in header and _whole(header, "ElementNumberOfChannels", path, 1)[0] != 1:
        raise InputRefused(f"{path} has several channels per voxel; export grey values.")
    if header.get("ElementType", "") not in _TYPES:
        raise InputRefused(
            f"{path} has ElementType {header.get('ElementType', 'missing')}; export it as MET_SHORT or MET_FLOAT."
        )
    shape = _whole(header, "DimSize", path, n_axes)
    order = "BinaryDataByteOrderMSB" if "BinaryDataByteOrderMSB" in header else "ElementByteOrderMSB"
    dtype = np.dtype(_TYPES[header["ElementType"]]).newbyteorder(">" if _flag(header, order, path) else "<")
    data = _data(header, header_bytes, path, shape, dtype.itemsize)
    values = np.frombuffer(data, dtype).reshape(shape, order="F").astype(dtype.newbyteorder("="), copy=False)
    return RawImage(values, _ras_from_ijk(header, n_axes, path), path)


def read_header(path: Path) -> tuple[dict[str, str], int]:
    """Keys and values of the header, and its length in bytes; ElementDataFile ends it."""
    header: dict[str, str] = {}
    try:
        with path.open("rb") as file:
            while "ElementDataFile" not in header and file.tell() < _MAX_HEADER_BYTES:
                line = file.readline(_MAX_HEADER_BYTES)
                key, equals, value = line.decode("ascii").partition("=")
                if not equals:
                    break
                if key.strip() in header:
                    raise InputRefused(f"{path} states {key.strip()} twice; export it again.")
                header[key.strip()] = value.strip()
            length = file.tell()
    except (OSError, UnicodeDecodeError) as error:
        raise InputRefused(f"{path} is not a readable MetaImage ({error}); export it again.") from error
    if "ElementDataFile" not in header:
        raise InputRefused(f"{path} is not a readable MetaImage (no ElementDataFile in its header); export it again.")
    return header, length


def data_file(path: Path, header: dict[str, str]) -> Path:
    """The file with the voxels: the image itself, or its neighbour that the header names."""
    name = header["ElementDataFile"]
    return path if name.upper() == "LOCAL" else path.parent / name


def _data(header: dict[str, str], header_bytes: int, path: Path, shape: list[int], itemsize: int) -> bytes:
    source, compressed = data_file(path, header), _flag(header, "CompressedData", path)
    if not _flag(header, "BinaryData", path, True) or "%" in source.name or source.name.upper() == "LIST":
        raise InputRefused(f"{path} keeps its voxels as text or slice by slice; export it as one binary file.")
    if not source.is_file():
        raise InputRefused(f"{source}, named by {path.name}, cannot be read; put it beside the header.")
    skipped = _whole(header, "HeaderSize", path, 1)[0] if source != path and "HeaderSize" in header else 0
    start = header_bytes if source == path else max(skipped, 0)
    n_bytes = check_size(shape, itemsize, source.stat().st_size - start, source, compressed)
    data = source.read_bytes()
    data = data[-n_bytes:] if skipped == -1 else data[start:]  # -1: whatever precedes the voxels
    if compressed:
        try:
            data = zlib.decompressobj().decompress(data, n_bytes + 1)
        except zlib.error as error:
            raise InputRefused(f"{source} cannot be decompressed ({error}); export it again.") from error
    if len(data) != n_bytes:
        got = f"more than {n_bytes}" if compressed and len(data) > n_bytes else str(len(data))
        raise InputRefused(f"{source} holds {got} bytes of voxels, {n_bytes} needed; copy or export it again.")
    return data


def _ras_from_ijk(header: dict[str, str], n_axes: int, path: Path) -> Array:
    offset = next((key for key in ("Offset", "Position", "Origin") if key in header), None)
    matrix = next((key for key in ("TransformMatrix", "Rotation", "Orientation") if key in header), None)
    if offset is None or matrix is None:
        raise InputRefused(f"{path} states no TransformMatrix or no Offset; export it with its position in space.")
    units = header.get("DistanceUnits", "mm").lower()
    if units not in ("mm", "?"):
        raise InputRefused(f"{path} is in {units}, not mm; export it in millimetres.")
    size = "ElementSpacing" if "ElementSpacing" in header else "ElementSize"
    spacing = _numbers(header, size, path, n_axes)[:3]
    if not (np.isfinite(spacing) & (spacing > 0)).all():
        raise InputRefused(f"{path} has {size} = {header[size]}, sizes above 0 needed; export it again.")
    axes = _numbers(header, matrix, path, n_axes * n_axes).reshape(n_axes, n_axes)[:3, :3]
    lengths = np.linalg.norm(axes, axis=1)
    if np.isfinite(lengths).all() and np.abs(lengths - 1).max() > MAX_LENGTH_ERROR:
        raise InputRefused(
            f"{path} has a {matrix} with axes of length {by(lengths)}, 1 needed, beside {size} = {header[size]}; "
            "export it with the voxel size stated once."
        )
    lps_from_ijk = np.eye(4)
    lps_from_ijk[:3, :3] = axes.T * spacing
    lps_from_ijk[:3, 3] = _numbers(header, offset, path, n_axes)[:3]
    return flip_affine(lps_from_ijk)


def _numbers(header: dict[str, str], key: str, path: Path, n: int) -> Array:
    try:
        values = np.array([float(v) for v in header[key].split()])
    except (KeyError, ValueError):
        values = np.empty(0)
    if values.shape != (n,):
        raise InputRefused(
            f"{path} has {key} = {header.get(key, 'missing') or 'nothing'}, {n} numbers needed; export it again."
        )
    return values


def _whole(header: dict[str, str], key: str, path: Path, n: int) -> list[int]:
    values = _numbers(header, key, path, n)
    if not np.isfinite(values).all() or (values != np.rint(values)).any():
        raise InputRefused(f"{path} has {key} = {header[key]}, whole numbers needed; export it again.")
    return [int(v) for v in values]


def _flag(header: dict[str, str], key: str, path: Path, default: bool = False) -> bool:
    """Whether a key says yes."""
    said = header.get(key, str(default)).lower()
    if said not in (*_YES, *_NO):
        raise InputRefused(f"{path} has {key} = {header[key] or 'nothing'}, True or False needed; export it again.")
    return said in _YES
