"""One door for images: a path in any supported format becomes a Volume or a Mask in RAS mm.

Voxels keep the storage order of the file; `frames.reorient` changes it where a caller wants one order for all.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from registration.volume import Grid, Mask, Volume
from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.dicom import dicom_files, frame_of_reference, is_directory, read_dicom
from vatsloc.formats.dicom.regions import holds_regions, read_regions
from vatsloc.formats.guard import guarded, reading
from vatsloc.formats.metaimage import data_file, read_header, read_metaimage
from vatsloc.formats.nifti import read_nifti
from vatsloc.formats.nrrd import nrrd_data_file, read_nrrd
from vatsloc.formats.raw import RawImage, checked
from vatsloc.formats.segments import Label, region, union

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
    return checked(_read(path, series))


def read_volume(path: Path, series: str | int | None = None) -> Volume:
    """Scalar image in HU, float32. Raises as `read_image`, and InputRefused when all voxels are equal."""
    return read_volume_and_warnings(path, series)[0]


@guarded("image")
def read_volume_and_warnings(path: Path, series: str | int | None = None) -> tuple[Volume, tuple[str, ...]]:
    """As `read_volume`, with a sentence for all that its reader left out or doubts."""
    image = read_image(path, series)
    hu = np.ascontiguousarray(image.values, dtype=np.float32)
    lowest, highest = hu.min(), hu.max()
    if not np.isfinite([lowest, highest]).all():
        raise InputRefused(f"{path} has values beyond single precision; export it in Hounsfield units.")
    if lowest == highest:
        raise InputRefused(f"{path} is {hu.flat[0]:g} everywhere; export the image with its content.")
    return Volume(hu, image.ras_from_ijk), image.warnings


@guarded("mask")
def read_mask(path: Path) -> Mask:
    """Region where the image is at least 0.5, all labels and segments together.

    Raises as `read_image`, InputRefused when empty or negative anywhere.
    """
    return union(read_regions(path) if holds_regions(path) else _read(path))


@guarded("mask")
def read_region(
    path: Path,
    label: Label | Sequence[Label] | None = None,
    ask: str = "label = ...",
    grid: Grid | None = None,
    frame: str = "",
) -> Mask:
    """One region of a mask or a label image: the one it holds, or those of the labels (numbers or segments' names).

    Raises as `read_mask`, and InputRefused, with a list of what is there, when it holds several and `label` is None, or
    not what `label` asks for. ask: how to choose one, for that sentence. grid, frame: of the CT that it was drawn on,
    which a DICOM Structure Set needs; "" where no frame of reference is stated.
    """
    image = read_regions(path, grid, frame) if holds_regions(path) else _read(path)
    return region(image, label, ask)


@guarded("image")
def files_behind(path: Path) -> list[Path]:
    """All files that `path` stands for: those of a folder or DICOMDIR in order, a header's data file, or the file."""
    if path.is_dir() or is_directory(path):
        return dicom_files(path)
    if path.suffix.lower() == ".mhd":
        return [path, data_file(path, read_header(path)[0])]
    if path.suffix.lower() == ".nhdr":
        return list(dict.fromkeys([path, nrrd_data_file(path)]))
    return [path]


def stated_frame(path: Path, series: str | int | None = None) -> str:
    """FrameOfReferenceUID of a DICOM image, "" for other formats, which have none."""
    is_dicom = path.is_dir() or _reader(path) is read_dicom
    return frame_of_reference(path, series) if is_dicom else ""


def _read(path: Path, series: str | int | None = None) -> RawImage:
    with reading(path, "file", "correct the path", CaseError):
        there, folder = path.exists(), path.is_dir()
    if not there:
        raise CaseError(f"{path} does not exist; correct the path or put the image there.")
    reader = read_dicom if folder else _reader(path)
    if series is not None and reader is not read_dicom:
        raise CaseError(f"{path} is no DICOM, so it holds no series {series!r}; remove it from case.toml.")
    with reading(path, "image"):
        return read_dicom(path, series) if reader is read_dicom else reader(path)


def _reader(path: Path) -> Callable[[Path], RawImage]:
    name = path.name.lower()
    for suffix, reader in _READERS.items():
        if name.endswith(suffix):
            return reader
    with reading(path, "file", "check its permissions"), path.open("rb") as file:
        if file.read(132)[128:] == b"DICM":  # DICOM files often carry no suffix
            return read_dicom
    raise CaseError(f"{path} has no known image suffix; use {', '.join(_READERS)} or a folder of DICOM slices.")
