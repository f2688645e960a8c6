"""Integrals over the common part of two triangulated surfaces that face each other: the mortar matrices of contact.

Every triangle of one surface is clipped against those of the other in its own plane, so that the products of both
surfaces' shape functions are integrated exactly. The first surface's weights are biorthogonal to its shape functions,
so each constraint holds one of its nodes alone against some of the other's.
Ref: Puso & Laursen 2004, sec. 4 (segments by clipping); Wohlmuth 2000 (dual weights); Popp, Seitz, Gee & Wall 2013
(dual weights where a triangle is only covered in part).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.sparse import coo_matrix, csr_matrix
from scipy.spatial import cKDTree

from poro.arrays import Array

OPPOSED = -0.3
"""Two triangles face each other where the product of their unit normals is below this."""
LEAST_COVERED = 0.02
"""Of a triangle, by the determinant of its mass matrix; where less is covered, dual weights would extrapolate."""
FULL = 0.5  # that determinant of a triangle covered whole, its mean diagonal entry being one
MOST_CORNERS = 8  # of a triangle clipped by a triangle: six, and two to spare


class Reach(NamedTuple):
    """How far apart surfaces are compared, and how deep they may lie in each other to be, mm."""

    apart: float
    deep: float


@dataclass(frozen=True)
class Mortar:
    """Weights over the common part, mm2. own: (n,) of each point of the first surface, in sum the common area; other:
    (n, n) of the second surface's points beside each point of the first, with the same sums.
    """

    own: Array
    other: csr_matrix


def mortar(points: Array, first: Array, second: Array, reach: Reach) -> Mortar:
    """Mortar weights of triangles `first` (s, 3) and `second` (t, 3) over points (n, 3) mm, normals outward.

    The common part is where they lie above each other along the first one's normals, face each other and are neither
    farther apart nor deeper in each other than `reach` allows.
    """
    x, y = points[first], points[second]
    pairs = _near(x, y, max(reach))
    own, other = _integrals(x, y, pairs, np.array(reach))
    mass = np.zeros((len(first), 3, 3))
    np.add.at(mass, pairs[:, 0], own)
    weight = mass.sum(axis=2)
    other = _dual(mass, weight)[pairs[:, 0]] @ other
    n = len(points)
    i, j = np.broadcast_arrays(first[pairs[:, 0]][:, :, None], second[pairs[:, 1]][:, None])
    return Mortar(
        np.bincount(first.ravel(), weight.ravel(), n),
        coo_matrix((other.ravel(), (i.ravel(), j.ravel())), shape=(n, n)).tocsr(),
    )


def _dual(mass: Array, weight: Array) -> Array:
    """Coefficients (s, 3, 3) of dual weights in shape functions, by their mass matrices (s, 3, 3); the shape functions
    themselves where too little of a triangle is covered.
    """
    size = np.maximum(np.trace(mass, axis1=1, axis2=2) / 3, 1e-30)
    scaled = mass / size[:, None, None]
    covered = np.linalg.det(scaled) > LEAST_COVERED * FULL
    result = np.broadcast_to(np.eye(3), mass.shape).copy()
    result[covered] = (weight / size[:, None])[covered][:, :, None] * np.linalg.inv(scaled[covered])
    return result


def _near(x: Array, y: Array, reach: float) -> Array:
    """Pairs (k, 2) of triangles x (s, 3, 3) and y (t, 3, 3) whose bounding spheres come within `reach`."""
    if not len(x) or not len(y):
        return np.zeros((0, 2), np.int64)
    centres, others = x.mean(axis=1), y.mean(axis=1)
    radii = np.linalg.norm(x - centres[:, None], axis=2).max(axis=1)
    widest = np.linalg.norm(y - others[:, None], axis=2).max()
    found = cKDTree(others).query_ball_point(centres, radii + widest + reach)
    counts = [len(near) for near in found]
    return np.stack([np.repeat(np.arange(len(x)), counts), np.concatenate(found).astype(np.int64)], axis=1)


@njit(cache=True)
def _cross(a: Array, b: Array) -> Array:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@njit(cache=True)
def _barycentric(corners: Array, px: float, py: float) -> tuple[float, float, float]:
    """Weights of a triangle's corners (3, 2) at a point of its plane."""
    ax, ay = corners[1, 0] - corners[0, 0], corners[1, 1] - corners[0, 1]
    bx, by = corners[2, 0] - corners[0, 0], corners[2, 1] - corners[0, 1]
    qx, qy = px - corners[0, 0], py - corners[0, 1]
    twice = ax * by - ay * bx
    v, w = (qx * by - qy * bx) / twice, (ax * qy - ay * qx) / twice
    return 1 - v - w, v, w


@njit(cache=True)
def _clipped(polygon: Array, corners: Array, spare: Array) -> int:
    """Clip a triangle, the first three rows of `polygon`, by another one (3, 2), both counter-clockwise; number of
    corners that are left in `polygon`.

    Ref: Sutherland & Hodgman 1974.
    """
    count = 3
    for side in range(3):
        ox, oy = corners[side, 0], corners[side, 1]
        dx, dy = corners[(side + 1) % 3, 0] - ox, corners[(side + 1) % 3, 1] - oy
        kept = 0
        for k in range(count):
            px, py = polygon[k, 0], polygon[k, 1]
            qx, qy = polygon[(k + 1) % count, 0], polygon[(k + 1) % count, 1]
            p, q = dx * (py - oy) - dy * (px - ox), dx * (qy - oy) - dy * (qx - ox)
            if p >= 0:
                spare[kept, 0], spare[kept, 1] = px, py
                kept += 1
            if (p > 0 and q < 0) or (p < 0 and q > 0):
                t = p / (p - q)
                spare[kept, 0], spare[kept, 1] = px + t * (qx - px), py + t * (qy - py)
                kept += 1
        for k in range(kept):
            polygon[k, 0], polygon[k, 1] = spare[k, 0], spare[k, 1]
        count = kept
    return count


@njit(cache=True)
def _integrals(x: Array, y: Array, pairs: Array, reach: Array) -> tuple[Array, Array]:
    """Products of shape functions (k, 3, 3) mm2 of pairs of triangles: x with x, and x with y, over what is common."""
    own, other = np.zeros((len(pairs), 3, 3)), np.zeros((len(pairs), 3, 3))
    flat_x, flat_y = np.empty((3, 2)), np.empty((3, 2))
    polygon, spare = np.empty((MOST_CORNERS, 2)), np.empty((MOST_CORNERS, 2))
    mid, on_x, on_y = np.empty((3, 2)), np.empty(3), np.empty(3)
    for k in range(len(pairs)):
        a, b = x[pairs[k, 0]], y[pairs[k, 1]]
        n, m = _cross(a[1] - a[0], a[2] - a[0]), _cross(b[1] - b[0], b[2] - b[0])
        n /= np.sqrt((n * n).sum())
        m /= np.sqrt((m * m).sum())
        if (n * m).sum() > OPPOSED:
            continue
        e = a[1] - a[0]
        e /= np.sqrt((e * e).sum())
        f = _cross(n, e)
        height = np.empty(3)
        for c in range(3):
            p, q = a[c] - a[0], b[2 - c] - a[0]  # the other one seen from behind, so that it turns the same way
            flat_x[c, 0], flat_x[c, 1] = (p * e).sum(), (p * f).sum()
            flat_y[c, 0], flat_y[c, 1] = (q * e).sum(), (q * f).sum()
            height[c] = (q * n).sum()
            polygon[c, 0], polygon[c, 1] = flat_y[c, 0], flat_y[c, 1]
        count = _clipped(polygon, flat_x, spare)
        if count < 3:
            continue
        mx, my = polygon[:count, 0].mean(), polygon[:count, 1].mean()
        w0, w1, w2 = _barycentric(flat_y, mx, my)
        gap = w0 * height[0] + w1 * height[1] + w2 * height[2]
        if gap > reach[0] or gap < -reach[1]:
            continue
        for c in range(1, count - 1):
            ux, uy = polygon[c, 0] - polygon[0, 0], polygon[c, 1] - polygon[0, 1]
            vx, vy = polygon[c + 1, 0] - polygon[0, 0], polygon[c + 1, 1] - polygon[0, 1]
            weight = (ux * vy - uy * vx) / 6  # of a middle of a side: exact for products of two linear functions
            mid[0] = (polygon[0] + polygon[c]) / 2
            mid[1] = (polygon[c] + polygon[c + 1]) / 2
            mid[2] = (polygon[c + 1] + polygon[0]) / 2
            for s in range(3):
                on_x[0], on_x[1], on_x[2] = _barycentric(flat_x, mid[s, 0], mid[s, 1])
                on_y[2], on_y[1], on_y[0] = _barycentric(flat_y, mid[s, 0], mid[s, 1])
                for i in range(3):
                    for j in range(3):
                        own[k, i, j] += weight * on_x[i] * on_x[j]
                        other[k, i, j] += weight * on_x[i] * on_y[j]
    return own, other
