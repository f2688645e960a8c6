"""The nodule: its shape, its density, and how a CT shows it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phantoms.fields import coverage, smoothstep
from phantoms.voxels import Grid, Region

Array = NDArray[Any]
SOLID_HU, GLASS_HU, PLAIN_HU = 25.0, -560.0, -850.0


@dataclass(frozen=True)
class Nodule:
    """A ball of radius (mm) whose surface waves by `relief` mm. centre: (3,) RAS mm in the CT; kind: see `Lesion`, or
    "given": the lung's tissue holds it already, and images are not painted over; seen: see `Lesion`."""

    centre: Array
    radius: float
    relief: float
    kind: str
    seen: str = "all"

    @property
    def stiffening(self) -> float:
        """Factor on the shear modulus of lung tissue; one for a nodule that is not to be told by the lung's motion."""
        if self.seen != "all":
            return 1.0
        return {"solid": 11.0, "given": 11.0, "part-solid": 6.0, "ground-glass": 2.0}[self.kind]

    def shown(self, inflated: bool) -> bool:
        """Whether the cone-beam image of the inflated, or else the collapsed, lung shows it."""
        return self.seen == "all" or (inflated and self.seen == "ct and inflated")

    def density(self, points: Array) -> Array:
        """HU in the CT at points (..., 3) of the lesion; a part-solid one has a solid core of half its radius."""
        core = {"solid": np.inf, "part-solid": 0.5 * self.radius, "ground-glass": -np.inf}[self.kind]
        depth = np.linalg.norm(points - self.centre, axis=-1) - core
        return GLASS_HU + smoothstep(-depth, -1.0, 1.0) * (SOLID_HU - GLASS_HU)

    def distance(self, points: Array) -> Array:
        """Signed distance in mm of points (..., 3), negative inside."""
        d = points - self.centre
        r = np.linalg.norm(d, axis=-1)
        wave = np.sin(0.9 * d[..., 0] + 1) * np.sin(0.8 * d[..., 1] + 2) * np.sin(0.7 * d[..., 2] + 3)
        return r - self.radius - self.relief * wave


def nodule_mask(nodule: Nodule, grid: Grid) -> Region:
    """Voxels of the CT whose centres lie in the nodule."""
    inside = np.zeros(grid.shape, dtype=bool)
    reach = nodule.radius + nodule.relief + 2 * grid.spacing.max()
    corners = grid.to_ijk(
        nodule.centre + reach * np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
    )
    lo = np.maximum(np.floor(corners.min(axis=0)), 0).astype(int)
    sub = grid.box(lo, corners.max(axis=0) + 1)
    n = sub.shape
    inside[lo[0] : lo[0] + n[0], lo[1] : lo[1] + n[1], lo[2] : lo[2] + n[2]] = nodule.distance(sub.points()) < 0
    return Region(inside, grid.ras_from_ijk)


def paint_nodule(hu: Array, grid: Grid, nodule: Nodule, width: float) -> None:
    """Paint the nodule into an image (HU) with voxels of `width` mm."""
    reach = nodule.radius + 4
    corners = grid.to_ijk(nodule.centre + np.array([[-reach] * 3, [reach] * 3]))
    lo = np.maximum(np.floor(corners.min(axis=0)), 0).astype(int)
    sub = grid.box(lo, corners.max(axis=0) + 1)
    view = hu[tuple(slice(a, a + n) for a, n in zip(lo, sub.shape, strict=True))]
    view += coverage(nodule.distance(sub.points()), width) * (nodule.density(sub.points()) - view)
