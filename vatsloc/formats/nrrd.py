"""NRRD images: "space" names the frame, "space directions" and "space origin" place voxels in it.

Slicer keeps segmentations in the same format (.seg.nrrd): label images whose header names the segments; those that
overlap lie in layers along one more axis.
Ref: Kindlmann 2005, Definition of NRRD file format; Slicer developer guide, Segmentation labelmap file format.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import nrrd
import numpy as np

from registration.volume import Array
from vatsloc.errors import InputRefused
from vatsloc.formats.guard import guarded
from vatsloc.formats.raw import RawImage, Segment, check_affine, check_size, check_voxel_size

_SIGNS_TO_RAS = {
    "right-anterior-superior": (1, 1, 1),
    "left-anterior-superior": (-1, 1, 1),
    "left-posterior-superior": (-1, -1, 1),
}
_LONG_NAME = {"RAS": "right-anterior-superior", "LAS": "left-anterior-superior", "LPS": "left-posterior-superior"}
_DATA_FILE = ("data file", "datafile")


@guarded("NRRD image")
def read_nrrd(path: Path) -> RawImage:
    """Image or segmentation of a .nrrd or .nhdr file.

    Raises InputRefused when it is unreadable or states no anatomical frame in mm.
    """
    values, header = _values_and_header(path)
    signs = _signs_to_ras(header, path)
    if "space directions" not in header or "space origin" not in header:
        raise InputRefused(
            f"{path} states no space directions or no space origin; export it with its position in space."
        )
    units = {str(u).strip('"') for u in header.get("space units", [])} - {"mm", "", "???"}
    if units:
        raise InputRefused(f"{path} is in {', '.join(sorted(units))}, not mm; export it in millimetres.")
    directions = np.array([np.full(3, np.nan) if d is None else d for d in header["space directions"]], dtype=float)
    spatial = ~np.isnan(directions).all(axis=1)
    origin = np.asarray(header["space origin"], dtype=float)
    if directions.shape != (values.ndim, 3) or spatial.sum() != 3 or origin.shape != (3,):
        raise InputRefused(
            f"{path} has {values.ndim} axes, space directions for {len(directions)}, {spatial.sum()} of them in space, "
            f"and an origin of {origin.size} numbers; export a single volume with 3 of each."
        )
    affine = _affine(directions[spatial], origin, signs)
    # Non-spatial axes go last, where an axis of length one is dropped.
    values = np.moveaxis(values, np.flatnonzero(spatial), (0, 1, 2))
    spacings = np.asarray(header.get("spacings", []), dtype=float)
    if "spacings" in header and np.isfinite(spacings).any():
        check_affine(affine, path)
        by_axis = spacings[spatial] if spacings.shape == spatial.shape else np.full(3, np.nan)
        check_voxel_size(by_axis, affine, values.shape, "spacings", path)
    return RawImage(values, affine, path, _segments(header, path))


def nrrd_data_file(path: Path) -> Path:
    """The file with the voxels: the image itself, or the one that a detached header names."""
    with path.open("rb") as file:
        return _data_file(path, nrrd.read_header(file))


def _data_file(path: Path, header: Mapping[str, Any]) -> Path:
    named = next((str(header[key]) for key in _DATA_FILE if key in header), None)
    source = path if named is None else path.parent / named
    if not source.is_file():
        raise InputRefused(f"{source}, named by {path.name}, cannot be read; put it beside the header.")
    return source


def _values_and_header(path: Path) -> tuple[Array, dict[str, Any]]:
    with path.open("rb") as file:
        header = dict(nrrd.read_header(file))
        source, start = _data_file(path, header), file.tell()
        inside = {key: value for key, value in header.items() if key not in _DATA_FILE}
        stored = source.stat().st_size - (start if source == path else 0)
        deflated = header["encoding"] in ("gzip", "gz")
        limit = np.inf if header["encoding"] in ("bzip2", "bz2") else stored
        check_size(header["sizes"], 1, limit, path, deflated)
        if source == path:
            return nrrd.read_data(inside, file), header
    with source.open("rb") as file:
        return nrrd.read_data(inside, file), header


def _signs_to_ras(header: Mapping[str, Any], path: Path) -> tuple[int, int, int]:
    space = str(header.get("space", ""))
    name = _LONG_NAME.get(space.upper(), space.lower()).removesuffix("-time")
    if name not in _SIGNS_TO_RAS:
        got = f'space "{space}"' if space else "no space"
        raise InputRefused(
            f"{path} states {got}; export it with space left-posterior-superior or another patient frame."
        )
    return _SIGNS_TO_RAS[name]


def _segments(header: Mapping[str, Any], path: Path) -> tuple[Segment, ...]:
    """Segments of a Slicer segmentation; where none has a value, as in Slicer 4.10, each is a layer of its own.

    Raises InputRefused where two have the same value in one layer, so that their voxels cannot be told apart.
    """
    numbers = sorted({int(found[1]) for key in header if (found := re.fullmatch(r"Segment(\d+)_\w+", key))})
    stated = any(f"Segment{n}_LabelValue" in header for n in numbers)
    segments = tuple(
        Segment(
            label=int(header[f"Segment{n}_LabelValue"]) if stated else 1,
            name=str(header.get(f"Segment{n}_Name", "")),
            layer=int(header.get(f"Segment{n}_Layer", 0)) if stated else n,
        )
        for n in numbers
    )
    names: dict[tuple[int, int], str] = {}
    for segment in segments:
        other = names.setdefault((segment.layer, segment.label), segment.name)
        if other != segment.name:
            raise InputRefused(
                f'{path} gives segments "{other}" and "{segment.name}" the same value {segment.label} in one layer; '
                "export the segmentation again."
            )
    return segments


def _affine(directions: Array, origin: Array, signs: tuple[int, int, int]) -> Array:
    affine = np.eye(4)
    affine[:3, :3] = directions.T
    affine[:3, 3] = origin
    affine[:3] *= np.reshape(signs, (3, 1))
    return affine
