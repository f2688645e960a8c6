"""Points on the surface of a collapsed lung, between voxels, each with its outward normal and how far to trust it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from scipy import ndimage
from skimage.measure import marching_cubes

from registration.images.filters import gaussian
from registration.images.interpolate import interpolate
from registration.images.morphology import bounding_box
from registration.volume import Array, Mask, Volume
from vatsloc.imaging.cbct import FieldOfView
from vatsloc.imaging.pleura import Pneumothorax

SPACING_MM = 3.0
SEARCH_MM = 3.0
RIM_MM = 3.0
ACROSS_FISSURE_MM = 22.0
CONFIDENCE = {"air": 1.0, "fissure": 1.0, "contact": 0.3, "dense": 0.1}
HIDDEN_AIR_CONFIDENCE = 0.05


class Border(IntEnum):
    """What lies outside a point of the lung's surface."""

    AIR = 0
    FISSURE = 1
    CONTACT = 2
    DENSE = 3


@dataclass(frozen=True)
class SurfacePoints:
    """Visible surface. points, normals: (n, 3) RAS mm, normals outward; confidence: (n,) 0 to 1.

    border: (n,) values of `Border`.
    """

    points: Array
    normals: Array
    confidence: Array
    border: Array

    def __len__(self) -> int:
        return len(self.points)

    def only(self, *borders: Border) -> SurfacePoints:
        """The points with one of `borders`."""
        return self.where(np.isin(self.border, borders))

    def where(self, keep: Array) -> SurfacePoints:
        """The points that `keep` (n,) bool says."""
        return SurfacePoints(self.points[keep], self.normals[keep], self.confidence[keep], self.border[keep])


def deflated_surface(found: Pneumothorax, field: FieldOfView) -> SurfacePoints:
    """Surface of the collapsed lung where it was seen, about one point per `SPACING_MM`, rim and bad slices left out.

    Air borders sit where HU crosses half-way between lung and air along the normal, fissures likewise (air with lung
    again within 22 mm); contact with wall, mediastinum or diaphragm is less sure, and dense lung least.
    """
    points, normals = _on_mask(found.lung, SPACING_MM)
    points, normals = _seen(points, normals, field)
    gas = _membership(found.air, points + 2.0 * normals) > 0.5
    gas |= _membership(found.air, points + 1.0 * normals) > 0.5
    inner = np.median(_along(found.image, points, normals, (-5.0, -4.0, -3.0)), axis=1)
    border = np.where(gas, Border.AIR, np.where(inner > -300.0, Border.DENSE, Border.CONTACT)).astype(np.int8)
    border[gas & _faces_lung(found, points, normals)] = Border.FISSURE
    shift, crossed = _half_way(found.image, points, normals, inner, gas)
    confidence = np.array([CONFIDENCE[b.name.lower()] for b in Border])[border]
    confidence = np.where(crossed, confidence, 0.5 * confidence)
    confidence[(border == Border.CONTACT) & _over_hidden_air(found, points, normals)] = HIDDEN_AIR_CONFIDENCE
    return SurfacePoints(points + shift[:, None] * normals, normals, confidence, border)


DIAPHRAGM_SPACING_MM = 4.0
"""Between points of the diaphragm, about."""


def diaphragm_points(space: Mask, image: Volume, field: FieldOfView) -> SurfacePoints:
    """Dome of the diaphragm where it is seen: the lower border of the lung's space against soft tissue.

    space: lung and pleural air. Normals point down, out of the space; an empty set when the field ends above the dome.
    """
    points, normals = _seen(*_on_mask(space, DIAPHRAGM_SPACING_MM), field)
    outer = np.median(_along(image, points, normals, (4.0, 6.0, 8.0, 10.0)), axis=1)
    down = (normals[:, 2] < -0.5) & (outer > -200.0)
    down &= points[:, 2] < np.percentile(points[:, 2], 60.0) if len(points) else down
    return _against_flesh(image, points[down], normals[down])


def inflated_surface(lung: Mask, image: Volume, field: FieldOfView) -> SurfacePoints:
    """Surface of a lung that fills its cavity, where it was seen: about one point per `SPACING_MM`."""
    return _against_flesh(image, *_seen(*_on_mask(lung, SPACING_MM), field))


def _against_flesh(image: Volume, points: Array, normals: Array) -> SurfacePoints:
    """Points of a border between lung and soft tissue, moved to where HU crosses half-way."""
    inner = np.median(_along(image, points, normals, (-5.0, -4.0, -3.0)), axis=1)
    shift, crossed = _half_way(image, points, normals, inner, np.zeros(len(points), dtype=bool))
    confidence = np.where(crossed, 1.0, 0.5)
    border = np.full(len(points), Border.CONTACT, dtype=np.int8)
    return SurfacePoints(points + shift[:, None] * normals, normals, confidence, border)


def _on_mask(mask: Mask, spacing_mm: float) -> tuple[Array, Array]:
    """Points and outward normals (n, 3) on the smoothed mask's surface, thinned to one per cell of `spacing_mm`."""
    if not mask.inside.any():
        return np.empty((0, 3)), np.empty((0, 3))
    spacing = mask.grid.spacing
    box = bounding_box(mask.inside, np.full(3, 4))
    level = gaussian(mask.inside[box].astype(np.float32), 1.0 / spacing)
    level = np.pad(level, 1)
    if not level.max() > 0.5:
        return np.empty((0, 3)), np.empty((0, 3))
    vertices = marching_cubes(level, 0.5, step_size=1)[0]
    start = np.array([b.start for b in box]) - 1.0
    cell = np.floor(vertices * spacing / spacing_mm).astype(np.int64)
    _, first = np.unique(cell @ np.array([1, 1 << 20, 1 << 40]), return_index=True)
    vertices = vertices[np.sort(first)]
    wide = gaussian(level, 1.5 / spacing)
    rotation = mask.ras_from_ijk[:3, :3] / spacing
    beside = (vertices[:, :, None] + sign * np.eye(3) for sign in (1, -1))
    after, before = (ndimage.map_coordinates(wide, at.swapaxes(0, 1), order=1, mode="nearest") for at in beside)
    normals = -((after - before) / (2 * spacing)) @ rotation.T
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    return mask.grid.to_ras(vertices + start), normals


def _seen(points: Array, normals: Array, field: FieldOfView) -> tuple[Array, Array]:
    """Points whose surroundings, 3 mm to either side along every axis, were all seen."""
    keep = np.ones(len(points), dtype=bool)
    grid = field.usable.grid
    for axis in range(3):
        for step in (-RIM_MM, RIM_MM):
            ijk = np.rint(grid.to_ijk(points + step * np.eye(3)[axis])).astype(int)
            within = ((ijk >= 0) & (ijk < grid.shape)).all(axis=1)
            ijk = np.clip(ijk, 0, np.array(grid.shape) - 1)
            keep &= within & field.usable.inside[tuple(ijk.T)]
    return points[keep], normals[keep]


def _along(image: Volume, points: Array, normals: Array, offsets: tuple[float, ...] | Array) -> Array:
    """HU at `offsets` mm along the outward normals, (n, len(offsets))."""
    at = points[:, None, :] + np.asarray(offsets)[None, :, None] * normals[:, None, :]
    return interpolate(image.hu, image.grid, at.reshape(-1, 3), -1000.0).reshape(at.shape[:2])


def _membership(mask: Mask, points: Array) -> Array:
    ijk = mask.grid.to_ijk(points)
    return ndimage.map_coordinates(mask.inside.astype(np.float32), ijk.T, order=1, mode="constant")


def _over_hidden_air(found: Pneumothorax, points: Array, normals: Array) -> Array:
    """Whether the outer 6 mm are so much darker than what lies deeper that they are likelier a blurred film of air."""
    skin = np.median(_along(found.image, points, normals, (-2.0, -3.0, -4.5, -6.0)), axis=1)
    deep = np.median(_along(found.image, points, normals, (-11.0, -13.0, -15.0, -17.0)), axis=1)
    return (skin < deep - 0.25 * found.contrast_hu) & (skin < found.limit_hu + 0.5 * found.contrast_hu)


def _faces_lung(found: Pneumothorax, points: Array, normals: Array) -> Array:
    """Whether the outward ray leaves through air and meets lung again within 22 mm before anything else."""
    open_air = np.ones(len(points), dtype=bool)
    hit = np.zeros(len(points), dtype=bool)
    for offset in np.arange(3.0, ACROSS_FISSURE_MM + 1.0, 1.5):
        ijk = np.rint(found.lung.grid.to_ijk(points + offset * normals)).astype(int)
        within = ((ijk >= 0) & (ijk < found.lung.grid.shape)).all(axis=1)
        at = tuple(np.clip(ijk, 0, np.array(found.lung.grid.shape) - 1).T)
        in_lung = found.lung.inside[at] & within
        hit |= open_air & in_lung
        open_air &= found.air.inside[at] & within
    return hit


def _half_way(image: Volume, points: Array, normals: Array, inner: Array, to_air: Array) -> tuple[Array, Array]:
    """Offset in mm along each normal to where HU is half-way between both sides, and whether it crosses there at all.

    The crossing nearest to the start counts, within 3 mm; points without one stay where they are.
    """
    offsets = np.arange(-SEARCH_MM, SEARCH_MM + 0.25, 0.5)
    beyond = _along(image, points, normals, (2.0, 2.5, 3.0, 3.5, 4.0))
    outer = np.where(to_air, beyond.min(axis=1), beyond.max(axis=1))
    inside = np.where(to_air, np.minimum(inner, -300.0), inner)
    half = (inside + outer) / 2
    sign = np.where(to_air, -1.0, 1.0)[:, None]
    past = sign * (_along(image, points, normals, offsets) - half[:, None])
    change = (past[:, :-1] <= 0) & (past[:, 1:] > 0)
    step = past[:, 1:] - past[:, :-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        at = offsets[:-1] - 0.5 * past[:, :-1] / step
    distance = np.where(change, np.abs(at), np.inf)
    best = distance.argmin(axis=1) if len(points) else np.zeros(0, dtype=int)
    rows = np.arange(len(points))
    crossed = np.isfinite(distance[rows, best]) & (np.abs(outer - inside) > 50.0)
    return np.where(crossed, np.nan_to_num(at[rows, best]), 0.0), crossed
