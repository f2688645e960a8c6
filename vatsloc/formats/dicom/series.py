"""Which files of a folder, or of a DICOMDIR, make the volume; the rest is left out and said.

Ref: DICOM PS3.3, C.7.3 (series), C.8.2.1 (localizers), F.5 (directory records).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pydicom.uid import (
    EnhancedXAImageStorage,
    EnhancedXRFImageStorage,
    MediaStorageDirectoryStorage,
    XRayAngiographicImageStorage,
    XRayRadiofluoroscopicImageStorage,
)

from vatsloc.errors import InputRefused
from vatsloc.formats.dicom.header import Header, read_header

CT_LIKE = ("CT", "XA", "RF", "OT")
"""Modalities under which scanners and C-arms store reconstructed volumes."""

_X_RAY = (
    XRayAngiographicImageStorage,
    XRayRadiofluoroscopicImageStorage,
    EnhancedXAImageStorage,
    EnhancedXRFImageStorage,
)
_GROUPS = ("SharedFunctionalGroupsSequence", "PerFrameFunctionalGroupsSequence", "XRay3DReconstructionSequence")
_PLACES = ("ImagePositionPatient", "PlanePositionSequence")
_NO_DICOM, _COLOUR, _LOCALIZER, _PROJECTIONS, _SINGLE = (
    "no DICOM file",
    "colour image",
    "localizer",
    "projections",
    "single image of another series",
)
_MANY = 100_000


@dataclass(frozen=True)
class Series:
    """Images of one series in the order of their files. left_out: what else lay there, a sentence each.

    n_aside: images of its own series among them.
    """

    images: tuple[Header, ...]
    left_out: tuple[str, ...] = ()
    n_aside: int = 0

    def __str__(self) -> str:
        first = self.images[0]
        n = sum(image.whole("NumberOfFrames", 1, _MANY, 1) for image in self.images)
        date = first.text("SeriesDate") or first.text("AcquisitionDate") or first.text("StudyDate")
        name = first.text("SeriesDescription")
        words = [
            f"number {first.text('SeriesNumber')}" if first.text("SeriesNumber") else "",
            f"{n} slice{'s' if n > 1 else ''}",
            first.text("Modality"),
            date,
            f'"{name}"' if name else "",
        ]
        return f"{first.text('SeriesInstanceUID') or 'no UID'} ({', '.join(word for word in words if word)})"

    def is_called(self, wanted: str) -> bool:
        """Whether `wanted` is its UID, its number or its description."""
        first = self.images[0]
        names = [first.text(name).strip() for name in ("SeriesInstanceUID", "SeriesNumber", "SeriesDescription")]
        return wanted.strip().casefold() in [name.casefold() for name in names if name]


def dicom_files(path: Path) -> list[Path]:
    """Files that a path stands for: those of a folder, those that its DICOMDIR records, or the file itself.

    A folder that holds no DICOM file stands for all that lies below it.
    """
    if path.is_dir():
        beside = sorted(f for f in path.iterdir() if f.is_file())
        found = [file for f in beside if is_directory(f) for file in _recorded(f)[0]]
        if not any(is_directory(file) or _is_dicom(file) for file in beside):
            found = _below(path)
        return sorted({*beside, *found})
    return sorted({path, *_recorded(path)[0]}) if is_directory(path) else [path]


def is_directory(path: Path) -> bool:
    """Whether a file is a DICOMDIR by its name, which the standard fixes."""
    return path.name.upper() == "DICOMDIR" and path.is_file()


def _is_dicom(file: Path) -> bool:
    """Whether a file begins as DICOM files do."""
    with file.open("rb") as stream:
        return stream.read(132)[128:] == b"DICM"


def _below(folder: Path) -> list[Path]:
    """Files of the folders below one, but for hidden ones. Raises InputRefused for more than `_MANY`."""
    found: list[Path] = []
    for file in folder.rglob("*"):
        if file.is_file() and not any(part.startswith(".") for part in file.relative_to(folder).parts):
            found.append(file)
            if len(found) > _MANY:
                raise InputRefused(f"{folder} has more than {_MANY} files below it; name the folder of one scan.")
    return found


def find_series(path: Path, wanted: str | int | None = None) -> Series:
    """The one series of volume images of a folder or file; `wanted`: its UID, number or description.

    Raises InputRefused when there is none, or several of which none or more than one is wanted.
    """
    aside: dict[Path, str] = {}
    aside_of: Counter[str] = Counter()
    groups: dict[str, list[Header]] = {}
    missing = 0
    for file in dicom_files(path):
        if is_directory(file):
            missing += _recorded(file)[1]
            continue
        header = read_header(file)
        reason = _NO_DICOM if header is None else _aside(header)
        uid = "" if header is None else header.text("SeriesInstanceUID")
        if reason or header is None:
            aside[file] = reason
            aside_of[uid] += 1
        else:
            groups.setdefault(uid, []).append(header)
    all_series = [Series(tuple(images)) for images in groups.values()]
    chosen = _choose(all_series, aside, wanted, path)
    said = _said(aside, [series for series in all_series if series is not chosen], path)
    if missing:
        said = (*said, f"{path.name}: {missing} of the files that its DICOMDIR records are not there.")
    return Series(chosen.images, said, aside_of[chosen.images[0].text("SeriesInstanceUID")])


def _aside(header: Header) -> str:
    """Why a file is no image of a volume, "" when it may be one."""
    modality = header.text("Modality") or "CT"
    if header.text("SOPClassUID") == MediaStorageDirectoryStorage:
        return "DICOMDIR of another name"
    if "Rows" not in header or modality not in CT_LIKE:
        return f"{modality} object"
    if header.whole("SamplesPerPixel", 1, 4, 1) != 1:
        return _COLOUR
    if "LOCALIZER" in header.text("ImageType").upper().split("\\"):
        return _LOCALIZER
    return _PROJECTIONS if _is_projection(header) else ""


def _is_projection(header: Header) -> bool:
    """Whether a file of an X-ray system holds views from one or many angles, which have no place in space."""
    x_ray = header.text("SOPClassUID") in _X_RAY or header.text("Modality") in ("XA", "RF")
    groups = [header, *(group for name in _GROUPS for group in header.items(name)[:1])]
    return x_ray and not any(place in group for group in groups for place in _PLACES)


def _choose(found: list[Series], aside: dict[Path, str], wanted: str | int | None, path: Path) -> Series:
    listed = "; ".join(map(str, found))
    if wanted is not None:
        fitting = [series for series in found if series.is_called(str(wanted))]
        if len(fitting) == 1:
            return fitting[0]
        raise InputRefused(
            f"{path} holds {len(fitting) or 'no'} series called {str(wanted)!r}; "
            f"name one by its UID in [images]: {listed or 'there is no volume in it'}."
        )
    if not found:
        raise InputRefused(f"{path} {_nothing(aside)}.")
    volumes = [series for series in found if _may_be_volume(series)] or found
    if len(volumes) > 1:
        raise InputRefused(
            f"{path} holds {len(volumes)} series: {'; '.join(map(str, volumes))}; choose one by its UID, number or "
            'description in case.toml, as [images] ct_series = "..." (or cbct_inflated_series, cbct_deflated_series).'
        )
    return volumes[0]


def _is_single(series: Series) -> bool:
    return len(series.images) == 1 and series.images[0].whole("NumberOfFrames", 1, _MANY, 1) == 1


def _may_be_volume(series: Series) -> bool:
    """Whether it has several slices, and those in files of their own say where they lie, unlike pages of a report."""
    frames = max(image.whole("NumberOfFrames", 1, _MANY, 1) for image in series.images)
    return frames > 1 or (len(series.images) > 1 and any("ImagePositionPatient" in image for image in series.images))


def _nothing(aside: dict[Path, str]) -> str:
    """What is said of a folder without volume images: by what most of its DICOM files are."""
    reasons = Counter(reason for reason in aside.values() if reason != _NO_DICOM)
    if not reasons:
        return "holds no DICOM images; name the folder that holds the slices of one series"
    reason, n = reasons.most_common(1)[0]
    if reason == _PROJECTIONS:
        return f"holds X-ray projections ({_files(n)}), not a volume; export the volume reconstructed from them"
    if reason == _LOCALIZER:
        return f"holds localizers alone ({_files(n)}); export the slices of the scan"
    if reason == _COLOUR:
        return f"holds colour images ({_files(n)}); export the reconstructed slices"
    return f"is not CT: {reason} ({_files(n)}); export the CT or cone-beam series"


def _said(aside: dict[Path, str], others: list[Series], path: Path) -> tuple[str, ...]:
    """A sentence per reason, with up to three names."""
    reasons: dict[str, list[Path]] = {}
    for file, reason in aside.items():
        reasons.setdefault(reason, []).append(file)
    sentences = [f"{path.name}: left out as {reason}: {_names(files)}." for reason, files in reasons.items()]
    for series in others:
        what = _SINGLE if _is_single(series) else "another series"
        sentences.append(f"{path.name}: left out as {what}: {series}.")
    return tuple(sentences)


def _names(files: Sequence[Path]) -> str:
    more = f" and {len(files) - 3} more" if len(files) > 3 else ""
    return ", ".join(file.name for file in files[:3]) + more


def _files(n: int) -> str:
    return f"{n} file{'s' if n > 1 else ''}"


def _recorded(directory: Path) -> tuple[list[Path], int]:
    """Files that a DICOMDIR records and that are there, in lower case too as on copies of discs; how many are not."""
    header = read_header(directory)
    if header is None or "DirectoryRecordSequence" not in header:
        raise InputRefused(f"{directory} is not a readable DICOMDIR; remove it, or name the folder with the slices.")
    root = directory.parent.resolve()
    found, missing = [], 0
    for record in header.items("DirectoryRecordSequence"):
        parts = [part for part in record.text("ReferencedFileID").split("\\") if part]
        tried = [directory.parent.joinpath(*names) for names in (parts, [part.lower() for part in parts])]
        there = [file for file in tried if file.is_file() and file.resolve().is_relative_to(root)]
        found += there[:1]
        missing += bool(parts) and not there
    return found, missing
