"""Flat pictures out of space: planes of pixels, images sampled on them, surfaces and ellipsoids cut by them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from registration.maps.rigid import RigidTransform
from registration.volume import Array, Grid, Volume
from vatsloc.formats.meshes import Surface

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

    def to_pixels(self, points_ras: Array) -> Array:
        """(column, row) of points (..., 3), foot of the perpendicular, (..., 2)."""
        d = np.asarray(points_ras, dtype=float) - self.origin
        return np.stack([d @ self.right / (self.right @ self.right), d @ self.down / (self.down @ self.down)], axis=-1)


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


def sample(volume: Volume, plane: Plane, seen_through: RigidTransform | None = None, fill: float = -1000.0) -> Array:
    """Image on the plane's pixels, (rows, columns) float32, trilinear; `fill` outside the volume.

    seen_through: map from the plane's space to the volume's.
    """
    to_volume = volume.grid.ijk_from_ras @ (np.eye(4) if seen_through is None else seen_through.matrix)
    matrix = to_volume[:3, :3] @ np.stack([plane.down, plane.right, plane.normal], axis=1)
    offset = to_volume[:3, :3] @ plane.origin + to_volume[:3, 3]
    shape = (*plane.shape, 1)
    picture = ndimage.affine_transform(
        volume.hu, matrix, offset, shape, np.float32, order=1, mode="constant", cval=fill
    )
    return picture[..., 0]


def section(surface: Surface, plane: Plane) -> Array:
    """Line segments in which a triangle surface meets the plane, (s, 2, 2): two (column, row) points each."""
    height = (surface.points_ras - plane.origin) @ plane.normal
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
        a, b = surface.points_ras[cut[rows, alone]], surface.points_ras[cut[rows, other]]
        ends.append(plane.to_pixels(a + t[:, None] * (b - a)))
    return np.stack(ends, axis=1)


CORNERS = 72
"""Of a drawn ellipse."""


def ellipse(centre: Array, semi_axes: Array, plane: Plane) -> Array | None:
    """Closed curve (CORNERS, 2) of (column, row) in which the plane cuts an ellipsoid, None where it misses it.

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
    angle = np.linspace(0, 2 * np.pi, CORNERS, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return middle + np.sqrt(left) * np.linalg.solve(np.linalg.cholesky(q).T, circle).T
