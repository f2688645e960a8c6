"""NRRD images: "space" names the frame, "space directions" and "space origin" place voxels in it.

Ref: Kindlmann 2005, Definition of NRRD file format.
"""

from __future__ import annotations

from pathlib import Path

import nrrd
import numpy as np

from registration.volume import Array
from vatsloc.errors import InputRefused
from vatsloc.formats.raw import RawImage

_SIGNS_TO_RAS = {
    "right-anterior-superior": (1, 1, 1),
    "left-anterior-superior": (-1, 1, 1),
    "left-posterior-superior": (-1, -1, 1),
}
_LONG_NAME = {"RAS": "right-anterior-superior", "LAS": "left-anterior-superior", "LPS": "left-posterior-superior"}


def read_nrrd(path: Path) -> RawImage:
    """Image of a .nrrd or .nhdr file. Raises InputRefused when it is unreadable or states no anatomical frame in mm."""
    try:
        values, header = nrrd.read(str(path))
    except Exception as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
        raise InputRefused(f"{path} is not a readable NRRD image ({reason}); export it again.") from error
    space = str(header.get("space", ""))
    name = _LONG_NAME.get(space.upper(), space.lower()).removesuffix("-time")
    if name not in _SIGNS_TO_RAS:
        got = f'space "{space}"' if space else "no space"
        raise InputRefused(
            f"{path} states {got}; export it with space left-posterior-superior or another patient frame."
        )
    if "space directions" not in header or "space origin" not in header:
        raise InputRefused(
            f"{path} states no space directions or no space origin; export it with its position in space."
        )
    units = {str(u).strip('"') for u in header.get("space units", [])} - {"mm", "", "???"}
    if units:
        raise InputRefused(f"{path} is in {', '.join(sorted(units))}, not mm; export it in millimetres.")
    directions = np.array([np.full(3, np.nan) if d is None else d for d in header["space directions"]], dtype=float)
    spatial = np.isfinite(directions).all(axis=1)
    origin = np.asarray(header["space origin"], dtype=float)
    if spatial.sum() != 3 or origin.shape != (3,):
        raise InputRefused(f"{path} has {spatial.sum()} spatial axes, 3 needed; export a single volume.")
    # Non-spatial axes go last, where an axis of length one is dropped.
    values = np.moveaxis(values, np.flatnonzero(spatial), (0, 1, 2))
    return RawImage(values, _affine(directions[spatial], origin, _SIGNS_TO_RAS[name]), path)


def _affine(directions: Array, origin: Array, signs: tuple[int, int, int]) -> Array:
    affine = np.eye(4)
    affine[:3, :3] = directions.T
    affine[:3, 3] = origin
    affine[:3] *= np.reshape(signs, (3, 1))
    return affine
