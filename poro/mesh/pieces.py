"""A lung in pieces: tetrahedra that a sheet parts, with nodes of their own on either side of it.

Both pieces are stuffed on one lattice, so that the nodes of the cut coincide and no element is a sliver. Where the
pieces have grown together they share these nodes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from poro.arrays import Array
from poro.mesh.stuffing import mask_level, stuff_level_set
from poro.mesh.tetmesh import TetMesh

SAME_MM = 1e-6
"""Nodes of two pieces this near to each other are one place."""


@dataclass(frozen=True)
class Pieces:
    """A mesh in two pieces. mesh: of both; piece: (m,) number of the piece of every tetrahedron, 0 where the sheet's
    side is positive; pairs: (k, 2) nodes of piece 0 and 1 that lie at one place and are free of each other.
    """

    mesh: TetMesh
    piece: Array
    pairs: Array

    def node_piece(self) -> Array:
        """Piece (n,) of every node; shared nodes count as piece 0."""
        out = np.ones(len(self.mesh.points), dtype=int)
        out[self.mesh.tets[self.piece == 0]] = 0
        return out

    def part(self, number: int) -> tuple[TetMesh, Array]:
        """The mesh of one piece, and the numbers (k,) of its nodes in the whole."""
        nodes, local = np.unique(self.mesh.tets[self.piece == number], return_inverse=True)
        return TetMesh(self.mesh.points[nodes], local.reshape(-1, 4)), nodes


def stuff_pieces(
    inside: Array,
    ras_from_ijk: Array,
    edge_mm: float,
    side: Callable[[Array], Array],
    joined: Callable[[Array], Array],
) -> Pieces:
    """Tetrahedra of mean edge `edge_mm` that fill a mask (ni, nj, nk) bool, cut where `side` is zero.

    side: signed distance (n,) mm of points (n, 3) from the sheet; joined: (n,) bool, where the pieces are one.
    Raises ValueError where a piece is too thin to hold an element.
    """
    level, lower, upper = mask_level(inside, ras_from_ijk, edge_mm)

    def one_side(sign: float) -> Callable[[Array], Array]:
        return lambda points: np.minimum(level(points), sign * side(points))

    first, second = (stuff_level_set(one_side(sign), lower, upper, edge_mm) for sign in (1.0, -1.0))
    far, twin = cKDTree(first.points).query(second.points, distance_upper_bound=SAME_MM)
    same = np.isfinite(far)
    shared = same & joined(second.points)
    number = np.empty(len(second.points), dtype=np.int64)
    number[shared] = twin[shared]
    number[~shared] = len(first.points) + np.arange((~shared).sum())
    mesh = TetMesh(
        np.concatenate([first.points, second.points[~shared]]), np.concatenate([first.tets, number[second.tets]])
    )
    free = same & ~shared
    return Pieces(
        mesh,
        np.repeat([0, 1], [len(first.tets), len(second.tets)]),
        np.stack([twin[free], number[free]], axis=1),
    )
