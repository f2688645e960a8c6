"""Whether all of a series is there, and whether its files make one volume."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from vatsloc.errors import InputRefused
from vatsloc.formats.dicom.header import Header

_MANY = 100_000


def check_concatenations(images: Sequence[Header], path: Path) -> None:
    """Raise InputRefused where files of a concatenation, one image cut into several files, are missing.

    Ref: DICOM PS3.3, C.7.6.16.2.2.4.
    """
    for uid, parts in _concatenations(images).items():
        total = max(part.whole("InConcatenationTotalNumber", 1, _MANY, 1) for part in parts)
        if uid and total > len(parts):
            raise InputRefused(
                f"{path} holds {len(parts)} of the {total} files of one concatenated image; export the whole series."
            )


def parts_of(images: Sequence[Header]) -> list[str]:
    """What the files of a series hold that may each be a volume: concatenations, multi-frame files, single slices."""
    named = []
    for uid, files in _concatenations(images).items():
        frames = [file.whole("NumberOfFrames", 1, _MANY, 1) for file in files]
        if uid:
            named.append(f"{sum(frames)} slices in {len(files)} files from {files[0].file.name} on")
            continue
        named += [f"{n} slices in {file.file.name}" for file, n in zip(files, frames, strict=True) if n > 1]
        single = frames.count(1)
        named += [f"{single} file{'s' if single > 1 else ''} of one slice"] * bool(single)
    return named


def missing_ends(images: Sequence[Header], n_aside: int, path: Path) -> list[str]:
    """Sentences on slices that may be missing at the ends, where a gap cannot show it.

    By the number of images that the series states, and by slices numbered from more than 1. n_aside: files of the
    folder that were left out, which may be those.
    """
    if len(images) < 2:
        return []
    said = []
    for name in ("NumberOfSeriesRelatedInstances", "ImagesInAcquisition"):
        stated = {image.text(name) for image in images}
        n = int(stated.pop()) if len(stated) == 1 and next(iter(stated)).isdecimal() else 0
        if n > len(images) + n_aside:
            said.append(f"{path.name}: {len(images)} slices, {n} stated by {name}; slices may be missing at an end.")
            break
    numbers = sorted(int(number) for number in (image.text("InstanceNumber") for image in images) if number.isdecimal())
    distinct = len(numbers) == len(images) and len(set(numbers)) == len(numbers)
    if distinct and not said and 1 + n_aside < numbers[0] <= len(images):
        said.append(f"{path.name}: its slices are numbered from {numbers[0]}; slices may be missing at one end.")
    return said


def _concatenations(images: Sequence[Header]) -> dict[str, list[Header]]:
    """Images by the concatenation that they are part of, "" for those of none."""
    groups: dict[str, list[Header]] = {}
    for image in images:
        groups.setdefault(image.text("ConcatenationUID"), []).append(image)
    return groups
