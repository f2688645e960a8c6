"""Which tetrahedron holds a point, and what a nodal field is worth there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from poro.arrays import Array
from poro.mesh.closest import closest_points
from poro.mesh.parts import share_out
from poro.mesh.tetmesh import TetMesh

FEW = 5000  # points that one thread locates sooner than two


@dataclass(frozen=True)
class Location:
    """Where points lie in a mesh.

    nodes: (q, 4) corners of the tetrahedron; barycentric: (q, 4); inside: (q,) bool; distance: (q,) mm, 0 inside.
    Points outside carry the weights of the nearest point of the surface, or none at an infinite distance.
    """

    nodes: Array
    barycentric: Array
    inside: Array
    distance: Array


def locate(mesh: TetMesh, points: Array, nearest: bool = True) -> Location:
    """Tetrahedron and barycentric coordinates of points (q, 3) mm.

    Points outside get those of the nearest surface point, or zeros where `nearest` is False, which is far cheaper.
    """
    points = np.ascontiguousarray(points, float)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points must be (q, 3), got {points.shape}")
    tet, bary = np.full(len(points), -1), np.zeros((len(points), 4))
    corner, gradients, cells = mesh.points[mesh.tets[:, 0]], mesh.gradients, mesh.cells
    share_out(lambda begin, end: _search(points, corner, gradients, cells, tet, bary, begin, end), len(points), FEW)
    nodes = mesh.tets[np.maximum(tet, 0)]
    distance = np.zeros(len(points))
    lost = np.flatnonzero(tet < 0)
    if not nearest:
        bary[lost], distance[lost] = 0.0, np.inf
    elif len(lost):
        surface = mesh.boundary
        near = closest_points(surface, points[lost])
        nodes[lost, :3] = surface.nodes[surface.triangles[near.triangle]]
        nodes[lost, 3] = nodes[lost, 0]
        bary[lost, :3] = near.barycentric
        bary[lost, 3] = 0
        distance[lost] = np.abs(near.distance)
    return Location(nodes, bary, tet >= 0, distance)


def interpolate(location: Location, nodal: Array) -> Array:
    """Values (q, ...) of a nodal field (n, ...) at located points."""
    return np.einsum("qk,qk...->q...", location.barycentric, nodal[location.nodes])


@njit(cache=True, nogil=True)
def _search(points, corner, gradients, cells, found, bary, begin, end):
    """Tetrahedron (q,) and weights (q, 4) of points begin..end; left as they are for points outside."""
    origin, width, shape, start, members = cells
    for q in range(begin, end):
        i = int(np.floor((points[q, 0] - origin[0]) / width))
        j = int(np.floor((points[q, 1] - origin[1]) / width))
        k = int(np.floor((points[q, 2] - origin[2]) / width))
        if i < 0 or j < 0 or k < 0 or i >= shape[0] or j >= shape[1] or k >= shape[2]:
            continue
        cell = (i * shape[1] + j) * shape[2] + k
        for s in range(start[cell], start[cell + 1]):
            t = members[s]
            w1 = w2 = w3 = 0.0
            for d in range(3):
                offset = points[q, d] - corner[t, d]
                w1 += gradients[t, 1, d] * offset
                w2 += gradients[t, 2, d] * offset
                w3 += gradients[t, 3, d] * offset
            w0 = 1 - w1 - w2 - w3
            if min(min(w0, w1), min(w2, w3)) >= -1e-9:
                found[q] = t
                bary[q, 0], bary[q, 1], bary[q, 2], bary[q, 3] = w0, w1, w2, w3
                break
