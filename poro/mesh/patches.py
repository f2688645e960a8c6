"""Anatomical regions of a lung's surface, told apart by geometry in RAS."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from poro.arrays import Array
from poro.mesh.tetmesh import TetMesh
from poro.mesh.trisurface import TriSurface

# Cosines of the tilt up to which a face still counts as looking down, or inward.
DOWN, INWARD = 0.5, 0.35


@dataclass(frozen=True)
class Patches:
    """Disjoint boolean masks (n,) over the surface's nodes; together they cover it."""

    diaphragm: Array
    mediastinal: Array
    costal: Array
    hilum: Array


def principal_axis(mesh: TetMesh) -> Array:
    """First principal axis of the lung's volume, unit vector (3,) that points to the head. Ref: Alvarez 2021, sec.
    7.2.3.
    """
    centred = mesh.points - np.average(mesh.points, axis=0, weights=mesh.node_volumes)
    axis = np.linalg.eigh(centred.T @ (centred * mesh.node_volumes[:, None]))[1][:, -1]
    return axis if axis[2] >= 0 else -axis


HILUM_RADIUS_MM = 12.0
"""What is so near to a point of the hilum belongs to it."""


def patches(surface: TriSurface, hilum_points: Array) -> Patches:
    """Diaphragm (largest inferior-facing piece), hilum (near given points (k, 3)), mediastinal (facing the hilum),
    costal.

    Raises ValueError when no surface node looks down.
    """
    normal = surface.node_normals
    hilum_points = np.atleast_2d(hilum_points)
    centre = np.average(surface.points, axis=0, weights=surface.node_areas)
    medial = np.array([np.sign(hilum_points[:, 0].mean() - centre[0]), 0.0, 0.0])
    hilum = cKDTree(hilum_points).query(surface.points)[0] <= HILUM_RADIUS_MM
    below = surface.points[:, 2] < centre[2]
    down = (normal[:, 2] < -DOWN) & below & ~hilum
    if not down.any():
        raise ValueError("no part of the surface looks down; give the lung in RAS with the head along +S")
    diaphragm = _largest_piece(surface, down)
    mediastinal = (normal @ medial > INWARD) & ~diaphragm & ~hilum
    return Patches(diaphragm, mediastinal, ~(diaphragm | mediastinal | hilum), hilum)


def _largest_piece(surface: TriSurface, chosen: Array) -> Array:
    edges = surface.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = edges[chosen[edges].all(axis=1)]
    n = len(surface.points)
    _, label = connected_components(coo_matrix((np.ones(len(edges)), edges.T), shape=(n, n)), directed=False)
    area = np.bincount(label, surface.node_areas * chosen)
    return chosen & (label == np.argmax(area))
