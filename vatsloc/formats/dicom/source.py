"""A DICOM series as other DICOM objects refer to it: its headers in the order of its slices, and its grid."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydicom.dataset import Dataset

from registration.volume import Array, Grid
from vatsloc.errors import InputRefused
from vatsloc.formats.dicom.frames import frames_of, lattice
from vatsloc.formats.dicom.header import Header, read_header
from vatsloc.formats.dicom.series import dicom_files, find_series, is_directory
from vatsloc.formats.dicom.upright import is_tilted
from vatsloc.formats.guard import guarded
from vatsloc.frames import flip_affine

NEEDED = ("StudyInstanceUID", "SeriesInstanceUID", "SOPInstanceUID", "SOPClassUID", "FrameOfReferenceUID")
"""What an object that refers to a series has to name; an image can be read without."""


@dataclass(frozen=True)
class SourceSeries:
    """Headers of one series and where its voxels lie.

    images: data sets without pixels, one for each slice in the order of `grid`, or the one multi-frame file;
    order: (n,) for each slice of `grid` the number of its image or frame; grid: columns, rows, slices.
    """

    path: Path
    images: tuple[Dataset, ...]
    order: Array
    grid: Grid

    @property
    def frame_of_reference(self) -> str:
        """FrameOfReferenceUID."""
        return str(self.images[0].FrameOfReferenceUID)


@guarded("DICOM series")
def read_source(path: Path, series: str | int | None = None) -> SourceSeries:
    """The series of a folder or file; raises as `read_dicom`, and InputRefused where it lacks a UID to refer to."""
    found = find_series(path, series)
    for header in found.images:
        for name in NEEDED:
            if not header.text(name):
                raise InputRefused(f"{header.file} states no {name}, so no object can refer to it; export it again.")
        _make_plain(header.dataset)
    frames = sorted(frames_of(found.images, path), key=lambda frame: frame.place)
    lps_from_ijk = lattice(frames, path, found.left_out)
    first = frames[0].header
    if len(found.images) > 1 and len(frames) > len(found.images):
        raise InputRefused(f"{path} has several multi-frame files, and no object can refer to them; export its slices.")
    if is_tilted(lps_from_ijk):
        raise InputRefused(
            f"{path} has slices of a tilted gantry, which a run puts upright, so its result lies on other slices; "
            "no object about them can be written."
        )
    shape = (first.whole("Columns", 1, 65535), first.whole("Rows", 1, 65535), len(frames))
    images: tuple[Dataset, ...]
    if len(found.images) == 1:
        images, order = (first.dataset,), np.array([frame.index for frame in frames])
    else:
        images, order = tuple(frame.header.dataset for frame in frames), np.arange(len(frames))
    return SourceSeries(path, images, order, Grid(shape, flip_affine(lps_from_ijk)))


def _make_plain(dataset: Dataset) -> None:
    """Text in Unicode, and no sex that the standard does not know: objects that refer to a series repeat its patient,
    and what writes them takes nothing else."""
    dataset.decode()
    dataset.SpecificCharacterSet = "ISO_IR 192"
    if str(dataset.get("PatientSex") or "") not in ("M", "F", "O"):
        dataset.PatientSex = ""


@guarded("image")
def is_dicom(path: Path) -> bool:
    """Whether an image path stands for DICOM: a folder or a DICOMDIR of it, or a file."""
    if path.is_dir() or is_directory(path):
        return any(_is_dicom_file(file) for file in dicom_files(path))
    return path.is_file() and _is_dicom_file(path)


def _is_dicom_file(file: Path) -> bool:
    header: Header | None = read_header(file)
    return header is not None
