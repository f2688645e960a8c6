"""One door for images: a path in any supported format becomes a Volume or a Mask in RAS mm.

Voxels keep the storage order of the file; `frames.reorient` changes it where a caller wants one order for all.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from registration.volume import Grid, Mask, Volume
from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.dicom import dicom_files, frame_of_reference, is_directory, read_dicom
from vatsloc.formats.dicom.regions import holds_regions, read_regions
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


def read_image(path: Path, series: str | int | None = None) -> RawImage:
    """Voxels as stored (ni, nj, nk) and RAS affine of a file or a DICOM folder; series: which one of its DICOM series.

    Raises CaseError when nothing is there or the format is unknown, InputRefused when the content cannot be trusted.
    """
    if not path.exists():
        raise CaseError(f"{path} does not exist; correct the path or put the image there.")
    reader = read_dicom if path.is_dir() else _reader(path)
    if reader is read_dicom:
        return checked(read_dicom(path, series))
    if series is not None:
        raise CaseError(f"{path} is no DICOM, so it holds no series {series!r}; remove it from case.toml.")
    return checked(reader(path))


def read_volume(path: Path, series: str | int | None = None) -> Volume:
    """Scalar image in HU, float32. Raises as `read_image`, and InputRefused when all voxels are equal."""
    return read_volume_and_warnings(path, series)[0]


def read_volume_and_warnings(path: Path, series: str | int | None = None) -> tuple[Volume, tuple[str, ...]]:
    """As `read_volume`, with a sentence for all that its reader left out or doubts."""
    image = read_image(path, series)
    hu = np.ascontiguousarray(image.values, dtype=np.float32)
    if hu.min() == hu.max():
        raise InputRefused(f"{path} is {hu.flat[0]:g} everywhere; export the image with its content.")
    return Volume(hu, image.ras_from_ijk), image.warnings


def read_mask(path: Path, grid: Grid | None = None, frame: str = "") -> Mask:
    """Region where the image is at least 0.5. Raises as `read_image`, InputRefused when empty or negative anywhere.

    grid, frame: of the CT that it was drawn on, which a DICOM Structure Set needs; "" where no frame is stated.
    """
    image = _one_region(read_regions(path, grid, frame)) if holds_regions(path) else read_image(path)
    lowest = image.values.min()
    if lowest < 0:
        raise InputRefused(f"{path} has values down to {lowest:g}, so it is no mask; write 1 inside and 0 outside.")
    inside = image.values if image.values.dtype == bool else image.values >= 0.5
    if not inside.any():
        raise InputRefused(f"{path} is an empty mask; draw the region and save it again.")
    return Mask(np.ascontiguousarray(inside), image.ras_from_ijk)


def files_behind(path: Path) -> list[Path]:
    """All files that `path` stands for: those of a folder or DICOMDIR in order, a header's data file, or the file."""
    if path.is_dir() or is_directory(path):
        return dicom_files(path)
    if path.suffix.lower() == ".mhd":
        return [path, data_file(path, read_header(path)[0])]
    if path.suffix.lower() == ".nhdr":
        fields = (line.partition(":") for line in path.read_text(errors="replace").splitlines())
        named = [value.strip() for key, _, value in fields if key.strip().lower() in ("data file", "datafile")]
        return [path, *(path.parent / name for name in named if (path.parent / name).is_file())]
    return [path]


def stated_frame(path: Path, series: str | int | None = None) -> str:
    """FrameOfReferenceUID of a DICOM image, "" for other formats, which have none."""
    is_dicom = path.is_dir() or _reader(path) is read_dicom
    return frame_of_reference(path, series) if is_dicom else ""


def _one_region(image: RawImage) -> RawImage:
    if len(image.segments) > 1:
        listed = ", ".join(f"{segment.label} ({segment.name})" for segment in image.segments)
        raise InputRefused(f"{image.path} holds {len(image.segments)} segments: {listed}; keep the nodule's alone.")
    return checked(image)


def _reader(path: Path) -> Callable[[Path], RawImage]:
    name = path.name.lower()
    for suffix, reader in _READERS.items():
        if name.endswith(suffix):
            return reader
    with path.open("rb") as file:
        if file.read(132)[128:] == b"DICM":  # DICOM files often carry no suffix
            return read_dicom
    raise CaseError(f"{path} has no known image suffix; use {', '.join(_READERS)} or a folder of DICOM slices.")
