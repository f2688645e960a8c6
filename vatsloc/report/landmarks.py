"""Places of the collapsed lung's surface that a thoracoscope shows, and how far the nodule is from them."""

from __future__ import annotations

import numpy as np

from poro.mesh import TriSurface, closest_points
from registration.volume import Array
from vatsloc.formats.meshes import Surface
from vatsloc.report.data import Landmark
from vatsloc.report.words import WORDS

GAS_MM = 5.0
"""Pleural gas between lung and chest wall that makes a place visible."""

BAND_MM = 6.0
"""Half height of the band in which an edge counts as level with the nodule."""


def depth_below(surface: Surface, point_ras: Array) -> tuple[float | None, Array | None]:
    """Distance of a point (3,) below a surface with outward triangles, mm, negative outside, and the foot (3,) RAS mm.

    Both are None for a surface without triangles.
    """
    if not len(surface.triangles):
        return None, None
    near = closest_points(_tri(surface), np.reshape(point_ras, (1, 3)))
    return -float(near.distance[0]), near.points[0]


def surface_landmarks(lung: Surface, wall: Surface, foot_ras: Array) -> tuple[Landmark, ...]:
    """Apex, lowest edge, and the edges in front and behind level with `foot_ras` (3,), nearest to it first."""
    points = lung.points_ras
    level = points[np.abs(points[:, 2] - foot_ras[2]) < BAND_MM]
    level = level if len(level) else points
    at = {
        WORDS["apex"]: points[points[:, 2].argmax()],
        WORDS["lowest"]: points[points[:, 2].argmin()],
        WORDS["anterior"]: level[level[:, 1].argmax()],
        WORDS["posterior"]: level[level[:, 1].argmin()],
    }
    gas_mm = np.abs(closest_points(_tri(wall), np.array(list(at.values()))).distance)
    marks = [
        Landmark(name, p, float(np.linalg.norm(p - foot_ras)), bool(gas > GAS_MM))
        for (name, p), gas in zip(at.items(), gas_mm, strict=True)
    ]
    return tuple(sorted(marks, key=lambda mark: mark.away_mm))


def moved_by(before_ras: Array, after_ras: Array) -> str:
    """How far a point (3,) mm has moved and where to, the longest way first, in a body's own words."""
    ways = (("right", "left"), ("front", "back"), ("head", "feet"))
    step = np.asarray(after_ras) - np.asarray(before_ras)
    parts = [
        WORDS["moved_to"].format(mm=abs(step[axis]), way=WORDS[ways[axis][int(step[axis] < 0)]])
        for axis in np.argsort(-np.abs(step))
        if abs(step[axis]) >= 0.5
    ]
    told = f"{np.linalg.norm(step):.0f} mm"
    return f"{told}: {', '.join(parts)}" if parts else told


def _tri(surface: Surface) -> TriSurface:
    return TriSurface(surface.points_ras, surface.triangles, np.arange(len(surface.points_ras)))
