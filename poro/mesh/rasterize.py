"""A nodal field on the voxels of a grid: every tetrahedron writes its own, far cheaper than a search for each voxel."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from poro.arrays import Array
from poro.mesh.parts import share_out
from poro.mesh.tetmesh import TetMesh

ON_FACE = 1e-9
"""How far outside by its barycentric coordinates a voxel still counts as inside, so that none falls between two."""


def rasterize(mesh: TetMesh, nodal: Array, ijk_from_ras: Array, shape: tuple[int, int, int]) -> tuple[Array, Array]:
    """Values (ni, nj, nk, c) float32 of a nodal field (n, c) at the voxels whose centres lie in the mesh, zero at all
    others, and which these are, (ni, nj, nk) bool. ijk_from_ras: (4, 4) of the grid.

    A voxel on a face takes the values of the tetrahedron with the lower number.
    """
    nodal = np.ascontiguousarray(nodal, float)
    values, inside = np.zeros((*shape, nodal.shape[1]), np.float32), np.zeros(shape, bool)
    x = (mesh.points @ ijk_from_ras[:3, :3].T + ijk_from_ras[:3, 3])[mesh.tets]
    top = np.array(shape) - 1
    first = np.clip(np.ceil(x.min(axis=1) - 1e-6), 0, top + 1).astype(np.int64)
    last = np.clip(np.floor(x.max(axis=1) + 1e-6), -1, top).astype(np.int64)
    weights = np.linalg.inv(np.moveaxis(x[:, 1:] - x[:, :1], 1, 2))
    own = _Tetrahedra(x[:, 0].copy(), np.ascontiguousarray(weights), first, last, mesh.tets)
    share_out(lambda low, end: _fill(own, nodal, values, inside, low, end), shape[0], 1)
    return values, inside


class _Tetrahedra(NamedTuple):
    """In voxels: corner 0 (m, 3), weights of the others per voxel (m, 3, 3), first and last voxel (m, 3) that may lie
    inside; nodes (m, 4)."""

    corner: Array
    weights: Array
    first: Array
    last: Array
    nodes: Array


@njit(cache=True, nogil=True)
def _fill(tetrahedra, nodal, values, inside, low, end):
    """Voxels whose first index is in low..end."""
    corner, weights, first, last, tets = tetrahedra
    for t in range(len(tets)):
        for i in range(max(first[t, 0], low), min(last[t, 0] + 1, end)):
            for j in range(first[t, 1], last[t, 1] + 1):
                for k in range(first[t, 2], last[t, 2] + 1):
                    if inside[i, j, k]:
                        continue
                    a, b, c = i - corner[t, 0], j - corner[t, 1], k - corner[t, 2]
                    w1 = weights[t, 0, 0] * a + weights[t, 0, 1] * b + weights[t, 0, 2] * c
                    w2 = weights[t, 1, 0] * a + weights[t, 1, 1] * b + weights[t, 1, 2] * c
                    w3 = weights[t, 2, 0] * a + weights[t, 2, 1] * b + weights[t, 2, 2] * c
                    w0 = 1 - w1 - w2 - w3
                    if min(min(w0, w1), min(w2, w3)) < -ON_FACE:
                        continue
                    inside[i, j, k] = True
                    for m in range(nodal.shape[1]):
                        values[i, j, k, m] = (
                            w0 * nodal[tets[t, 0], m]
                            + w1 * nodal[tets[t, 1], m]
                            + w2 * nodal[tets[t, 2], m]
                            + w3 * nodal[tets[t, 3], m]
                        )
