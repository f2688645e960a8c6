"""DICOM: a folder with one series of slices, or one multi-frame file, stacked by position along the slice normal.

Ref: DICOM PS3.3, C.7.6.2 (image plane), C.7.6.16 (functional groups), C.11.1 (rescale to HU).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
from pydicom.dataset import Dataset
from pydicom.errors import InvalidDicomError

from registration.volume import Array
from vatsloc.errors import InputRefused
from vatsloc.formats.raw import RawImage
from vatsloc.frames import flip_affine

CT_LIKE = ("CT", "XA", "RF", "OT")
"""Modalities under which scanners and C-arms store reconstructed volumes."""

UNEVEN_SHARE, UNEVEN_MM = 0.05, 0.05
"""A slice may lie this share of the spacing, or this far where positions are rounded, off the even lattice."""

PADDING_HU = -1024.0
"""Stands in for voxels outside the reconstruction circle, which carry no measurement."""


@dataclass(frozen=True)
class _Frame:
    """One slice in LPS mm. position: centre of its first pixel; along_row, along_column: unit vectors, (3,).

    spacing: (2,), between rows and between columns; hu = slope * pixels + intercept; padding: a pixel value without
    meaning.
    """

    position: Array
    along_row: Array
    along_column: Array
    spacing: Array
    slope: float
    intercept: float
    pixels: Callable[[], Array]
    padding: float | None

    @property
    def place(self) -> float:
        """Position along the slice normal, mm."""
        return float(np.cross(self.along_row, self.along_column) @ self.position)


def read_dicom(path: Path) -> RawImage:
    """Image in HU from a folder or a multi-frame file.

    Raises InputRefused for unreadable files, several series in one folder, slices that are missing, doubled or unevenly
    spaced, and files without position, orientation or pixel spacing.
    """
    headers = _headers(path)
    if len(headers) == 1 and int(headers[0][1].get("NumberOfFrames", 1)) > 1:
        file, header = headers[0]
        frames = _frames_of_multiframe(file, header)
    elif any(int(header.get("NumberOfFrames", 1)) > 1 for _, header in headers):
        raise InputRefused(
            f"{path} holds {len(headers)} files of which some are multi-frame; keep one image per folder."
        )
    else:
        _check_one_series(headers, path)
        frames = [_frame_of_slice(file, header) for file, header in headers]
    return _stack(frames, (int(headers[0][1].Rows), int(headers[0][1].Columns)), path)


def _headers(path: Path) -> list[tuple[Path, Dataset]]:
    files = sorted(f for f in path.iterdir() if f.is_file()) if path.is_dir() else [path]
    found: list[tuple[Path, Dataset]] = []
    for file in files:
        try:
            header: Dataset = pydicom.dcmread(file, stop_before_pixels=True)
        except InvalidDicomError:
            continue  # notes and previews lie beside slices; a damaged slice shows as a gap
        except Exception as error:
            raise InputRefused(f"{file} is not a readable DICOM file ({error}); copy or export it again.") from error
        if "Rows" in header:
            found.append((file, header))
    if not found:
        raise InputRefused(f"{path} holds no DICOM images; name the folder that holds the slices of one series.")
    for file, header in found:
        modality = str(header.get("Modality", "CT"))
        if modality not in CT_LIKE:
            raise InputRefused(f"{file} is {modality}, not CT; export the CT or cone-beam series.")
        if int(header.get("SamplesPerPixel", 1)) != 1:
            raise InputRefused(f"{file} is a colour image; export the reconstructed slices.")
    return found


def _check_one_series(headers: list[tuple[Path, Dataset]], path: Path) -> None:
    for word, tag in (("series", "SeriesInstanceUID"), ("frames of reference", "FrameOfReferenceUID")):
        n = len({str(header.get(tag, "")) for _, header in headers})
        if n > 1:
            raise InputRefused(f"{path} mixes {n} {word}; keep the slices of one series in the folder.")
    sizes = sorted({f"{header.Columns} x {header.Rows}" for _, header in headers})
    if len(sizes) > 1:
        raise InputRefused(f"{path} mixes slices of {' and '.join(sizes)} pixels; keep one series (no scout views).")


def _frame_of_slice(file: Path, header: Dataset) -> _Frame:
    def pixels() -> Array:
        return _pixel_array(file)

    position = _needed(header, "ImagePositionPatient", 3, file)
    return _frame(file, header, position, header, header, header, pixels)


def _frames_of_multiframe(file: Path, header: Dataset) -> list[_Frame]:
    n = int(header.NumberOfFrames)
    stack = _pixel_array(file)
    if stack.ndim != 3 or len(stack) != n:
        raise InputRefused(f"{file} has pixels of shape {stack.shape} for {n} frames; export it again.")
    frames = []
    for k in range(n):
        orientation = _group(header, k, "PlaneOrientationSequence")
        measures = _group(header, k, "PixelMeasuresSequence")
        rescale = _group(header, k, "PixelValueTransformationSequence")
        if "PerFrameFunctionalGroupsSequence" in header:
            position = _needed(_group(header, k, "PlanePositionSequence"), "ImagePositionPatient", 3, file)
        else:
            position = _position_by_offset(header, k, file)
        frames.append(_frame(file, header, position, orientation, measures, rescale, partial(stack.__getitem__, k)))
    return frames


def _position_by_offset(header: Dataset, k: int, file: Path) -> Array:
    """Position of frame k where only the first one is stated: along the normal by offset vector or by spacing."""
    axes = _needed(header, "ImageOrientationPatient", 6, file)
    if "GridFrameOffsetVector" in header:
        offset = float(header.GridFrameOffsetVector[k])
    else:
        offset = k * float(_needed(header, "SpacingBetweenSlices", 1, file)[0])
    return _needed(header, "ImagePositionPatient", 3, file) + offset * np.cross(axes[:3], axes[3:])


def _group(header: Dataset, k: int, name: str) -> Dataset:
    """Functional group of frame k, shared or its own; the header itself in files without functional groups."""
    if "PerFrameFunctionalGroupsSequence" in header and name in header.PerFrameFunctionalGroupsSequence[k]:
        return header.PerFrameFunctionalGroupsSequence[k][name][0]
    if "SharedFunctionalGroupsSequence" in header and name in header.SharedFunctionalGroupsSequence[0]:
        return header.SharedFunctionalGroupsSequence[0][name][0]
    return header


def _frame(
    file: Path,
    header: Dataset,
    position: Array,
    orientation: Dataset,
    measures: Dataset,
    rescale: Dataset,
    pixels: Callable[[], Array],
) -> _Frame:
    axes = _needed(orientation, "ImageOrientationPatient", 6, file)
    spacing = _needed(measures, "PixelSpacing", 2, file)
    padding = header.get("PixelPaddingValue")
    return _Frame(
        position,
        axes[:3],
        axes[3:],
        spacing,
        float(rescale.get("RescaleSlope", 1.0)),
        float(rescale.get("RescaleIntercept", 0.0)),
        pixels,
        None if padding is None else float(padding),
    )


def _stack(frames: list[_Frame], shape: tuple[int, int], path: Path) -> RawImage:
    if len(frames) < 2:
        raise InputRefused(f"{path} holds one slice, at least 2 needed; name the folder with the whole series.")
    first = frames[0]
    for frame in frames:
        same = np.allclose(frame.along_row, first.along_row, atol=1e-3)
        same = same and np.allclose(frame.along_column, first.along_column, atol=1e-3)
        if not (same and np.allclose(frame.spacing, first.spacing, rtol=1e-3)):
            raise InputRefused(f"{path} mixes slices of different orientation or pixel size; keep one series.")
    frames = sorted(frames, key=lambda frame: frame.place)
    _check_even([frame.place for frame in frames], path)
    lps_from_ijk = np.eye(4)
    lps_from_ijk[:3, 0] = first.along_row * first.spacing[1]
    lps_from_ijk[:3, 1] = first.along_column * first.spacing[0]
    # First to last slice, not the normal, so that a gantry tilt shows as shear.
    lps_from_ijk[:3, 2] = (frames[-1].position - frames[0].position) / (len(frames) - 1)
    lps_from_ijk[:3, 3] = frames[0].position
    hu = np.empty((len(frames), *shape), dtype=np.float32)
    for k, frame in enumerate(frames):
        pixels = frame.pixels()
        hu[k] = pixels * np.float32(frame.slope) + np.float32(frame.intercept)
        if frame.padding is not None:
            hu[k][pixels == frame.padding] = PADDING_HU
    return RawImage(hu.T, flip_affine(lps_from_ijk), path)


def _check_even(places: list[float], path: Path) -> None:
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
        )
    even = np.linspace(places[0], places[-1], len(places))
    off = float(np.abs(np.asarray(places) - even).max())
    if off > max(UNEVEN_SHARE * usual, UNEVEN_MM):
        raise InputRefused(
            f"{path} has unevenly spaced slices ({gaps.min():.2f} to {gaps.max():.2f} mm apart); "
            "export a reconstruction of even spacing."
        )


def _pixel_array(file: Path) -> Array:
    try:
        return np.asarray(pydicom.dcmread(file).pixel_array)
    except Exception as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
        raise InputRefused(f"{file} has pixels that cannot be decoded ({reason}); export it uncompressed.") from error


def _needed(header: Dataset, name: str, n: int, file: Path) -> Array:
    value: Any = header.get(name)
    numbers = np.empty(0) if value is None else np.atleast_1d(np.asarray(value, dtype=float))
    if numbers.shape != (n,) or not np.isfinite(numbers).all():
        raise InputRefused(f"{file} states no {name}; export it with its position in space.")
    return numbers
