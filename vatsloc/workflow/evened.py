"""Tissue near the pleura evened out: half of its motion is taken from the deeper tissue beside it.

Where blocks and keypoints end a few millimetres below the pleura, elasticity carries their scatter on to the surface,
while true motion is smooth there: affine maps of what lies deeper carry it on to half a millimetre.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from poro.mesh import TetMesh, closest_points
from registration.volume import Array
from vatsloc.workflow.refinement import unfolded

DEEP_MM = 8.0
"""Below the surface, from where on nodes are believed."""
FADING_MM = 3.0
"""Further down, over which the share taken from deeper nodes falls to nothing."""
SHARE = 0.5
REACH_MM = 16.0
"""Standard deviation of the weight of deeper nodes with their distance."""
NEIGHBOURS, LEAST_NEIGHBOURS = 40, 12
GRADIENT_WEIGHT_MM2 = 2.0
"""Of no gradient, against the neighbours' squared distances."""


def evened(mesh: TetMesh, moved: Array, piece: Array) -> Array:
    """Nodes (n, 3) mm of a moved lung, those within DEEP_MM of its surface drawn to where an affine map of the deeper
    nodes about them puts them. No element turns over that did not before.

    mesh: the lung before, in mm; piece: (n,) number of the piece that every node belongs to; other pieces have no say.
    """
    depth = np.abs(closest_points(mesh.boundary, mesh.points).distance)
    terms, change = np.column_stack([np.ones(len(moved)), mesh.points]), np.zeros_like(moved)
    for number in np.unique(piece):
        deep = np.flatnonzero((piece == number) & (depth >= DEEP_MM))
        shallow = np.flatnonzero((piece == number) & (depth < DEEP_MM + FADING_MM))
        if len(deep) < LEAST_NEIGHBOURS or len(shallow) == 0:
            continue
        beyond = moved - terms @ np.linalg.lstsq(terms[deep], moved[deep])[0]  # the best affine map of all deep nodes
        expected = _carried_on(mesh.points[deep], beyond[deep], mesh.points[shallow])
        share = SHARE * np.clip((DEEP_MM + FADING_MM - depth[shallow]) / FADING_MM, 0, 1)
        change[shallow] = share[:, None] * (expected - beyond[shallow])
    return moved + unfolded(moved, change, mesh.tets)


def _carried_on(points: Array, u: Array, to: Array) -> Array:
    """Displacements (k, 3) at places (k, 3) by affine maps of the nearest of points (n, 3), which move by u (n, 3)."""
    far, near = cKDTree(points).query(to, min(NEIGHBOURS, len(points)))
    weight = np.exp(-0.5 * ((far - far[:, :1]) / REACH_MM) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    terms = np.concatenate([np.ones((*far.shape, 1)), points[near] - to[:, None]], axis=2)
    normal = np.einsum("nka,nk,nkb->nab", terms, weight, terms)
    normal[:, 1:, 1:] += GRADIENT_WEIGHT_MM2 * np.eye(3)
    return np.asarray(np.linalg.solve(normal, np.einsum("nka,nk,nkc->nac", terms, weight, u[near]))[:, 0])
