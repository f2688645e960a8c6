"""Exact closest points on a triangulated surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from scipy.spatial import cKDTree

from poro.mesh.tetmesh import Array, TriSurface


@dataclass(frozen=True)
class ClosestPoints:
    """Nearest surface points. points: (q, 3) mm; triangle: (q,); barycentric: (q, 3); distance: (q,) mm, positive
    outside.
    """

    points: Array
    triangle: Array
    barycentric: Array
    distance: Array


def closest_points(surface: TriSurface, queries: Array) -> ClosestPoints:
    """Nearest point of a surface to every query (q, 3) mm; the sign comes from normals interpolated over the
    triangle.
    """
    queries = np.ascontiguousarray(queries, float)
    x = surface.points[surface.triangles]
    centres = x.mean(axis=1)
    radii = np.linalg.norm(x - centres[:, None], axis=2).max(axis=1)
    _, guess = cKDTree(centres).query(queries)
    triangle, bary = _search(queries, x, centres, radii, guess)
    points = np.einsum("qk,qkd->qd", bary, x[triangle])
    offset = queries - points
    normal = np.einsum("qk,qkd->qd", bary, surface.node_normals[surface.triangles[triangle]])
    # On a face the face's own normal decides; only edges and corners need the interpolated one.
    normal = np.where((bary.min(axis=1) > 1e-9)[:, None], surface.normals[triangle], normal)
    sign = np.where(np.einsum("qd,qd->q", offset, normal) < 0, -1.0, 1.0)
    return ClosestPoints(points, triangle, bary, sign * np.linalg.norm(offset, axis=1))


@njit(cache=True, parallel=True)
def _search(queries: Array, x: Array, centres: Array, radii: Array, guess: Array) -> tuple[Array, Array]:
    found = np.empty(len(queries), np.int64)
    bary = np.empty((len(queries), 3))
    for q in prange(len(queries)):
        p = queries[q]
        best_w = _project(p, x[guess[q]])
        best = guess[q]
        c = best_w[0] * x[best, 0] + best_w[1] * x[best, 1] + best_w[2] * x[best, 2]
        least = np.sqrt((p[0] - c[0]) ** 2 + (p[1] - c[1]) ** 2 + (p[2] - c[2]) ** 2)
        for t in range(len(centres)):
            reach = least + radii[t]
            d2 = (p[0] - centres[t, 0]) ** 2 + (p[1] - centres[t, 1]) ** 2 + (p[2] - centres[t, 2]) ** 2
            if d2 < reach * reach:
                w = _project(p, x[t])
                c = w[0] * x[t, 0] + w[1] * x[t, 1] + w[2] * x[t, 2]
                d = np.sqrt((p[0] - c[0]) ** 2 + (p[1] - c[1]) ** 2 + (p[2] - c[2]) ** 2)
                if d < least:
                    least, best, best_w = d, t, w
        found[q] = best
        bary[q] = best_w
    return found, bary


@njit(cache=True)
def _project(p: Array, x: Array) -> Array:
    """Barycentric weights of the point of triangle x (3, 3) nearest to p. Ref: Ericson 2005, section 5.1.5."""
    w = np.zeros(3)
    ab, ac, ap = x[1] - x[0], x[2] - x[0], p - x[0]
    d1, d2 = _dot(ab, ap), _dot(ac, ap)
    if d1 <= 0 and d2 <= 0:
        w[0] = 1
        return w
    bp = p - x[1]
    d3, d4 = _dot(ab, bp), _dot(ac, bp)
    if d3 >= 0 and d4 <= d3:
        w[1] = 1
        return w
    vc = d1 * d4 - d3 * d2
    if vc <= 0 and d1 >= 0 and d3 <= 0:
        w[1] = d1 / (d1 - d3)
        w[0] = 1 - w[1]
        return w
    cp = p - x[2]
    d5, d6 = _dot(ab, cp), _dot(ac, cp)
    if d6 >= 0 and d5 <= d6:
        w[2] = 1
        return w
    vb = d5 * d2 - d1 * d6
    if vb <= 0 and d2 >= 0 and d6 <= 0:
        w[2] = d2 / (d2 - d6)
        w[0] = 1 - w[2]
        return w
    va = d3 * d6 - d5 * d4
    if va <= 0 and d4 - d3 >= 0 and d5 - d6 >= 0:
        w[2] = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        w[1] = 1 - w[2]
        return w
    total = va + vb + vc
    w[1], w[2] = vb / total, vc / total
    w[0] = 1 - w[1] - w[2]
    return w


@njit(cache=True)
def _dot(a: Array, b: Array) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
