"""Exact closest points on a triangulated surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from poro.arrays import Array
from poro.mesh.parts import share_out
from poro.mesh.trisurface import TriSurface

CLUSTER = 8  # triangles per bounding sphere
FEW = 1000  # queries that one thread answers sooner than two


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
    tree = cKDTree(x.mean(axis=1), leafsize=CLUSTER)
    # The tree's leaf order keeps neighbours together, so that runs of it make tight bounding spheres.
    order = tree.indices
    sorted_x = np.ascontiguousarray(x[order])
    starts = np.arange(0, len(order), CLUSTER)
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    centres = np.add.reduceat(sorted_x.mean(axis=1), starts) / np.diff(np.append(starts, len(order)))[:, None]
    reach = np.linalg.norm(sorted_x - np.repeat(centres, CLUSTER, axis=0)[: len(order), None], axis=2).max(axis=1)
    radii = np.maximum.reduceat(reach, starts)
    guess = place[tree.query(queries)[1]]
    found, bary = np.empty(len(queries), np.int64), np.empty((len(queries), 3))
    clusters = _Clusters(sorted_x, centres, radii)
    share_out(
        lambda first, end: _search(queries, clusters, guess, found, bary, first, end),
        len(queries),
        FEW,
    )
    triangle = order[found]
    points = np.einsum("qk,qkd->qd", bary, x[triangle])
    offset = queries - points
    normal = np.einsum("qk,qkd->qd", bary, surface.node_normals[surface.triangles[triangle]])
    # On a face the face's own normal decides; only edges and corners need the interpolated one.
    normal = np.where((bary.min(axis=1) > 1e-9)[:, None], surface.normals[triangle], normal)
    sign = np.where(np.einsum("qd,qd->q", offset, normal) < 0, -1.0, 1.0)
    return ClosestPoints(points, triangle, bary, sign * np.linalg.norm(offset, axis=1))


def depth_below(surface: TriSurface, points: Array) -> Array:
    """How deep points (q, 3) mm lie below a closed surface, (q,) mm; negative outside it."""
    return -closest_points(surface, points).distance


class _Clusters(NamedTuple):
    """CLUSTER triangles (t, 3, 3) mm each that lie together, and the spheres (c, 3), (c,) mm about them."""

    triangles: Array
    centres: Array
    radii: Array


@njit(cache=True, nogil=True)
def _search(queries, clusters, guess, found, bary, begin, end):
    """Nearest triangle (q,) and weights (q, 3) of queries begin..end, clusters of triangles skipped when their sphere
    lies beyond the best so far.
    """
    x, centres, radii = clusters
    for q in range(begin, end):
        px, py, pz = queries[q, 0], queries[q, 1], queries[q, 2]
        best = guess[q]
        v, w, least = _project(px, py, pz, x[best])
        reach = np.sqrt(least)
        for cluster in range(len(centres)):
            d2 = (px - centres[cluster, 0]) ** 2 + (py - centres[cluster, 1]) ** 2 + (pz - centres[cluster, 2]) ** 2
            if d2 < (reach + radii[cluster]) ** 2:
                for t in range(cluster * CLUSTER, min((cluster + 1) * CLUSTER, len(x))):
                    tv, tw, gap = _project(px, py, pz, x[t])
                    if gap < least:
                        v, w, least, best, reach = tv, tw, gap, t, np.sqrt(gap)
        found[q] = best
        bary[q, 0], bary[q, 1], bary[q, 2] = 1 - v - w, v, w


@njit(cache=True)
def _project(px: float, py: float, pz: float, x: Array) -> tuple[float, float, float]:
    """Weights of corners 1 and 2 of the point of triangle x (3, 3) nearest to p, and the squared distance.

    Ref: Ericson 2005, section 5.1.5.
    """
    bx, by, bz = x[1, 0] - x[0, 0], x[1, 1] - x[0, 1], x[1, 2] - x[0, 2]
    cx, cy, cz = x[2, 0] - x[0, 0], x[2, 1] - x[0, 1], x[2, 2] - x[0, 2]
    ax, ay, az = px - x[0, 0], py - x[0, 1], pz - x[0, 2]
    bb, bc, cc = bx * bx + by * by + bz * bz, bx * cx + by * cy + bz * cz, cx * cx + cy * cy + cz * cz
    d1, d2 = bx * ax + by * ay + bz * az, cx * ax + cy * ay + cz * az
    d3, d4, d5, d6 = d1 - bb, d2 - bc, d1 - bc, d2 - cc
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    v, w = 0.0, 0.0
    if d1 <= 0 and d2 <= 0:
        pass
    elif d3 >= 0 and d4 <= d3:
        v = 1.0
    elif vc <= 0 and d1 >= 0 and d3 <= 0:
        v = d1 / bb
    elif d6 >= 0 and d5 <= d6:
        w = 1.0
    elif vb <= 0 and d2 >= 0 and d6 <= 0:
        w = d2 / cc
    elif va <= 0 and d4 >= d3 and d5 >= d6:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        v = 1 - w
    else:
        v, w = vb / (va + vb + vc), vc / (va + vb + vc)
    ex, ey, ez = ax - v * bx - w * cx, ay - v * by - w * cy, az - v * bz - w * cz
    return v, w, ex * ex + ey * ey + ez * ez
