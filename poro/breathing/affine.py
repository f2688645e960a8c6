"""Affine maps as yardsticks of a lung's motion: fitted to matched points, and fitted to the shape alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from poro.arrays import Array
from poro.mesh import TriSurface, closest_points

_ROUNDS = 40
_HUBER_MM = 3.0


@dataclass(frozen=True)
class Affine:
    """x -> matrix x + shift, mm."""

    matrix: Array
    shift: Array

    def __call__(self, points: Array) -> Array:
        """Images of points (n, 3)."""
        return points @ self.matrix.T + self.shift


def affine_to_points(points: Array, images: Array) -> Affine:
    """Least-squares affine map of points (n, 3) onto images (n, 3)."""
    solution = np.linalg.lstsq(np.column_stack([points, np.ones(len(points))]), images, rcond=None)[0]
    return Affine(solution[:3].T, solution[3])


def affine_to_shape(start: TriSurface, onto: TriSurface) -> Affine:
    """Affine map that lays one closed surface on another: distances along the normal, both ways, robust.

    Starts from equal centroids and extents along the axes. Ref: Chen & Medioni 1992, with an affine map.
    """
    (a, spread_a), (b, spread_b) = _moments(start), _moments(onto)
    found = Affine(np.diag(spread_b / spread_a), b - spread_b / spread_a * a)
    centre = a
    for _ in range(_ROUNDS):
        moved = start.moved(found(start.points))
        there = closest_points(onto, moved.points)
        back = closest_points(moved, onto.points)
        origin = np.einsum("qk,qkd->qd", back.barycentric, start.points[start.triangles[back.triangle]])
        x = np.concatenate([start.points, origin]) - centre
        y = np.concatenate([there.points, onto.points])
        normal = np.concatenate([onto.normals[there.triangle], onto.node_normals])
        facing = np.concatenate([moved.node_normals, moved.normals[back.triangle]])
        area = np.concatenate([start.node_areas / start.areas.sum(), onto.node_areas / onto.areas.sum()])
        rest = np.einsum("qd,qd->q", normal, y - found(x + centre))
        agree = np.clip(np.einsum("qd,qd->q", normal, facing), 0, 1)
        weight = np.sqrt(area * agree * np.minimum(1, _HUBER_MM / np.maximum(np.abs(rest), 1e-9)))
        rows = np.concatenate([np.einsum("qi,qj->qij", normal, x).reshape(-1, 9), normal], axis=1)
        step = np.linalg.lstsq(rows * weight[:, None], rest * weight, rcond=None)[0]
        matrix = found.matrix + step[:9].reshape(3, 3)
        found = Affine(matrix, found(centre) + step[9:] - matrix @ centre)
        if np.abs(step[9:]).max() < 1e-3 and np.abs(step[:9]).max() < 1e-5:
            break
    return found


def _moments(surface: TriSurface) -> tuple[Array, Array]:
    """Area-weighted centroid and standard deviations along the axes, (3,) mm each."""
    centre = np.average(surface.points, axis=0, weights=surface.node_areas)
    return centre, np.sqrt(np.average((surface.points - centre) ** 2, axis=0, weights=surface.node_areas))
