"""NIfTI images: the sform (or else the qform) places voxels in RAS.

Ref: Cox et al. 2004, NIfTI-1 data format.
"""

from __future__ import annotations

import zlib
from pathlib import Path

import nibabel
import numpy as np

from registration.volume import Array, Mask, Volume
from vatsloc.errors import InputRefused
from vatsloc.formats.raw import RawImage
from vatsloc.frames import reorient

MAX_FORM_DIFFERENCE_MM = 1.0
"""How far qform and sform may place the same corner apart; quaternion rounding stays far below."""


def read_nifti(path: Path) -> RawImage:
    """Image with scaled values. Raises InputRefused when it is unreadable or its place in space is not stated in mm."""
    image, header = open_nifti(path)
    ras_from_ijk = _stated_affine(header, image.shape, path)
    try:
        # Scaled integers go through float64 only when the header asks for scaling.
        values = np.asanyarray(image.dataobj)
    except Exception as error:
        raise InputRefused(f"{path} cannot be read ({_first_line(error)}); copy or export it again.") from error
    return RawImage(values, ras_from_ijk, path)


def open_nifti(path: Path) -> tuple[nibabel.Nifti1Image, nibabel.Nifti1Header]:
    """Image with its voxels still on disk, and its header. Raises InputRefused when the file is not NIfTI."""
    try:
        image = nibabel.load(path)
    except Exception as error:
        raise InputRefused(f"{path} is not a readable NIfTI image ({_first_line(error)}); export it again.") from error
    if not isinstance(image, nibabel.Nifti1Image):
        raise InputRefused(f"{path} is {type(image).__name__}, not NIfTI; convert it to .nii.gz.")
    return image, image.header


def write_volume(path: Path, volume: Volume, axes: str | None = None) -> None:
    """Write HU as int16 when they fit, else as float32, with sform and qform; `axes` reorders storage ("LPS")."""
    hu = volume.hu
    if not np.isfinite(hu).all():
        raise ValueError(f"volume for {path.name} has values that are not finite")
    limits = np.iinfo(np.int16)
    fits = limits.min <= hu.min() and hu.max() <= limits.max
    _write(path, np.rint(hu).astype(np.int16) if fits else hu.astype(np.float32), volume.ras_from_ijk, axes)


def write_mask(path: Path, mask: Mask, axes: str | None = None) -> None:
    """Write a mask as 0 and 1 in uint8, with sform and qform; `axes` reorders storage ("LPS")."""
    _write(path, mask.inside.astype(np.uint8), mask.ras_from_ijk, axes)


def nifti_image(values: Array, ras_from_ijk: Array) -> nibabel.Nifti1Image:
    """Image in mm with sform and qform in scanner coordinates."""
    image = nibabel.Nifti1Image(values, None)
    image.set_sform(ras_from_ijk, code=1)
    image.set_qform(ras_from_ijk, code=1)
    image.header.set_xyzt_units("mm")
    return image


def save_nifti(image: nibabel.Nifti1Image, path: Path) -> None:
    """Write .nii.gz, the same bytes for the same image.

    Run-length matching is what speeds this up over gzip's own: noisy voxels hold no longer repeats worth looking for.
    """
    compressor = zlib.compressobj(1, zlib.DEFLATED, wbits=zlib.MAX_WBITS + 16, strategy=zlib.Z_RLE)
    path.write_bytes(compressor.compress(image.to_bytes()) + compressor.flush())


def _write(path: Path, values: Array, ras_from_ijk: Array, axes: str | None) -> None:
    if axes is not None:
        values, ras_from_ijk = reorient(values, ras_from_ijk, axes)
    save_nifti(nifti_image(values, ras_from_ijk), path)


def _stated_affine(header: nibabel.Nifti1Header, shape: tuple[int, ...], path: Path) -> Array:
    units = header.get_xyzt_units()[0]
    if units not in ("mm", "unknown"):
        raise InputRefused(f"{path} is in {units}, not mm; export it in millimetres.")
    sform, qform = int(header["sform_code"]) > 0, int(header["qform_code"]) > 0
    if not sform and not qform:
        raise InputRefused(
            f"{path} states no frame (qform and sform codes are 0); export it with its position in space."
        )
    try:
        by_sform = header.get_sform() if sform else header.get_qform()
        by_qform = header.get_qform() if qform else by_sform
    except Exception as error:
        raise InputRefused(f"{path} has an unreadable qform ({_first_line(error)}); export it again.") from error
    corners = np.array([[a, b, c, 1] for a in (0, 1) for b in (0, 1) for c in (0, 1)]) * [*np.subtract(shape[:3], 1), 1]
    apart = np.abs(corners @ (by_sform - by_qform).T).max() if len(shape) >= 3 else 0.0
    if apart > MAX_FORM_DIFFERENCE_MM:
        raise InputRefused(
            f"{path} states two frames: qform and sform place the same voxel {apart:.0f} mm apart; "
            "set both to the scanner's position."
        )
    return np.asarray(by_sform, dtype=float)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
