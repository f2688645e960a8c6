"""How the walls around a lung move from the CT to the table: a smooth map of all but the operated lung."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phantoms.anatomy import Build, spine_y
from phantoms.fields import Lattice, as_distance, refine, smoothstep

Array = NDArray[Any]


@dataclass(frozen=True)
class CageMotion:
    """Displacement of the chest's walls in the frame of the spine, which stays. side: 1 operated right, -1 left;
    operated_dome, other_dome: mm up; shift: mm the mediastinum falls to the other side; squeeze: mm the operated side's
    ribs move in. Maps CT points to the state: x = motion(X)."""

    build: Build
    side: int
    operated_dome: float
    other_dome: float
    shift: float
    squeeze: float

    def __call__(self, points: Array) -> Array:
        """Moved points (n, 3), RAS mm."""
        return points + self.displacement(points)

    def displacement(self, points: Array) -> Array:
        """Displacement (n, 3) in mm of points (n, 3) in RAS mm of the CT."""
        b = self.build
        x, y, z = points.T
        up = np.zeros_like(x)
        for side, rise in ((self.side, self.operated_dome), (-self.side, self.other_dome)):
            dome = b.dome[0] if side == 1 else b.dome[1]
            rho2 = ((x - side * 54) / (b.width - 40)) ** 2 + ((y - 2) / (b.depth + 6)) ** 2
            dz = z - dome + 20
            reach = np.where(dz > 0, 75.0, 130.0)
            up += rise * np.clip(1.08 - rho2, 0, 1) ** 0.9 * np.exp(-((dz / reach) ** 2))
        ahead = smoothstep(y - spine_y(b, z), 18, 54)
        middle = np.exp(-((x / 62) ** 2)) * smoothstep(z, -190, -110) * (1 - 0.7 * smoothstep(z, 30, 110))
        lateral: Array = -self.side * self.shift * middle * ahead
        wall = smoothstep(self.side * x, 45, 120) * smoothstep(z, -260, -120)
        lateral = lateral - self.side * self.squeeze * wall * (1 - 0.6 * smoothstep(z, 20, 100))
        forward: Array = -0.8 * self.squeeze * smoothstep(y, 0, 80) + 0.25 * self.shift * middle * ahead
        from_spine = np.hypot(np.maximum(np.abs(x) - 24, 0), np.maximum(np.abs(y - spine_y(b, z) + 18) - 36, 0))
        free = smoothstep(from_spine, 0, 45)
        return np.stack([lateral, forward, up * free], axis=1)

    def inverse(self, points: Array, tolerance_mm: float = 1e-3) -> Array:
        """CT points (n, 3) that the motion takes to `points` (n, 3): fixed-point steps, Newton's where these run away.

        Raises ValueError where the motion folds.
        """
        source = points - self.displacement(points)
        for _ in range(60):
            error = source + self.displacement(source) - points
            source = source - error
            if np.abs(error).max() < tolerance_mm:
                return source
        left = np.abs(error).max(axis=1) >= tolerance_mm
        source[left] = self._newton(points[left], tolerance_mm)
        return source

    def _newton(self, points: Array, tolerance_mm: float) -> Array:
        """As `inverse`, along the way from no motion to all of it, so that every step starts near its end."""
        source = points.copy()
        for part in np.linspace(0, 1, 9)[1:]:
            for _ in range(20):
                error = source + part * self.displacement(source) - points
                if np.abs(error).max() < tolerance_mm:
                    break
                gradient = np.eye(3) + part * self._gradient(source)
                if (np.linalg.det(gradient) <= 0).any():
                    break
                source = source - np.linalg.solve(gradient, error[..., None])[..., 0]
        if np.abs(source + self.displacement(source) - points).max() >= tolerance_mm:
            raise ValueError("the motion of the chest wall folds, reduce its amplitudes")
        return source

    def _gradient(self, points: Array, step_mm: float = 0.05) -> Array:
        """Slopes (n, 3, 3) of the displacement by central differences; the last axis is that of the step."""
        steps = step_mm * np.eye(3)
        ahead_behind = [(self.displacement(points + h), self.displacement(points - h)) for h in steps]
        return np.stack([(a - b) / (2 * step_mm) for a, b in ahead_behind], axis=-1)

    def carry(self, distance: Lattice) -> Lattice:
        """Signed distance (mm) of a region of the CT after the motion."""
        stride = 2
        coarse = Lattice(distance.origin, stride * distance.spacing, distance.values[::stride, ::stride, ::stride])
        back = (self.inverse(coarse.points()) - coarse.points()).reshape(*coarse.values.shape, 3)
        nx, ny, nz = distance.values.shape
        fine = np.stack([refine(back[..., m], stride, (nx, ny, nz)).ravel() for m in range(3)], axis=1)
        return as_distance(distance, distance.sample(distance.points() + fine).reshape(nx, ny, nz))

    def volume_ratio(self, lung: Lattice) -> float:
        """Volume of the moved region over that of the region (negative distance) itself."""
        h = lung.spacing
        u = self.displacement(lung.points()).reshape(*lung.values.shape, 3)
        slopes: list[Array] = [np.gradient(u, h, axis=m) for m in range(3)]
        f = np.stack(slopes, axis=-1) + np.eye(3)
        inside = lung.values < 0
        return float(np.linalg.det(f[inside]).mean())


def fit_dome(motion: CageMotion, lung: Lattice, ratio: float) -> CageMotion:
    """The motion whose operated dome rises so far that the cavity of the lung keeps `ratio` of its volume."""
    low, high = -10.0, 60.0
    coarse = Lattice(lung.origin, 2 * lung.spacing, np.ascontiguousarray(lung.values[::2, ::2, ::2]))
    for _ in range(14):
        rise = 0.5 * (low + high)
        low, high = (rise, high) if replace(motion, operated_dome=rise).volume_ratio(coarse) > ratio else (low, rise)
    return replace(motion, operated_dome=0.5 * (low + high))
