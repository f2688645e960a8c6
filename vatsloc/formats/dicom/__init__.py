"""DICOM: one series of slices or of multi-frame files, stacked by position along the slice normal.

`series` finds the files, `complete` says whether all of them are there, `frames` where their slices lie, `pixels` what
their values are; `upright` undoes a tilted gantry, `header` guards every value that is read. Ref: DICOM PS3.3.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from vatsloc.errors import InputRefused
from vatsloc.formats.dicom.complete import missing_ends
from vatsloc.formats.dicom.frames import Frame, frames_of, lattice
from vatsloc.formats.dicom.header import Header
from vatsloc.formats.dicom.pixels import PADDING_HU, Scale, check_pixels, scale_of, stored_pixels
from vatsloc.formats.dicom.series import dicom_files, find_series, is_directory
from vatsloc.formats.dicom.upright import is_tilted, tilt_degrees, upright
from vatsloc.formats.guard import guarded
from vatsloc.formats.raw import RawImage
from vatsloc.frames import flip_affine

__all__ = ["PADDING_HU", "dicom_files", "frame_of_reference", "is_directory", "read_dicom"]


@guarded("DICOM image")
def read_dicom(path: Path, series: str | int | None = None) -> RawImage:
    """Image in HU from a folder, a DICOMDIR or a file; `series`: UID, number or description of the one to take.

    What was left out, and slices that may be missing at an end, are in its `warnings`. Raises InputRefused for files
    that cannot be read or decoded, several series of which none is chosen, projections, slices that are missing,
    doubled, shifted or unevenly spaced, and every malformed value of a header.
    """
    found = find_series(path, series)
    for image in found.images:
        check_pixels(image)
    frames = sorted(frames_of(found.images, path), key=lambda frame: frame.place)
    lps_from_ijk = lattice(frames, path, found.left_out)
    scales = [scale_of(frame.header, frame.rescale) for frame in frames]
    _check_one_scale(frames, scales)
    first = frames[0].header
    shape = first.whole("Rows", 1, 65535), first.whole("Columns", 1, 65535)
    hu = np.empty((len(frames), *shape), dtype=np.float32)
    by_file: dict[Path, list[int]] = {}
    for k, frame in enumerate(frames):
        by_file.setdefault(frame.header.file, []).append(k)
    headers = {frame.header.file: frame.header for frame in frames}
    for file, stored in zip(by_file, stored_pixels([headers[file] for file in by_file]), strict=True):
        for k in by_file[file]:
            hu[k] = scales[k](stored[frames[k].index])
    warnings = [*found.left_out, *missing_ends(found.images, found.n_aside, path), *_loss(first, path)]
    if is_tilted(lps_from_ijk):
        tilt = tilt_degrees(lps_from_ijk)
        hu, lps_from_ijk = upright(hu, lps_from_ijk, PADDING_HU)
        warnings.append(f"{path.name}: its slices, of a gantry tilted by {tilt:.1f} degrees, were put upright.")
    return RawImage(hu.T, flip_affine(lps_from_ijk), path, warnings=tuple(warnings))


@guarded("DICOM image")
def frame_of_reference(path: Path, series: str | int | None = None) -> str:
    """FrameOfReferenceUID of the image of a folder or file, "" where it states none."""
    return find_series(path, series).images[0].text("FrameOfReferenceUID")


def _check_one_scale(frames: list[Frame], scales: list[Scale]) -> None:
    """Raise InputRefused for a slice that states its HU in another way than most of its series, or not at all."""
    usual = Counter(scale.stated for scale in scales).most_common(1)[0][0]
    for frame, scale in zip(frames, scales, strict=True):
        if scale.stated != usual:
            raise InputRefused(
                f"{frame.header.file} states {scale.stated or 'no rescale'}, {usual or 'no rescale'} elsewhere in its "
                "series; export the whole series again."
            )


def _loss(header: Header, path: Path) -> list[str]:
    if header.text("LossyImageCompression") != "01":
        return []
    return [f"{path.name}: its grey values were compressed with loss, so small detail may be missing."]
