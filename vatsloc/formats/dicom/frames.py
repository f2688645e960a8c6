"""Where each slice lies: by its own header, or by the functional groups of a multi-frame file.

Ref: DICOM PS3.3, C.7.6.2 (image plane), C.7.6.16 (functional groups), C.8.21 (X-ray 3D reconstruction).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from registration.volume import Array
from vatsloc.errors import InputRefused
from vatsloc.formats.dicom.complete import check_concatenations, parts_of
from vatsloc.formats.dicom.header import Header

MAX_FRAMES = 100_000
_GROUPS = ("SharedFunctionalGroupsSequence", "XRay3DReconstructionSequence")

UNEVEN_SHARE, UNEVEN_MM = 0.05, 0.05
"""A slice may lie this share of the spacing, or this far where positions are rounded, off the even lattice."""
_SAME_AXES = 1e-3


@dataclass(frozen=True)
class Frame:
    """One slice in LPS mm. position: centre of its first pixel; along_row, along_column: unit vectors, (3,).

    spacing: (2,), between rows and between columns; rescale: where its slope and intercept are stated; index: within
    its file.
    """

    header: Header
    index: int
    position: Array
    along_row: Array
    along_column: Array
    spacing: Array
    rescale: Header

    @property
    def normal(self) -> Array:
        """Unit vector across the slice, (3,)."""
        return np.cross(self.along_row, self.along_column)

    @property
    def place(self) -> float:
        """Position along the slice normal, mm."""
        return float(self.normal @ self.position)


def frames_of(images: Sequence[Header], path: Path) -> list[Frame]:
    """Slices of a series, each of its own file or several of a multi-frame file; unsorted.

    Several multi-frame files are one volume where they are parts of one concatenation, or where their slices make one
    even lattice. Raises InputRefused for files that do not belong together and for missing or malformed positions.
    """
    counts = [image.whole("NumberOfFrames", 1, MAX_FRAMES, 1) for image in images]
    frames_of_reference = {image.text("FrameOfReferenceUID") for image in images}
    if len(frames_of_reference) > 1:
        raise InputRefused(
            f"{path} mixes {len(frames_of_reference)} frames of reference; keep the slices of one series in the folder."
        )
    frames = [frame for image in images for frame in frames_of_file(image)]
    check_concatenations(images, path)
    if len(images) > 1 and max(counts) > 1:
        parts = parts_of(images)
        try:
            lattice(sorted(frames, key=lambda frame: frame.place), path)
        except InputRefused as refusal:
            if len(parts) == 1:
                raise
            raise InputRefused(
                f"{path} holds several volumes in one series: {'; '.join(parts)}; name one file in [images], or keep "
                "the files of one volume in the folder."
            ) from refusal
    return frames


def frames_of_file(header: Header) -> list[Frame]:
    """Frames of a file, in its order."""
    n = header.whole("NumberOfFrames", 1, MAX_FRAMES, 1)
    own = header.items("PerFrameFunctionalGroupsSequence")
    if own and len(own) != n:
        raise header.wrong("PerFrameFunctionalGroupsSequence", f"{len(own)} items", f"{n} by NumberOfFrames")
    shared = [item for name in _GROUPS for item in header.items(name)[:1]]
    frames = []
    for k in range(n):
        places = [*own[k : k + 1], *shared]
        orientation = _group(header, places, "PlaneOrientationSequence", "ImageOrientationPatient")
        measures = _group(header, places, "PixelMeasuresSequence", "PixelSpacing")
        rescale = _group(header, places, "PixelValueTransformationSequence", "RescaleSlope")
        own_place = _group(header, own[k : k + 1], "PlanePositionSequence", "ImagePositionPatient")
        if own_place is not header:
            position = own_place.numbers("ImagePositionPatient", 3)
        else:
            first = _group(header, shared, "PlanePositionSequence", "ImagePositionPatient")
            position = _position_by_offset(header, k, n, first, orientation, measures)
        frames.append(_frame(header, k, position, (orientation, measures, rescale)))
    return frames


def _group(header: Header, places: Sequence[Header], group: str, name: str) -> Header:
    """The first of `places` that holds an attribute, in a functional group or by itself; else the header itself."""
    for place in places:
        items = place.items(group)
        if items:
            return items[0]
        if name in place:
            return place
    return header


def _position_by_offset(header: Header, k: int, n: int, first: Header, orientation: Header, measures: Header) -> Array:
    """Position of frame k where only the first one is stated: along the normal by offset vector or by spacing."""
    axes = orientation.numbers("ImageOrientationPatient", 6)
    if n == 1:
        offset = 0.0
    elif "GridFrameOffsetVector" in header:
        offset = float(header.numbers("GridFrameOffsetVector", n)[k])
    else:
        stated = header if "SpacingBetweenSlices" in header else measures
        spacing = stated.number("SpacingBetweenSlices")
        if spacing <= 0:
            raise stated.wrong("SpacingBetweenSlices", f"{spacing:g}", "a positive number")
        offset = k * spacing
    return first.numbers("ImagePositionPatient", 3) + offset * np.cross(axes[:3], axes[3:])


def _frame(header: Header, k: int, position: Array, groups: tuple[Header, Header, Header]) -> Frame:
    """groups: where orientation, pixel spacing and rescale are stated."""
    orientation, measures, rescale = groups
    axes = orientation.numbers("ImageOrientationPatient", 6)
    row, column = axes[:3], axes[3:]
    lengths = float(np.linalg.norm(row)), float(np.linalg.norm(column))
    if max(abs(lengths[0] - 1), abs(lengths[1] - 1), abs(float(row @ column))) > _SAME_AXES:
        raise orientation.wrong("ImageOrientationPatient", axes.tolist(), "two unit vectors at a right angle")
    spacing = measures.numbers("PixelSpacing", 2)
    if spacing.min() <= 0:
        raise measures.wrong("PixelSpacing", spacing.tolist(), "2 positive numbers")
    return Frame(header, k, position, row / lengths[0], column / lengths[1], spacing, rescale)


def lattice(frames: Sequence[Frame], path: Path, left_out: Sequence[str] = ()) -> Array:
    """lps_from_ijk (4, 4) mm of slices that are sorted by their place. left_out: what may explain a gap.

    Raises InputRefused unless they are alike, evenly spaced and each straight behind the last. All of them shifted by
    the same step, as under a tilted gantry, stay a sheared lattice.
    """
    if len(frames) < 2:
        raise InputRefused(f"{path} holds one slice, at least 2 needed; name the folder with the whole series.")
    check_alike(frames, path)
    first, last = frames[0], frames[-1]
    _check_even([frame.place for frame in frames], path, left_out)
    positions = np.array([frame.position for frame in frames])
    straight = np.linspace(first.position, last.position, len(frames))
    sideways = positions - straight - np.outer((positions - straight) @ first.normal, first.normal)
    furthest = np.linalg.norm(sideways, axis=1)
    if furthest.max() > max(UNEVEN_SHARE * float(first.spacing.min()), UNEVEN_MM):
        k = int(np.argmax(furthest))
        raise InputRefused(
            f"{path} has slices that shift sideways, the one at {frames[k].place:.1f} mm by {furthest[k]:.2f} mm; "
            "export a reconstruction of one field of view."
        )
    lps_from_ijk = np.eye(4)
    lps_from_ijk[:3, 0] = first.along_row * first.spacing[1]
    lps_from_ijk[:3, 1] = first.along_column * first.spacing[0]
    # First to last slice, not the normal, so that a gantry tilt shows as shear.
    lps_from_ijk[:3, 2] = (last.position - first.position) / (len(frames) - 1)
    lps_from_ijk[:3, 3] = first.position
    return lps_from_ijk


def check_alike(frames: Sequence[Frame], path: Path) -> None:
    """Raise InputRefused unless all slices have one size, orientation and pixel size."""
    first = frames[0]
    sizes = sorted({f"{f.header.whole('Columns', 1, 65535)} x {f.header.whole('Rows', 1, 65535)}" for f in frames})
    if len(sizes) > 1:
        raise InputRefused(f"{path} mixes slices of {' and '.join(sizes)} pixels; keep one series (no scout views).")
    for frame in frames:
        same = np.allclose(frame.along_row, first.along_row, atol=_SAME_AXES)
        same = same and np.allclose(frame.along_column, first.along_column, atol=_SAME_AXES)
        if not (same and np.allclose(frame.spacing, first.spacing, rtol=1e-3)):
            raise InputRefused(f"{path} mixes slices of different orientation or pixel size; keep one series.")


def _check_even(places: list[float], path: Path, left_out: Sequence[str]) -> None:
    gaps = np.diff(places)
    usual = float(np.median(gaps))
    if gaps.min() < 0.01:
        at = places[int(np.argmin(gaps))]
        raise InputRefused(
            f"{path} has two slices at the same place ({at:.1f} mm); keep one phase of one reconstruction."
        )
    if gaps.max() > 1.5 * usual:
        k = int(np.argmax(gaps))
        raise InputRefused(
            f"{path} misses slices between {places[k]:.1f} and {places[k + 1]:.1f} mm "
            f"({gaps[k]:.2f} mm apart, {usual:.2f} mm elsewhere); export the whole series."
            + "".join(f" {sentence}" for sentence in left_out)
        )
    even = np.linspace(places[0], places[-1], len(places))
    off = float(np.abs(np.asarray(places) - even).max())
    if off > max(UNEVEN_SHARE * usual, UNEVEN_MM):
        raise InputRefused(
            f"{path} has unevenly spaced slices ({gaps.min():.2f} to {gaps.max():.2f} mm apart); "
            "export a reconstruction of even spacing."
        )
