"""Flat pictures out of space: planes of pixels, images sampled on them, surfaces and ellipsoids cut by them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from registration.interpolate import interpolate
from registration.volume import Array, Grid, Volume
from vatsloc.report.data import Surface

AXES = {"axial": 2, "coronal": 1, "sagittal": 0}

# Radiological display: the patient's right on the left, head and front up; in sagittal planes the front on the left.
RIGHT_DOWN = {
    "axial": (np.array([-1.0, 0, 0]), np.array([0, -1.0, 0])),
    "coronal": (np.array([-1.0, 0, 0]), np.array([0, 0, -1.0])),
    "sagittal": (np.array([0, -1.0, 0]), np.array([0, 0, -1.0])),
}
EDGE_LETTERS = {"axial": "RALP", "coronal": "RSLI", "sagittal": "ASPI"}


@dataclass(frozen=True)
class Plane:
    """Pixels in space. origin: (3,) RAS mm of pixel [0, 0]; right, down: (3,) mm per pixel; shape: rows, columns."""

    name: str
    origin: Array
    right: Array
    down: Array
    shape: tuple[int, int]

    @property
    def normal(self) -> Array:
        """Unit vector across the plane, (3,)."""
        n = np.cross(self.right, self.down)
        return n / np.linalg.norm(n)

    def points(self) -> Array:
        """Pixel centres, (rows, columns, 3), RAS mm."""
        r, c = (np.arange(n, dtype=float) for n in self.shape)
        return self.origin + r[:, None, None] * self.down + c[None, :, None] * self.right

    def to_pixels(self, points_ras: Array) -> Array:
        """(column, row) of points (..., 3), foot of the perpendicular, (..., 2)."""
        d = np.asarray(points_ras, dtype=float) - self.origin
        return np.stack([d @ self.right / (self.right @ self.right), d @ self.down / (self.down @ self.down)], axis=-1)


def ready(volume: Volume) -> Volume:
    """The same image in the memory order that sampling wants, so that it is not rearranged for every plane."""
    return Volume(np.ascontiguousarray(volume.hu, dtype=np.float32), volume.ras_from_ijk)


def box_of(grid: Grid) -> tuple[Array, Array]:
    """Lower and upper corner (3,) in RAS mm of the box along the anatomical axes that holds the voxel centres."""
    corners = np.array([[a, b, c] for a in (0, 1) for b in (0, 1) for c in (0, 1)]) * (np.array(grid.shape) - 1.0)
    ras = grid.to_ras(corners)
    return ras.min(axis=0), ras.max(axis=0)


def plane_through(name: str, at_ras: Array, box: tuple[Array, Array], spacing_mm: float) -> Plane:
    """Axial, coronal or sagittal plane through a point (3,), as large as the box."""
    lower, upper = box
    right, down = RIGHT_DOWN[name]
    origin = np.where(right + down < 0, upper, lower)
    origin[AXES[name]] = at_ras[AXES[name]]
    size = upper - lower
    columns, rows = (int(np.floor(size @ np.abs(axis) / spacing_mm)) + 1 for axis in (right, down))
    return Plane(name, origin, right * spacing_mm, down * spacing_mm, (rows, columns))


def sample(volume: Volume, plane: Plane, fill: float = -1000.0) -> Array:
    """Image on the plane's pixels, (rows, columns) float32, trilinear; `fill` outside the volume."""
    return interpolate(volume.hu, volume.grid, plane.points().reshape(-1, 3), fill).reshape(plane.shape)


def section(surface: Surface, plane: Plane) -> Array:
    """Line segments in which a triangle surface meets the plane, (s, 2, 2): two (column, row) points each."""
    height = (surface.points - plane.origin) @ plane.normal
    # A vertex exactly in the plane would give three crossings in one triangle; it is taken as just above.
    height = np.where(height == 0, 1e-9, height)
    h = height[surface.triangles]
    cut = surface.triangles[(h > 0).any(axis=1) & (h < 0).any(axis=1)]
    if not len(cut):
        return np.empty((0, 2, 2))
    h = height[cut]
    alone = np.where((h > 0).sum(axis=1) == 1, (h > 0).argmax(axis=1), (h < 0).argmax(axis=1))
    rows = np.arange(len(cut))
    ends = []
    for step in (1, 2):
        other = (alone + step) % 3
        t = h[rows, alone] / (h[rows, alone] - h[rows, other])
        a, b = surface.points[cut[rows, alone]], surface.points[cut[rows, other]]
        ends.append(plane.to_pixels(a + t[:, None] * (b - a)))
    return np.stack(ends, axis=1)


def ellipse(centre: Array, semi_axes: Array, plane: Plane, n: int = 72) -> Array | None:
    """Closed curve (n, 2) of (column, row) in which the plane cuts an ellipsoid, None where it misses it.

    centre: (3,) RAS mm; semi_axes: (3, 3), one per row, mm.
    """
    length = np.maximum(np.linalg.norm(semi_axes, axis=1), 1e-3)
    unit = semi_axes / length[:, None]
    # s -> |W (d + B s)|^2 = 1 on the plane's coordinates s: a conic, solved for its centre and its Cholesky factor.
    w = unit / length[:, None]
    b = w @ np.stack([plane.right, plane.down], axis=1)
    d = w @ (plane.origin - centre)
    q = b.T @ b
    middle = -np.linalg.solve(q, b.T @ d)
    left = 1.0 - float(np.sum((d + b @ middle) ** 2))
    if left <= 0:
        return None
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return middle + np.sqrt(left) * np.linalg.solve(np.linalg.cholesky(q).T, circle).T
