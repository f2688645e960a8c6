"""What every image reader hands on, and the checks that hold for all file formats alike."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from registration.volume import Array
from vatsloc.errors import InputRefused

MAX_SHEAR = 1e-3
"""Largest cosine between two voxel axes; header rounding stays below it, a gantry tilt of 0.1 degrees does not."""
MAX_SIZE_DIFFERENCE_MM = 1.0
"""How far two statements of the voxel size in one header may place the same corner apart."""
MAX_VOXEL_MM, MAX_PLACE_MM = 100.0, 1e5
"""Far beyond any scan, and far below where rounding takes the millimetres."""
MAX_VOXELS = 2**31
"""No scan holds more: twice 1024 x 1024 x 1024."""
MAX_DEFLATE_RATIO = 1032
"""The most that a deflated stream can grow. Ref: RFC 1951."""


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


def checked(image: RawImage, least_voxels: int = 2) -> RawImage:
    """The image with trailing axes of length one dropped, if its voxels and its geometry can be trusted.

    Raises InputRefused when it is not three-dimensional, has fewer voxels than `least_voxels` along an axis, is not a
    scalar of real numbers, not finite, or when its axes are degenerate or sheared.
    """
    path, values = image.path, image.values
    while values.ndim > 3 and values.shape[-1] == 1:
        values = values[..., 0]
    if values.ndim != 3 or min(values.shape) < least_voxels:
        raise InputRefused(
            f"{path} holds {by(image.values.shape)} values, not one three-dimensional image; export a single volume."
        )
    check_values(values, path)
    affine = np.asarray(image.ras_from_ijk, dtype=float)
    check_affine(affine, path)
    return replace(image, values=values, ras_from_ijk=affine)


def check_values(values: Array, path: Path) -> None:
    """Raise InputRefused unless all values are finite real numbers."""
    if values.dtype.kind not in "biuf":
        raise InputRefused(f"{path} holds values of type {values.dtype}, not one number per voxel; export grey values.")
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        n_bad = int(values.size - np.isfinite(values).sum())
        raise InputRefused(f"{path} has {n_bad} voxels that are not finite numbers; repair or re-export it.")


def check_size(shape: Sequence[int], itemsize: int, stored_bytes: float, path: Path, deflated: bool = False) -> int:
    """Bytes that `shape` takes, compared with those of the file before any memory is taken for them.

    Raises InputRefused for axes without voxels, more than `MAX_VOXELS`, or more than the file can hold.
    """
    sizes = [int(n) for n in shape]
    if min(sizes, default=0) < 1:
        raise InputRefused(f"{path} states {by(sizes)} voxels, at least 1 needed along each axis; export it again.")
    voxels = math.prod(sizes)
    if voxels > MAX_VOXELS:
        raise InputRefused(f"{path} states {by(sizes)} voxels, more than any scan has; export it again.")
    needed = voxels * itemsize
    if needed > stored_bytes * (MAX_DEFLATE_RATIO if deflated else 1):
        raise InputRefused(
            f"{path} holds {stored_bytes} bytes of voxels, {needed} needed for {by(sizes)}; copy or export it again."
        )
    return needed


def check_voxel_size(spacing: Array, ras_from_ijk: Array, shape: Sequence[int], key: str, path: Path) -> None:
    """Raise InputRefused where a voxel size stated apart, (3,) mm under `key`, contradicts the matrix.

    Programs differ in which of the two they take, so neither is believed; a size that is not positive contradicts all.
    """
    by_matrix = np.linalg.norm(ras_from_ijk[:3, :3], axis=0)
    stated = np.asarray(spacing, dtype=float)
    apart = np.abs(stated - by_matrix) * np.maximum(np.array(shape[:3]) - 1, 1)
    if not (np.isfinite(stated).all() and (stated > 0).all() and apart.max() <= MAX_SIZE_DIFFERENCE_MM):
        raise InputRefused(
            f"{path} states two voxel sizes: {by(stated)} mm as {key}, {by(by_matrix)} mm by its matrix; "
            "programs differ in which they take, so export it with one."
        )


def check_affine(ras_from_ijk: Array, path: Path) -> None:
    """Raise InputRefused unless the affine (4, 4) is finite, regular and has orthogonal axes."""
    if not np.isfinite(ras_from_ijk).all():
        raise InputRefused(f"{path} has a geometry that is not finite; re-export it with its position and orientation.")
    axes = ras_from_ijk[:3, :3]
    spacing = np.linalg.norm(axes, axis=0)
    if spacing.min() < 1e-6:
        raise InputRefused(f"{path} has voxels of {by(spacing)} mm; re-export it with the true voxel size.")
    if spacing.max() > MAX_VOXEL_MM or np.abs(ras_from_ijk[:3, 3]).max() > MAX_PLACE_MM:
        raise InputRefused(
            f"{path} has voxels of {by(spacing)} mm at {by(ras_from_ijk[:3, 3])} mm; "
            "re-export it with its true size and place in millimetres."
        )
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


def by(numbers: Sequence[float] | Array) -> str:
    """ "3 x 4 x 5"."""
    return " x ".join(f"{n:g}" if isinstance(n, float) else str(n) for n in numbers)
