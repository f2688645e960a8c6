"""Where bronchi and vessels enter the lung, and how far they moved between images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from registration.images.morphology import bounding_box, dilate, erode, largest
from registration.volume import Array, Mask
from vatsloc.imaging.airways import TrackedAirways, track_airways
from vatsloc.imaging.cbct import PreparedCbct
from vatsloc.imaging.lattice import on_grid
from vatsloc.imaging.lungs import Side
from vatsloc.imaging.thorax import working_scene

BAND_MM = 5.0
RADIUS_MM = 20.0
LEAST_ENTRY_ML = 0.1
REACH_MM = 30.0


@dataclass(frozen=True)
class Hilum:
    """Root of the lung in a CT. point_ras: (3,) mm, on the mediastinal side; radius_mm: what belongs to it around that.

    on_airways: False where no bronchus was seen to enter and the place was guessed from the lung's shape.
    """

    point_ras: Array
    radius_mm: float
    on_airways: bool


def find_hilum(lung: Mask, airways: Mask, side: Side) -> Hilum:
    """Centre of the bronchi where they cross the lung's surface; else the middle of its mediastinal face."""
    box = bounding_box(lung.inside, np.full(3, 6))
    step = np.maximum(np.rint(2.0 / lung.grid.spacing), 1).astype(int)
    thin = tuple(slice(b.start, b.stop, int(s)) for b, s in zip(box, step, strict=True))
    spacing = lung.grid.spacing * step
    inside, tubes = lung.inside[thin], airways.inside[thin]
    start = np.array([b.start for b in box])
    band = dilate(inside, BAND_MM, spacing) & ~erode(inside, BAND_MM, spacing)
    entry = largest(ndimage.binary_dilation(tubes, iterations=1) & band) & tubes
    if entry.sum() * spacing.prod() / 1000 >= LEAST_ENTRY_ML:
        return Hilum(lung.grid.to_ras(np.argwhere(entry).mean(axis=0) * step + start), RADIUS_MM, True)
    points = lung.grid.to_ras(np.argwhere(inside ^ erode(inside, float(spacing.max()), spacing)) * step + start)
    low, high = np.percentile(points, [5.0, 95.0], axis=0)
    middle = (np.abs(points[:, 2] - (0.45 * low[2] + 0.55 * high[2])) < 0.1 * (high[2] - low[2])) & (
        np.abs(points[:, 1] - (low[1] + high[1]) / 2) < 0.15 * (high[1] - low[1])
    )
    chosen = points[middle] if middle.any() else points
    inward = -1.0 if side == "right" else 1.0
    medial = chosen[chosen[:, 0] * inward >= np.percentile(chosen[:, 0] * inward, 80.0)]
    return Hilum(medial.mean(axis=0), RADIUS_MM, False)


def track_hilum(cbct: PreparedCbct, expected: Mask, hilum_ras: Array, radius_mm: float = 30.0) -> TrackedAirways:
    """The bronchi about the hilum found again in a CBCT: their move as a whole, its contrast and runner-up.

    expected: airways in this CBCT's frame, hilum_ras: (3,) likewise. The move is the plain answer to how far the hilum
    went, and the check on a finer one. Ref: Alvarez 2021, section 7.1.2.
    """
    work, seen = working_scene(cbct)
    tubes = on_grid(expected.inside, expected.grid, work.grid).inside
    at = np.argwhere(tubes)
    far = np.linalg.norm(work.grid.to_ras(at.astype(float)) - hilum_ras, axis=1) > radius_mm
    tubes[tuple(at[far].T)] = False
    return track_airways(work, seen, tubes, REACH_MM)
