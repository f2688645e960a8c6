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

OPPOSED = -0.7
"""Two triangles face each other where the product of their unit normals is below this: 45 degrees. Beyond that, sharp
rims that lie beside each other would count as overlapping."""
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
    pairs, frames = _near(x, y, reach)
    own, other = _integrals(x, y, pairs, frames, np.array(reach))
    common = own.any(axis=(1, 2))
    pairs, own, other = pairs[common], own[common], other[common]
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


def _near(x: Array, y: Array, reach: Reach) -> tuple[Array, Array]:
    """Pairs (k, 2) of triangles x (s, 3, 3) and y (t, 3, 3) that face each other within reach, and a frame (s, 3, 3)
    of each triangle x: two directions along it and its normal.
    """
    if not len(x) or not len(y):
        return np.zeros((0, 2), np.int64), np.zeros((0, 3, 3))
    along = _unit(x[:, 1] - x[:, 0])
    normal, other = (_unit(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])) for t in (x, y))
    centres, others = x.mean(axis=1), y.mean(axis=1)
    radii, widths = (np.linalg.norm(t - t.mean(axis=1)[:, None], axis=2).max(axis=1) for t in (x, y))
    found = cKDTree(others).query_ball_point(centres, radii + widths.max() + max(reach))
    i, j = np.repeat(np.arange(len(x)), [len(near) for near in found]), np.concatenate(found).astype(np.int64)
    apart = others[j] - centres[i]
    height = np.einsum("kd,kd->k", apart, normal[i])
    aside = np.linalg.norm(apart - height[:, None] * normal[i], axis=1)
    near = (np.einsum("kd,kd->k", normal[i], other[j]) < OPPOSED) & (aside < radii[i] + widths[j])
    near &= (height < reach.apart + widths[j]) & (height > -reach.deep - widths[j])
    return np.stack([i[near], j[near]], axis=1), np.stack([along, np.cross(normal, along), normal], axis=1)


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]


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
def _integrals(x: Array, y: Array, pairs: Array, frames: Array, reach: Array) -> tuple[Array, Array]:
    """Products of shape functions (k, 3, 3) mm2 of pairs of triangles: x with x, and x with y, over what is common."""
    own, other = np.zeros((len(pairs), 3, 3)), np.zeros((len(pairs), 3, 3))
    flat_x, flat_y, height = np.empty((3, 2)), np.empty((3, 2)), np.empty(3)
    polygon, spare = np.empty((MOST_CORNERS, 2)), np.empty((MOST_CORNERS, 2))
    mid, on_x, on_y = np.empty((3, 2)), np.empty(3), np.empty(3)
    for k in range(len(pairs)):
        a, b, frame = x[pairs[k, 0]], y[pairs[k, 1]], frames[pairs[k, 0]]
        for c in range(3):
            # The other triangle is seen from behind, so that it turns the same way.
            height[c] = 0.0
            for axis in range(2):
                flat_x[c, axis] = flat_y[c, axis] = 0.0
            for d in range(3):
                p, q = a[c, d] - a[0, d], b[2 - c, d] - a[0, d]
                height[c] += q * frame[2, d]
                for axis in range(2):
                    flat_x[c, axis] += p * frame[axis, d]
                    flat_y[c, axis] += q * frame[axis, d]
            polygon[c, 0], polygon[c, 1] = flat_y[c, 0], flat_y[c, 1]
        count = _clipped(polygon, flat_x, spare)
        if count < 3:
            continue
        mx = my = 0.0
        for c in range(count):
            mx, my = mx + polygon[c, 0] / count, my + polygon[c, 1] / count
        w0, w1, w2 = _barycentric(flat_y, mx, my)
        gap = w0 * height[0] + w1 * height[1] + w2 * height[2]
        if gap > reach[0] or gap < -reach[1]:
            continue
        for c in range(1, count - 1):
            ux, uy = polygon[c, 0] - polygon[0, 0], polygon[c, 1] - polygon[0, 1]
            vx, vy = polygon[c + 1, 0] - polygon[0, 0], polygon[c + 1, 1] - polygon[0, 1]
            weight = (ux * vy - uy * vx) / 6  # of a middle of a side: exact for products of two linear functions
            for axis in range(2):
                mid[0, axis] = (polygon[0, axis] + polygon[c, axis]) / 2
                mid[1, axis] = (polygon[c, axis] + polygon[c + 1, axis]) / 2
                mid[2, axis] = (polygon[c + 1, axis] + polygon[0, axis]) / 2
            for s in range(3):
                on_x[0], on_x[1], on_x[2] = _barycentric(flat_x, mid[s, 0], mid[s, 1])
                on_y[2], on_y[1], on_y[0] = _barycentric(flat_y, mid[s, 0], mid[s, 1])
                for i in range(3):
                    for j in range(3):
                        own[k, i, j] += weight * on_x[i] * on_x[j]
                        other[k, i, j] += weight * on_x[i] * on_y[j]
    return own, other
