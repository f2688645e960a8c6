"""RT Structure Set: closed planar contours, filled on the slices of a CT by the even-odd rule.

Ref: DICOM PS3.3, C.8.8.5 (structure set), C.8.8.6 (contours).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from registration.volume import Array, Grid
from vatsloc.errors import InputRefused
from vatsloc.formats.dicom.header import Header

OFF_PLANE = 0.05
"""Share of a voxel by which the points of a contour may leave its plane."""


def read_structures(header: Header, grid: Grid, check_frame: Callable[[str], None]) -> Iterator[tuple[int, str, Array]]:
    """Number, name and voxels on the grid of each ROI that has closed contours.

    check_frame: raises for a frame of reference that is not the CT's. Raises InputRefused for a set without contours,
    contours that are malformed or not parallel to slices of the grid.
    """
    contours = {
        item.whole("ReferencedROINumber", 0, 65535): _closed(item) for item in header.items("ROIContourSequence")
    }
    found = False
    for roi in header.items("StructureSetROISequence"):
        number = roi.whole("ROINumber", 0, 65535)
        points = contours.get(number, [])
        if not points:
            continue
        found = True
        check_frame(roi.text("ReferencedFrameOfReferenceUID"))
        name = roi.text("ROIName")
        yield number, name, filled(points, grid, f"{header.file}, structure {name or number},")
    if not found:
        raise InputRefused(f"{header.file} holds no closed contours; draw the nodule's outline on the CT's slices.")


def _closed(roi: Header) -> list[Array]:
    """Contours of a ROI, (n, 3) LPS mm each."""
    found = []
    for contour in roi.items("ContourSequence"):
        if contour.text("ContourGeometricType") not in ("CLOSED_PLANAR", "CLOSEDPLANAR_XOR"):
            continue
        n = contour.whole("NumberOfContourPoints", 1, 1_000_000)
        points = contour.numbers("ContourData", 3 * n).reshape(n, 3)
        if n > 2:  # a click without an outline
            found.append(points)
    return found


def filled(contours: list[Array], grid: Grid, what: str) -> Array:
    """Voxels (grid.shape) whose centres lie within closed contours (n, 3) LPS mm of one region.

    Contours of one plane together follow the even-odd rule, so that one inside another is a hole. A slice takes the
    nearest plane within half the distance between planes. Raises InputRefused, about `what`, when contours are not
    parallel to one kind of slice of the grid.
    """
    in_voxels = [grid.to_ijk(points * [-1.0, -1.0, 1.0]) for points in contours]
    spread = np.max([np.ptp(points, axis=0) for points in in_voxels], axis=0)
    across = int(np.argmin(spread))
    if spread[across] > OFF_PLANE:
        raise InputRefused(
            f"{what} has contours that cross slices of the CT by up to {spread[across]:.2f} voxels; "
            "draw them on the CT's slices."
        )
    places = np.array([points[:, across].mean() for points in in_voxels])
    planes = np.unique(places.round(2))
    reach = max(0.5, float(np.median(np.diff(planes))) / 2 if len(planes) > 1 else 0.0) + OFF_PLANE
    u, v = (axis for axis in range(3) if axis != across)
    inside = np.zeros(grid.shape, dtype=bool)
    slices = np.moveaxis(inside, across, 0)
    drawn: dict[float, Array] = {}
    for k in range(grid.shape[across]):
        plane = float(planes[np.argmin(np.abs(planes - k))])
        if abs(plane - k) > reach:
            continue
        if plane not in drawn:
            loops = [p[:, [u, v]] for p, at in zip(in_voxels, places, strict=True) if abs(at - plane) <= 0.01]
            drawn[plane] = even_odd(loops, (grid.shape[u], grid.shape[v]))
        slices[k] = drawn[plane]
    return inside


def even_odd(loops: list[Array], shape: tuple[int, int]) -> Array:
    """Pixels (nu, nv) whose centres lie within an odd number of closed loops (n, 2) in pixels.

    Each edge flips all pixels beyond it along the second axis, in the lines that it crosses.
    """
    flips = np.zeros((shape[0], shape[1] + 1), dtype=bool)
    for loop in loops:
        for a, b in zip(loop, np.roll(loop, -1, axis=0), strict=True):
            low, high = (a, b) if a[0] <= b[0] else (b, a)
            lines = np.arange(max(0, int(np.ceil(low[0]))), min(shape[0], int(np.ceil(high[0]))))
            if lines.size:
                at = low[1] + (lines - low[0]) / (high[0] - low[0]) * (high[1] - low[1])
                flips[lines, np.clip(np.ceil(at), 0, shape[1]).astype(int)] ^= True
    return np.logical_xor.accumulate(flips, axis=1)[:, :-1]
