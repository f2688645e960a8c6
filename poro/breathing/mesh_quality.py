"""Shape of tetrahedra: the limits of Eom's table II, and descent on V / L^3.

Ref: Eom 2010, section III A; Li 2008, eq. 1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from poro.arrays import Array
from poro.mesh.tetmesh import TetMesh, signed_volumes

REGULAR = 6 * np.sqrt(2)
"""L^3 / V of a regular tetrahedron, which makes its quality 1."""
_EDGES = np.array(np.triu_indices(4, 1)).T
_FACES = np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])
ROUNDS, STEP = 10, 0.15
"""Of the descent: the paper takes ten iterations; a node moves by that share of its shortest edge at most."""


class Shares(NamedTuple):
    """Shares of elements beyond each limit (Jacobian below 0.9, edges' ratio above 2, surface angles above 80 and below
    50 degrees), and the worst quality V / L^3, 1 for a regular one.
    """

    jacobian: float
    aspect: float
    wide: float
    narrow: float
    worst: float


def quality(points: Array, tets: Array) -> Array:
    """C V / L^3 of every tetrahedron (m,), L the root mean square of its edges; 1 for a regular one."""
    edges = points[tets[:, _EDGES[:, 0]]] - points[tets[:, _EDGES[:, 1]]]
    length = np.sqrt((edges**2).sum(axis=2).mean(axis=1))
    return np.asarray(REGULAR * signed_volumes(points, tets) / length**3)


def violations(mesh: TetMesh) -> Shares:
    """How many elements are beyond the limits. A linear tetrahedron has one Jacobian only, so its ratio over the
    integration points is 1; here it stands for the quality V / L^3, which measures the same distance from regular.
    """
    q = quality(mesh.points, mesh.tets)
    x = mesh.points[mesh.tets]
    edge = np.linalg.norm(x[:, _EDGES[:, 0]] - x[:, _EDGES[:, 1]], axis=2)
    corners = x[:, _FACES]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=2), axis=3)
    a, b, c = sides[..., 0], sides[..., 1], sides[..., 2]
    angles = [
        np.degrees(np.arccos(np.clip((p**2 + r**2 - s**2) / (2 * p * r), -1, 1)))
        for p, r, s in ((a, b, c), (b, c, a), (c, a, b))
    ]
    angle = np.concatenate(angles, axis=1)
    return Shares(
        float((q < 0.9).mean()),
        float((edge.max(axis=1) / edge.min(axis=1) > 2).mean()),
        float((angle.max(axis=1) > 80).mean()),
        float((angle.min(axis=1) < 50).mean()),
        float(q.min()),
    )


def smooth(mesh: TetMesh) -> TetMesh:
    """The mesh with its inner nodes moved uphill in quality, worst elements first; the surface stays.

    A step is the gradient of the sum of 1/q over the elements, taken where it does not lower the worst quality about a
    node. Ref: Li 2008, section 3.1.
    """
    points, tets = mesh.points.copy(), mesh.tets
    inner = np.ones(len(points), bool)
    inner[mesh.boundary.nodes] = False
    shortest = _shortest(points, tets)
    for _ in range(ROUNDS):
        pull = np.zeros_like(points)
        q, slope = _slopes(points, tets)
        for k in range(4):
            np.add.at(pull, tets[:, k], slope[:, k] / q[:, None] ** 2)
        length = np.linalg.norm(pull, axis=1)
        move = STEP * shortest[:, None] * pull / np.maximum(length, 1e-30)[:, None] * inner[:, None]
        worst = _worst(q, tets, len(points))
        for _ in range(4):
            after = quality(points + move, tets)
            bad = _worst(after, tets, len(points)) < worst - 1e-12
            # A node's elements also hold its neighbours, so every node of a worsened element takes a smaller step.
            move[bad] *= 0.5
            if not bad.any():
                break
        else:
            move[bad] = 0.0
            if (_worst(quality(points + move, tets), tets, len(points)) < worst.min() - 1e-12).any():
                break
        points = points + move
    return TetMesh(points, tets)


def _shortest(points: Array, tets: Array) -> Array:
    edge = np.linalg.norm(points[tets[:, _EDGES[:, 0]]] - points[tets[:, _EDGES[:, 1]]], axis=2).min(axis=1)
    out = np.full(len(points), np.inf)
    for k in range(4):
        np.minimum.at(out, tets[:, k], edge)
    return out


def _worst(q: Array, tets: Array, nodes: int) -> Array:
    out = np.full(nodes, np.inf)
    for k in range(4):
        np.minimum.at(out, tets[:, k], q)
    return out


def _slopes(points: Array, tets: Array) -> tuple[Array, Array]:
    """Quality (m,) and its derivative (m, 4, 3) by the corners."""
    x = points[tets]
    volume = signed_volumes(points, tets)
    by_volume = np.empty((len(tets), 4, 3))
    for k, (a, b, c) in enumerate(((1, 3, 2), (0, 2, 3), (0, 3, 1), (0, 1, 2))):
        by_volume[:, k] = np.cross(x[:, b] - x[:, a], x[:, c] - x[:, a]) / 6
    square = np.zeros(len(tets))
    by_square = np.zeros((len(tets), 4, 3))
    for i, j in _EDGES:
        d = x[:, i] - x[:, j]
        square += (d**2).sum(axis=1) / 6
        by_square[:, i] += d / 3
        by_square[:, j] -= d / 3
    q = REGULAR * volume / square**1.5
    slope = REGULAR * by_volume / square[:, None, None] ** 1.5 - (1.5 * q / square)[:, None, None] * by_square
    return q, slope
