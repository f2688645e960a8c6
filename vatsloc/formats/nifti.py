"""NIfTI images: the sform (or else the qform) places voxels in RAS.

The library mends some headers as it reads them (a voxel size of 0 becomes 1, a negative one positive), so what it mends
is looked at before.
Ref: Cox et al. 2004, NIfTI-1 data format.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path
from typing import IO, cast

import nibabel
import numpy as np
from nibabel.arrayproxy import ArrayProxy

from registration.volume import Array, Mask, Volume
from vatsloc.errors import InputRefused
from vatsloc.formats.guard import guarded
from vatsloc.formats.raw import RawImage, by, check_affine, check_size, check_voxel_size
from vatsloc.frames import reorient

MAX_FORM_DIFFERENCE_MM = 1.0
"""How far qform and sform may place the same corner apart; quaternion rounding stays far below."""


@guarded("NIfTI image")
def read_nifti(path: Path) -> RawImage:
    """Image with scaled values. Raises InputRefused when it is unreadable or its place in space is not stated in mm."""
    image, header = open_nifti(path)
    ras_from_ijk = _stated_affine(header, image.shape, path)
    # Scaled integers go through float64 only when the header asks for scaling.
    return RawImage(np.asanyarray(image.dataobj), ras_from_ijk, path)


@guarded("NIfTI image")
def open_nifti(path: Path) -> tuple[nibabel.Nifti1Image, nibabel.Nifti1Header]:
    """Image with its voxels still on disk, and its header as it is stored.

    Raises InputRefused when the file is not NIfTI, or does not hold the voxels that its header states.
    """
    image = nibabel.load(path)
    if not isinstance(image, nibabel.Nifti1Image):
        raise InputRefused(f"{path} is {type(image).__name__}, not NIfTI; convert it to .nii.gz.")
    with _opened(path) as file:
        header = type(image.header).from_fileobj(file, check=False)
    _check_stored(path, image)
    return image, header


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


def _opened(path: Path) -> IO[bytes]:
    return cast(IO[bytes], gzip.open(path)) if path.suffix.lower() == ".gz" else path.open("rb")


def _check_stored(path: Path, image: nibabel.Nifti1Image) -> None:
    """Refuse a file that holds fewer voxels than its header states, or more, of which some would be left out."""
    shape, voxels = image.shape, cast(ArrayProxy, image.dataobj)
    start, itemsize = int(voxels.offset), voxels.dtype.itemsize
    stored = path.stat().st_size
    deflated = path.suffix.lower() == ".gz"
    n_bytes = check_size(shape, itemsize, stored - (0 if deflated else start), path, deflated) + start
    if deflated:
        stored = _deflated_size(path, n_bytes)
    if stored != n_bytes:
        raise InputRefused(
            f"{path} holds {stored - start} bytes of voxels, {n_bytes - start} needed for {by(shape)}; "
            "copy or export it again."
        )


def _deflated_size(path: Path, expected: int) -> int:
    """Bytes that a gzip file holds: by its last four, which state them, or counted where these say something else."""
    with path.open("rb") as file:
        file.seek(-4, 2)
        (stated,) = struct.unpack("<I", file.read(4))
    if stated == expected % 2**32:
        return expected
    size = 0
    with gzip.open(path) as stream:  # several streams in one file, or damage, which reading to the end shows
        while block := stream.read(2**22):
            size += len(block)
    return size


def _stated_affine(header: nibabel.Nifti1Header, shape: tuple[int, ...], path: Path) -> Array:
    code = int(header["xyzt_units"]) % 8
    if code not in (0, 2):
        unit = {1: "meter", 3: "micron"}.get(code, f"units of code {code}")
        raise InputRefused(f"{path} is in {unit}, not mm; export it in millimetres.")
    sform, qform = int(header["sform_code"]) > 0, int(header["qform_code"]) > 0
    if not sform and not qform:
        raise InputRefused(
            f"{path} states no frame (qform and sform codes are 0); export it with its position in space."
        )
    if len(shape) < 3:
        raise InputRefused(f"{path} holds {by(shape)} values, not one three-dimensional image; export a single volume.")
    sizes = np.array(header["pixdim"][1:4], dtype=float)
    if not (np.isfinite(sizes) & (sizes > 0)).all():
        raise InputRefused(f"{path} has voxels of {by(sizes)} mm (pixdim); export it with its voxel size.")
    if float(header["pixdim"][0]) not in (-1.0, 0.0, 1.0) and qform:
        raise InputRefused(f"{path} has pixdim[0] = {float(header['pixdim'][0]):g}, 1 or -1 needed; export it again.")
    by_sform = np.asarray(header.get_sform() if sform else header.get_qform(), dtype=float)
    check_affine(by_sform, path)
    by_qform = np.asarray(header.get_qform() if qform else by_sform, dtype=float)
    corners = np.array([[a, b, c, 1] for a in (0, 1) for b in (0, 1) for c in (0, 1)]) * [*np.subtract(shape[:3], 1), 1]
    apart = np.abs(corners @ (by_sform - by_qform).T).max()
    if not apart <= MAX_FORM_DIFFERENCE_MM:
        raise InputRefused(
            f"{path} states two frames: qform and sform place the same voxel {apart:.0f} mm apart; "
            "set both to the scanner's position."
        )
    check_voxel_size(sizes, by_sform, shape, "pixdim", path)
    return by_sform
