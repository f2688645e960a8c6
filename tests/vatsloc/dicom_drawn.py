"""DICOM Segmentations and RT Structure Sets made by hand, of regions on a grid."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydicom.dataset import Dataset
from pydicom.pixels.utils import pack_bits
from pydicom.sequence import Sequence
from pydicom.uid import RTStructureSetStorage, SegmentationStorage
from scipy.spatial.transform import Rotation

from registration.volume import Grid
from tests.vatsloc.dicom_made import FRAME, base
from vatsloc.frames import flip_affine

LPS = np.diag([-1.0, -1.0, 1.0])


AXIAL, OBLIQUE = np.eye(3), Rotation.from_rotvec([0.2, -0.3, 0.1]).as_matrix()


def grid(axes: np.ndarray = AXIAL, n: tuple[int, int, int] = (12, 10, 8)) -> Grid:
    """Voxels of 2 x 1.5 x 3 mm along the columns of `axes` (LPS)."""
    lps_from_ijk = np.eye(4)
    lps_from_ijk[:3, :3] = axes * [2.0, 1.5, 3.0]
    lps_from_ijk[:3, 3] = [-40, 22, 100]
    return Grid(n, flip_affine(lps_from_ijk))


def blob(on: Grid, *ranges: tuple[int, int]) -> np.ndarray:
    inside = np.zeros(on.shape, dtype=bool)
    inside[tuple(slice(*r) for r in ranges)] = True
    return inside


def of(**attributes: object) -> Dataset:
    ds = Dataset()
    for name, value in attributes.items():
        setattr(ds, name, value)
    return ds


def segmentation(on: Grid, regions: dict[str, np.ndarray], kind: str = "BINARY", frame: str = FRAME) -> Dataset:
    """DICOM SEG of named regions on a grid, from the last slice to the first, without the empty slices."""
    ds = base(np.eye(3), SegmentationStorage)
    lps = flip_affine(on.ras_from_ijk)
    axes, spacing = lps[:3, :3] / on.spacing, on.spacing
    ds.Modality, ds.FrameOfReferenceUID, ds.SegmentationType = "SEG", frame, kind
    ds.Columns, ds.Rows = on.shape[:2]
    ds.PixelRepresentation = 0
    bits = 1 if kind == "BINARY" else 8
    ds.BitsAllocated, ds.BitsStored, ds.HighBit = bits, bits, bits - 1
    ds.MaximumFractionalValue = 200
    ds.SegmentSequence = Sequence([of(SegmentNumber=n, SegmentLabel=name) for n, name in enumerate(regions, 1)])
    measures = of(PixelSpacing=[spacing[1], spacing[0]], SpacingBetweenSlices=spacing[2])
    orientation = of(ImageOrientationPatient=axes[:, :2].T.ravel().round(9).tolist())
    ds.SharedFunctionalGroupsSequence = Sequence(
        [of(PixelMeasuresSequence=Sequence([measures]), PlaneOrientationSequence=Sequence([orientation]))]
    )
    groups, pixels = [], []
    shown = {n: inside * {"BINARY": 1, "FRACTIONAL": 120}.get(kind, n) for n, inside in enumerate(regions.values(), 1)}
    if kind == "LABELMAP":
        shown = {1: np.max(list(shown.values()), axis=0)}
    for n, inside in shown.items():
        for k in reversed(range(on.shape[2])):
            if not inside[:, :, k].any():
                continue
            place = (lps[:3, 3] + lps[:3, 2] * k).round(6).tolist()
            groups.append(
                of(
                    PlanePositionSequence=Sequence([of(ImagePositionPatient=place)]),
                    SegmentIdentificationSequence=Sequence([of(ReferencedSegmentNumber=n)]),
                )
            )
            pixels.append(inside[:, :, k].T)
    ds.PerFrameFunctionalGroupsSequence, ds.NumberOfFrames = Sequence(groups), len(groups)
    stack = np.array(pixels, dtype=np.uint8)
    ds.PixelData = pack_bits(stack) if kind == "BINARY" else stack.tobytes()
    return ds


def structures(rois: dict[str, list[np.ndarray]], frame: str = FRAME, kind: str = "CLOSED_PLANAR") -> Dataset:
    """RTSTRUCT of named contours (n, 3) RAS mm."""
    ds = base(np.eye(3), RTStructureSetStorage)
    ds.Modality = "RTSTRUCT"
    for name in ("Rows", "Columns", "PixelRepresentation", "BitsAllocated", "BitsStored", "HighBit"):
        delattr(ds, name)
    ds.StructureSetROISequence = Sequence(
        [of(ROINumber=n, ROIName=name, ReferencedFrameOfReferenceUID=frame) for n, name in enumerate(rois, 1)]
    )
    ds.ROIContourSequence = Sequence()
    for n, loops in enumerate(rois.values(), 1):
        contours = [
            of(
                ContourGeometricType=kind,
                NumberOfContourPoints=len(loop),
                ContourData=(loop @ LPS).round(6).ravel().tolist(),
            )
            for loop in loops
        ]
        ds.ROIContourSequence.append(of(ReferencedROINumber=n, ContourSequence=Sequence(contours)))
    return ds


def rectangle(on: Grid, i: tuple[float, float], j: tuple[float, float], k: float) -> np.ndarray:
    """Outline (4, 3) RAS mm around voxels i[0] to i[1] - 1 and j[0] to j[1] - 1 of slice k."""
    corners = [(i[0], j[0]), (i[1], j[0]), (i[1], j[1]), (i[0], j[1])]
    return on.to_ras(np.array([(u - 0.5, v - 0.5, k) for u, v in corners]))


def written(ds: Dataset, path: Path) -> Path:
    ds.save_as(path, enforce_file_format=True)
    return path
