"""One door for images: a path in any supported format becomes a Volume or a Mask in RAS mm.

Voxels keep the storage order of the file; `frames.reorient` changes it where a caller wants one order for all.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from registration.volume import Mask, Volume
from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.dicom import read_dicom
from vatsloc.formats.metaimage import data_file, read_header, read_metaimage
from vatsloc.formats.nifti import read_nifti
from vatsloc.formats.nrrd import read_nrrd
from vatsloc.formats.raw import RawImage, checked

_READERS: dict[str, Callable[[Path], RawImage]] = {
    ".nii.gz": read_nifti,
    ".nii": read_nifti,
    ".nrrd": read_nrrd,
    ".nhdr": read_nrrd,
    ".mha": read_metaimage,
    ".mhd": read_metaimage,
    ".dcm": read_dicom,
}


def read_image(path: Path) -> RawImage:
    """Voxels as stored (ni, nj, nk) and RAS affine of a file or a DICOM folder.

    Raises CaseError when nothing is there or the format is unknown, InputRefused when the content cannot be trusted.
    """
    if not path.exists():
        raise CaseError(f"{path} does not exist; correct the path or put the image there.")
    reader = read_dicom if path.is_dir() else _reader(path)
    return checked(reader(path))


def read_volume(path: Path) -> Volume:
    """Scalar image in HU, float32. Raises as `read_image`, and InputRefused when all voxels are equal."""
    image = read_image(path)
    hu = np.ascontiguousarray(image.values, dtype=np.float32)
    if hu.min() == hu.max():
        raise InputRefused(f"{path} is {hu.flat[0]:g} everywhere; export the image with its content.")
    return Volume(hu, image.ras_from_ijk)


def read_mask(path: Path) -> Mask:
    """Region where the image is at least 0.5. Raises as `read_image`, InputRefused when empty or negative anywhere."""
    image = read_image(path)
    lowest = image.values.min()
    if lowest < 0:
        raise InputRefused(f"{path} has values down to {lowest:g}, so it is no mask; write 1 inside and 0 outside.")
    inside = image.values if image.values.dtype == bool else image.values >= 0.5
    if not inside.any():
        raise InputRefused(f"{path} is an empty mask; draw the region and save it again.")
    return Mask(np.ascontiguousarray(inside), image.ras_from_ijk)


def files_behind(path: Path) -> list[Path]:
    """All files that `path` stands for: those of a folder in order, a header's data file, or the file itself."""
    if path.is_dir():
        return sorted(f for f in path.iterdir() if f.is_file())
    if path.suffix.lower() == ".mhd":
        return [path, data_file(path, read_header(path)[0])]
    if path.suffix.lower() == ".nhdr":
        fields = (line.partition(":") for line in path.read_text(errors="replace").splitlines())
        named = [value.strip() for key, _, value in fields if key.strip().lower() in ("data file", "datafile")]
        return [path, *(path.parent / name for name in named if (path.parent / name).is_file())]
    return [path]


def _reader(path: Path) -> Callable[[Path], RawImage]:
    name = path.name.lower()
    for suffix, reader in _READERS.items():
        if name.endswith(suffix):
            return reader
    with path.open("rb") as file:
        if file.read(132)[128:] == b"DICM":  # DICOM files often carry no suffix
            return read_dicom
    raise CaseError(f"{path} has no known image suffix; use {', '.join(_READERS)} or a folder of DICOM slices.")
