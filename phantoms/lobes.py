"""Lobes of a lung: the sheets that part them, the region of each, and a map that may jump from one to the next."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes

from phantoms.fields import Lattice, as_distance, soft_max
from phantoms.spline import SplineMap, determinant

Array = NDArray[Any]
LINE_HU, LINE_MM = 150.0, 0.9
FACING_MM = 2.0


@dataclass(frozen=True)
class Sheet:
    """A bowed sheet through a lung. hilum: (3,) RAS mm; offset: mm it passes below the hilum; slope: mm up per mm back;
    bow: mm it bulges at 60 mm from the hilum."""

    hilum: Array
    offset: float
    slope: float
    bow: float

    def distance(self, points: Array) -> Array:
        """Distance in mm of points (..., 3) in the CT from the sheet, positive above it."""
        d = points - self.hilum
        bulge = self.bow * ((d[..., 0] ** 2 + d[..., 1] ** 2) / 3600 - 0.5)
        return (d[..., 2] + self.slope * d[..., 1] + self.offset + bulge) / np.sqrt(1 + self.slope**2)


@dataclass(frozen=True)
class Fissures:
    """Sheets of pleura between the lobes of a lung. oblique: above the lower lobe; horizontal: between upper and middle
    lobe, in a right lung only. grown_mm: within this distance of the hilum the lobes have grown together;
    drawn: whether images need to be given the line, because the lung's tissue does not hold it."""

    oblique: Sheet
    horizontal: Sheet | None
    grown_mm: float = 0.0
    drawn: bool = True

    def distance(self, points: Array) -> Array:
        """Distance in mm, not below zero, of points (..., 3) in the CT from the nearest sheet."""
        oblique = self.oblique.distance(points)
        if self.horizontal is None:
            return np.abs(oblique)
        across = np.abs(self.horizontal.distance(points))
        return np.where(oblique > 0, np.minimum(oblique, across), -oblique)

    def grown(self, points: Array) -> Array:
        """Whether the lobes have grown together at points (..., 3)."""
        return np.linalg.norm(points - self.oblique.hilum, axis=-1) < self.grown_mm

    def density(self, points: Array) -> Array:
        """HU that the sheets of pleura add at points (..., 3); none where lobes have partly grown together."""
        if not self.drawn:
            return np.zeros(points.shape[:-1])
        line = LINE_HU * np.exp(-((self.distance(points) / LINE_MM) ** 2))
        return np.asarray(line if np.isinf(self.grown_mm) else line * ~self.grown(points))


@dataclass(frozen=True)
class Lobes:
    """Regions of one lung in the CT that move on their own. names; regions: signed distances (mm); fissures between."""

    names: tuple[str, ...]
    regions: tuple[Lattice, ...]
    fissures: Fissures

    def at(self, points: Array) -> Array:
        """Which lobe (n,) tissue at points (n, 3) belongs to: the one it lies deepest in."""
        if len(self.regions) == 1:
            return np.zeros(len(points), dtype=np.intp)
        return np.argmin([r.sample(points) for r in self.regions], axis=0)

    def facing(self) -> tuple[Array, Array, Array, Array]:
        """Points (n, 3) of the lobes' surfaces that lie on another lobe, area (n,) mm2, own and other lobe (n,)."""
        found = []
        for own, region in enumerate(self.regions):
            points, area = surface_points(region, 2)
            others = [np.inf + 0 * area if n == own else r.sample(points) for n, r in enumerate(self.regions)]
            other = np.argmin(others, axis=0)
            close = np.min(others, axis=0) < FACING_MM
            found.append((points[close], area[close], np.full(int(close.sum()), own), other[close]))
        points, area, own_lobe, other_lobe = (np.concatenate(part) for part in zip(*found, strict=True))
        return points, area, own_lobe, other_lobe


@dataclass(frozen=True)
class LobedMap:
    """A smooth map for each lobe, which jumps at the fissures. Points outside the lung follow the nearest lobe."""

    pieces: tuple[SplineMap, ...]
    lobes: Lobes

    def __call__(self, points: Array) -> Array:
        """Mapped points (n, 3), RAS mm."""
        return self.with_gradient(points)[0]

    def with_gradient(self, points: Array) -> tuple[Array, Array]:
        """Mapped points (n, 3) and deformation gradients (n, 3, 3) at points (n, 3)."""
        if len(self.pieces) == 1:
            return self.pieces[0].with_gradient(points)
        lobe = self.lobes.at(points)
        out, f = np.empty((len(points), 3)), np.empty((len(points), 3, 3))
        for n, piece in enumerate(self.pieces):
            out[lobe == n], f[lobe == n] = piece.with_gradient(points[lobe == n])
        return out, f

    def determinant(self, points: Array) -> Array:
        """Ratio of volumes det F at points (n, 3)."""
        return determinant(self.with_gradient(points)[1])

    def inverse(self, points: Array, samples: Array, tolerance_mm: float = 1e-4) -> tuple[Array, Array]:
        """Sources (n, 3) of `points` (n, 3) in the lobe they lie deepest in, and what is left, (n,) mm.

        samples: (m, 3) points of the lung, no more than half a spline's spacing apart.
        """
        if len(self.pieces) == 1:
            return self.pieces[0].inverse(points, samples, tolerance_mm)
        source, left = np.zeros((len(points), 3)), np.full(len(points), np.inf)
        depth = np.full(len(points), np.inf)
        for piece, region in zip(self.pieces, self.lobes.regions, strict=True):
            found, rest = piece.inverse(points, samples[region.sample(samples) < 6.0], tolerance_mm)
            phi = np.where(rest < 10 * tolerance_mm, region.sample(found), 1e3 + rest)
            deeper = phi < depth
            source[deeper], left[deeper], depth[deeper] = found[deeper], rest[deeper], phi[deeper]
        return source, left


def whole(lung: Lattice, fissures: Fissures) -> Lobes:
    """The lung in one piece: its lobes have grown together everywhere."""
    return Lobes(("lung",), (lung,), fissures)


def cut(lung: Lattice, fissures: Fissures, fused: float = 0.0) -> Lobes:
    """The lobes that the sheets of `fissures` cut a lung (signed distance, mm) into, grown together around the hilum
    over a share `fused` of the sheets' area."""
    points = lung.points()
    shape = lung.values.shape
    above = fissures.oblique.distance(points).reshape(shape).astype(np.float32)
    parts = {"upper": -above, "lower": above}
    if fissures.horizontal is not None:
        over = fissures.horizontal.distance(points).reshape(shape).astype(np.float32)
        parts = {"upper": soft_max(-above, -over, 2), "middle": soft_max(-above, over, 2), "lower": above}
    regions = tuple(as_distance(lung, soft_max(lung.values, part, 2)) for part in parts.values())
    lobes = Lobes(tuple(parts), regions, fissures)
    points, area, _, _ = lobes.facing()
    reach = np.linalg.norm(points - fissures.oblique.hilum, axis=1)
    order = np.argsort(reach)
    within = np.searchsorted(np.cumsum(area[order]), fused * area.sum())
    return replace(lobes, fissures=replace(fissures, grown_mm=float(reach[order][within]) if fused > 0 else 0.0))


def surface_points(region: Lattice, step: int) -> tuple[Array, Array]:
    """Points (n, 3) mm on the zero level of a region and the area (n,) mm2 each stands for."""
    vertices, faces, _, _ = marching_cubes(region.values, 0.0, spacing=(region.spacing,) * 3, step_size=step)
    a, b, c = (vertices[faces[:, m]] for m in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    per_vertex = np.bincount(faces.ravel(), np.repeat(area / 3, 3), minlength=len(vertices))
    return vertices + region.origin, per_vertex
