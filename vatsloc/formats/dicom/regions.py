"""Regions drawn on a CT: DICOM Segmentation and RT Structure Set, both as label images with named segments.

Ref: DICOM PS3.3, A.51 (segmentation), C.8.20 (segments), A.19 (structure set).
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from registration.volume import Array, Grid
from vatsloc.errors import InputRefused
from vatsloc.formats.dicom.contours import read_structures
from vatsloc.formats.dicom.frames import MAX_FRAMES, Frame, check_alike, frames_of_file
from vatsloc.formats.dicom.header import Header, read_header
from vatsloc.formats.dicom.pixels import stored_pixels
from vatsloc.formats.guard import guarded
from vatsloc.formats.raw import RawImage, Segment
from vatsloc.frames import flip_affine

_KINDS = ("SEG", "RTSTRUCT")
OFF_LATTICE = 0.05
"""Share of the spacing by which a frame may lie off the others' lattice."""
MAX_SLICES = 10_000


@guarded("file", "check its permissions")
def holds_regions(path: Path) -> bool:
    """Whether a file is a DICOM Segmentation or RT Structure Set; False for folders and all other files."""
    try:
        if not path.is_file():
            return False
    except (OSError, ValueError):  # a name that no file can have, which is refused where the file is read
        return False
    with path.open("rb") as file:
        if file.read(132)[128:] != b"DICM":
            return False
    header = read_header(path)
    return header is not None and header.text("Modality") in _KINDS


@guarded("DICOM segmentation")
def read_regions(path: Path, grid: Grid | None = None, frame_of_reference: str = "") -> RawImage:
    """Label image with named segments; those that overlap lie in layers of their own, (ni, nj, nk, layers).

    A Segmentation comes on its own lattice, a Structure Set on `grid`, the CT's, whose slices its contours must lie in.
    frame_of_reference: the CT's, "" where it is not known. Raises InputRefused when the file's own is another, and
    for everything malformed.
    """
    header = read_header(path)
    kind = "" if header is None else header.text("Modality")
    if header is None or kind not in _KINDS:
        raise InputRefused(f"{path} is no DICOM Segmentation or Structure Set; name the file with the nodule's region.")
    if kind == "SEG":
        _check_frame(header.text("FrameOfReferenceUID"), frame_of_reference, path)
        return _read_segmentation(header)
    if grid is None:
        raise InputRefused(f"{path} is a Structure Set, which only a CT gives voxels; name it as a mask of a case.")
    regions = read_structures(header, grid, lambda uid: _check_frame(uid, frame_of_reference, path))
    values, segments = layered(regions, grid.shape)
    return RawImage(values, grid.ras_from_ijk, path, segments)


def _check_frame(own: str, ct: str, path: Path) -> None:
    if own and ct and own != ct:
        raise InputRefused(
            f"{path} was drawn in another frame of reference ({own}) than the CT's ({ct}); "
            "use the region drawn on this CT, or this region's CT."
        )


def layered(regions: Iterable[tuple[int, str, Array]], shape: tuple[int, ...]) -> tuple[Array, tuple[Segment, ...]]:
    """Label image of regions (label, name, inside) and their segments; more than one layer only where they overlap."""
    layers: list[Array] = []
    segments: list[Segment] = []
    for label, name, inside in regions:
        free = [n for n, layer in enumerate(layers) if not layer[inside].any()]
        if not free:
            layers.append(np.zeros(shape, dtype=np.uint16))
        n = free[0] if free else len(layers) - 1
        layers[n][inside] = label
        segments.append(Segment(label, name, n))
    values = layers[0] if len(layers) == 1 else np.stack(layers or [np.zeros(shape, dtype=np.uint16)], axis=-1)
    return values, tuple(segments)


def _read_segmentation(header: Header) -> RawImage:
    header.whole("NumberOfFrames", 1, MAX_FRAMES)
    frames = frames_of_file(header)
    check_alike(frames, header.file)
    lps_from_ijk, index = _lattice(frames)
    names = {
        item.whole("SegmentNumber", 0, 65535): item.text("SegmentLabel") for item in header.items("SegmentSequence")
    }
    pixels = next(stored_pixels([header]))
    shape = (*pixels.shape[:0:-1], int(index.max()) + 2)
    if header.text("SegmentationType") == "LABELMAP":
        if len(set(index.tolist())) < len(index):
            raise InputRefused(f"{header.file} has two label maps at the same place; export the segmentation again.")
        values = np.zeros(shape, dtype=np.uint16)
        for k, frame in zip(index, pixels, strict=True):
            values[:, :, k] = frame.T
        segments = tuple(Segment(n, name) for n, name in names.items() if n)
        return RawImage(values, flip_affine(lps_from_ijk), header.file, segments)
    numbers = _numbers(header, len(frames))
    absent = sorted(set(numbers) - set(names))
    if absent:
        raise header.wrong("SegmentSequence", f"segments {sorted(names)}", f"{absent} by its frames")
    half = (
        header.whole("MaximumFractionalValue", 1, 255) / 2 if header.text("SegmentationType") == "FRACTIONAL" else 0.5
    )

    def regions() -> Iterable[tuple[int, str, Array]]:
        for n in sorted(set(numbers)):
            inside = np.zeros(shape, dtype=bool)
            for k, own, frame in zip(index, numbers, pixels, strict=True):
                if own == n:
                    inside[:, :, k] |= np.greater_equal(frame.T, half)
            yield n, names[n], inside

    values, segments = layered(regions(), shape)
    return RawImage(values, flip_affine(lps_from_ijk), header.file, segments)


def _numbers(header: Header, n: int) -> list[int]:
    """The segment of each frame."""
    numbers = []
    shared = header.items("SharedFunctionalGroupsSequence")[:1]
    own = header.items("PerFrameFunctionalGroupsSequence")
    for k in range(n):
        found = [item for place in [*own[k : k + 1], *shared] for item in place.items("SegmentIdentificationSequence")]
        if not found:
            raise InputRefused(f"{header.file} states no segment for frame {k + 1}; export the segmentation again.")
        numbers.append(found[0].whole("ReferencedSegmentNumber", 1, 65535))
    return numbers


def _lattice(frames: list[Frame]) -> tuple[Array, Array]:
    """lps_from_ijk (4, 4) and each frame's slice (n,), from 1; slices without a region have no frame, so gaps stay.

    Raises InputRefused for frames beside each other's pixels, or between the slices of a lattice.
    """
    first = min(frames, key=lambda frame: frame.place)
    places = np.array([frame.place for frame in frames]) - first.place
    distinct = np.unique(places.round(3))
    groups = first.header.items("SharedFunctionalGroupsSequence")[:1]
    stated = [m for group in groups for m in group.items("PixelMeasuresSequence")]
    spacing = 0.0
    for name in ("SpacingBetweenSlices", "SliceThickness"):
        if not spacing and stated and name in stated[0]:
            spacing = stated[0].number(name)
    gap = float(np.diff(distinct).min()) if len(distinct) > 1 else 0.0
    if gap and (spacing <= 0 or abs(gap / spacing - round(gap / spacing)) > OFF_LATTICE or gap < spacing / 2):
        spacing = gap
    if spacing <= 0:
        raise InputRefused(
            f"{first.header.file} states no SpacingBetweenSlices; export it again with its whole header."
        )
    index = np.rint(places / spacing).astype(int)
    step = first.normal * spacing
    off = np.array([frame.position - first.position - k * step for frame, k in zip(frames, index, strict=True)])
    furthest = float(np.linalg.norm(off, axis=1).max())
    if furthest > OFF_LATTICE * max(spacing, float(first.spacing.max())) or index.max() >= MAX_SLICES:
        raise InputRefused(
            f"{first.header.file} has frames that lie {furthest:.2f} mm off a lattice of {spacing:g} mm; "
            "export it on the slices of its CT."
        )
    lps_from_ijk = np.eye(4)
    lps_from_ijk[:3, 0] = first.along_row * first.spacing[1]
    lps_from_ijk[:3, 1] = first.along_column * first.spacing[0]
    lps_from_ijk[:3, 2] = step
    lps_from_ijk[:3, 3] = first.position - step  # an empty slice on either side, so that one slice has a thickness
    return lps_from_ijk, index + 1
