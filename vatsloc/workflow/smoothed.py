"""The motion of a lung smoothed: blocks and keypoints scatter, and elasticity carries their scatter on, while true
motion is smooth inside a lung and right up to its pleura.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from poro.mesh import TetMesh
from registration.maps.moving_least_squares import MovingLeastSquares, moving_least_squares
from registration.volume import Array

TOLD_MM = 4.0
"""Below the surface, from where on nodes tell others how they move: nearer to it, few blocks told them anything."""
LEAST_NODES = 40


@dataclass(frozen=True)
class Smoother:
    """How nodes are smoothed by those about them. parts: of each piece, the nodes that tell, those that are told, and
    how.
    """

    parts: tuple[tuple[Array, Array, MovingLeastSquares], ...]

    def __call__(self, moved: Array) -> Array:
        """Nodes (n, 3) mm of a moved lung, smoothed."""
        smooth = moved.copy()
        for telling, told, fit in self.parts:
            smooth[told] = fit(moved[telling])
        return smooth


def smoother(mesh: TetMesh, piece: Array, held: Array) -> Smoother:
    """Of a lung's nodes: each piece apart, by its nodes deeper than TOLD_MM; a piece with hardly any stays as it is.

    mesh: the lung before it moved, mm; piece: (n,) number of the piece that every node belongs to; held: (k,) nodes
    that stay where they are.
    """
    free = np.ones(len(mesh.points), dtype=bool)
    free[held] = False
    parts = []
    for number in np.unique(piece):
        telling = np.flatnonzero((piece == number) & (mesh.node_depths >= TOLD_MM))
        told = np.flatnonzero((piece == number) & free)
        if len(telling) >= LEAST_NODES and len(told):
            fit = moving_least_squares(mesh.points[telling], mesh.points[told])
            parts.append((telling, told, fit))
    return Smoother(tuple(parts))
