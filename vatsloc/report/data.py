"""What a report is made of: images, outlines, the answer, and the run's own record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from registration.maps.rigid import RigidTransform
from registration.volume import Array, Mask, Volume
from vatsloc.formats.meshes import Surface

# Okabe & Ito's colour-blind safe palette; a name says what it is drawn for.
NODULE = "#F0E442"
SURFACE = "#56B4E9"
LUNG = "#E69F00"
MESH = "#CC79A7"

WINDOW_HU = (-1000.0, 250.0)


@dataclass(frozen=True)
class Outline:
    """A surface or region drawn as a line in every picture; colour: "#rrggbb"; name: for the legend."""

    name: str
    colour: str
    shape: Surface | Mask


@dataclass(frozen=True)
class Nodule:
    """Predicted nodule. centre_ras: (3,) mm; ellipsoid: (3, 3), row m is a semi-axis of the 95 % ellipsoid, RAS mm."""

    centre_ras: Array
    ellipsoid: Array | None = None

    def __post_init__(self) -> None:
        if np.shape(self.centre_ras) != (3,):
            raise ValueError(f"centre_ras must be (3,), got {np.shape(self.centre_ras)}")
        if self.ellipsoid is not None and np.shape(self.ellipsoid) != (3, 3):
            raise ValueError(f"ellipsoid must be (3, 3), one semi-axis per row, got {np.shape(self.ellipsoid)}")


@dataclass(frozen=True)
class Comparison:
    """One phase: a fixed image with a moving one before and after it, in planes through the nodule.

    before: in its own space, seen through `before_from_fixed`, the rigid pose alone; after: warped to the fixed image's
    space, on any grid.
    """

    title: str
    fixed_name: str
    fixed: Volume
    before_name: str
    before: Volume
    before_from_fixed: RigidTransform
    after_name: str
    after: Volume
    nodule: Nodule
    outlines: tuple[Outline, ...] = ()


@dataclass(frozen=True)
class Picture:
    """An intermediate result: one image in three planes through `at_ras` (3,) mm, with outlines."""

    title: str
    caption: str
    image: Volume
    at_ras: Array
    outlines: tuple[Outline, ...] = ()


@dataclass(frozen=True)
class Motion:
    """The collapse, in the deflated CBCT's frame, RAS mm. triangles: (m, 3), outward; before, after: (n, 3) the lung's
    surface; wall: what it may not pass; nodule_before: (3,).
    """

    triangles: Array
    before: Array
    after: Array
    wall: Surface
    nodule_before: Array


@dataclass(frozen=True)
class Landmark:
    """A place of the lung's surface that can be told by eye. at_ras: (3,) mm; away_mm: from the point nearest to the
    nodule, in a straight line; visible: whether pleural gas lies before it.
    """

    name: str
    at_ras: Array
    away_mm: float
    visible: bool


@dataclass(frozen=True)
class ReportData:
    """Everything report.html shows. run: the dict of run.json; phases: the last one feeds the slice viewer.

    depth_mm: nodule centre below the deflated surface, negative outside; nearest_surface_ras: (3,) mm, the closest
    point of that surface. Both None where no deflated surface was found. landmarks: of that surface, nearest first.
    motion: for the view in three dimensions, None where there is none.
    """

    case_name: str
    run: Mapping[str, Any]
    nodule: Nodule
    phases: tuple[Comparison, ...]
    pictures: tuple[Picture, ...] = ()
    depth_mm: float | None = None
    nearest_surface_ras: Array | None = None
    landmarks: tuple[Landmark, ...] = ()
    motion: Motion | None = None
    window_hu: tuple[float, float] = WINDOW_HU


@dataclass(frozen=True)
class TreSection:
    """Scores of one case. summary: the dict of tre.json; errors_mm: measure -> (n,) mm, NaN where no truth is."""

    summary: Mapping[str, Any]
    errors_mm: Mapping[str, Array]
