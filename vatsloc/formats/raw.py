"""What every image reader hands on, and the checks that hold for all file formats alike."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from registration.volume import Array
from vatsloc.errors import InputRefused

MAX_SHEAR = 1e-3
"""Largest cosine between two voxel axes; header rounding stays below it, a gantry tilt of 0.1 degrees does not."""


@dataclass(frozen=True)
class Segment:
    """A named region of a label image. label: its voxels' value; layer: index of the label image that holds it."""

    label: int
    name: str
    layer: int = 0


@dataclass(frozen=True)
class RawImage:
    """Voxels as stored. values: (ni, nj, nk[, 1...]), or (ni, nj, nk, layers) of a segmentation whose segments overlap.

    ras_from_ijk: (4, 4), mm; path: file or folder it came from; segments: what the file names, none in most formats;
    warnings: what its reader left out or doubts, a sentence each.
    """

    values: Array
    ras_from_ijk: Array
    path: Path
    segments: tuple[Segment, ...] = ()
    warnings: tuple[str, ...] = ()


def checked(image: RawImage) -> RawImage:
    """The image with trailing axes of length one dropped, if its voxels and its geometry can be trusted.

    Raises InputRefused when it is not three-dimensional, not a scalar of real numbers, not finite, or when its axes are
    degenerate or sheared.
    """
    path, values = image.path, image.values
    while values.ndim > 3 and values.shape[-1] == 1:
        values = values[..., 0]
    if values.ndim != 3 or min(values.shape) < 2:
        shape = " x ".join(str(n) for n in image.values.shape)
        raise InputRefused(f"{path} holds {shape} values, not one three-dimensional image; export a single volume.")
    if values.dtype.kind not in "biuf":
        raise InputRefused(f"{path} holds values of type {values.dtype}, not one number per voxel; export grey values.")
    affine = np.asarray(image.ras_from_ijk, dtype=float)
    check_affine(affine, path)
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        n_bad = int(values.size - np.isfinite(values).sum())
        raise InputRefused(f"{path} has {n_bad} voxels that are not finite numbers; repair or re-export it.")
    return RawImage(values, affine, path, image.segments, image.warnings)


def check_affine(ras_from_ijk: Array, path: Path) -> None:
    """Raise InputRefused unless the affine (4, 4) is finite, regular and has orthogonal axes."""
    if not np.isfinite(ras_from_ijk).all():
        raise InputRefused(f"{path} has a geometry that is not finite; re-export it with its position and orientation.")
    axes = ras_from_ijk[:3, :3]
    spacing = np.linalg.norm(axes, axis=0)
    if spacing.min() < 1e-6:
        mm = " x ".join(f"{s:g}" for s in spacing)
        raise InputRefused(f"{path} has voxels of {mm} mm; re-export it with the true voxel size.")
    cosines = (axes / spacing).T @ (axes / spacing)
    shear = float(np.abs(cosines - np.eye(3)).max())
    if shear > 1 - MAX_SHEAR:
        raise InputRefused(f"{path} has two voxel axes along the same direction; re-export it with its orientation.")
    if shear > MAX_SHEAR:
        angle = np.degrees(np.arcsin(shear))
        raise InputRefused(
            f"{path} is sheared: two voxel axes are {angle:.1f} degrees off a right angle; "
            "resample it to orthogonal axes (for a tilted gantry, undo the tilt)."
        )
