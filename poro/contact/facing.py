"""Two deformable surfaces that may touch and slide but not pass through each other.

Each node of one of them is held against a weighted mean of the other's nodes about it, so that a constant pressure
passes from one mesh to another as it is. Ref: Popp, Gitterle, Gee & Wall 2010 (dual mortar contact, its active set).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix, diags

from poro.arrays import Array
from poro.contact.mortar import Reach, mortar
from poro.mesh.trisurface import TriSurface

REACH = Reach(apart=10.0, deep=10.0)
"""Deeper in each other, a thin piece's back would be taken for a front."""
LEAST_SHARE = 0.05
"""Of the area about a node, what has to lie above the other surface for the node to have a gap."""
FAR_MM = 1e3
"""Gap of a node that faces nothing."""


@dataclass(frozen=True)
class Gaps:
    """Weighted gaps at s nodes of a surface. gap: (s,) mm; matrix: (s, 3 nc) their derivatives by the displacements of
    all contact nodes, empty rows where a node faces nothing; area: (s,) mm2 over which each is a mean.
    """

    gap: Array
    matrix: csr_matrix
    area: Array

    @property
    def meets(self) -> Array:
        """Nodes (s,) bool that face the other surface."""
        return self.area > 0

    @property
    def overlap_mm3(self) -> float:
        """Volume in which the surfaces lie in each other."""
        return float(self.area @ np.maximum(-self.gap, 0))


@dataclass(frozen=True)
class Facing:
    """Two surfaces of the contact nodes. rest: (nc, 3) mm; first, second: (t, 3) triangles by contact node, outward;
    nodes: (s,) of the first whose weighted gap may not be negative, all but those that both surfaces share.
    """

    rest: Array
    first: Array
    second: Array
    nodes: Array
    reach: Reach = REACH

    @staticmethod
    def of(rest: Array, first: Array, second: Array, reach: Reach = REACH) -> Facing:
        """Two surfaces; where they share nodes they have grown together, and no gap is asked for."""
        return Facing(rest, first, second, np.setdiff1d(first, second), reach)

    def among(self, nodes: Array) -> Facing:
        """The surfaces between some of the contact nodes (k,) alone, sorted, numbered anew."""
        place = np.full(len(self.rest), -1)
        place[nodes] = np.arange(len(nodes))
        first, second = (place[t][(place[t] >= 0).all(axis=1)] for t in (self.first, self.second))
        shared = np.intersect1d(self.first, self.second)
        return Facing(self.rest[nodes], first, second, np.setdiff1d(first, place[shared]), self.reach)

    def gaps(self, u: Array) -> Gaps:
        """Weighted gaps at displacements u (nc, 3) mm, linearized with normals and overlap as they are there."""
        points, count = self.rest + u, len(self.nodes)
        found = mortar(points, self.first, self.second, self.reach)
        surface = TriSurface(points, self.first, np.arange(len(points)))
        around, n = surface.node_areas[self.nodes], surface.node_normals[self.nodes]
        area = found.own[self.nodes]
        area = np.where(area > LEAST_SHARE * around, area, 0.0)
        meets = area > 0
        weights = (
            diags(np.where(meets, 1 / np.where(meets, area, 1), 0))
            @ (found.other - diags(found.own)).tocsr()[self.nodes]
        )
        blocks = weights.tocsr()
        blocks.eliminate_zeros()
        rows = np.repeat(np.arange(count), np.diff(blocks.indptr))
        matrix = csr_matrix(
            (
                (blocks.data[:, None] * n[rows]).ravel(),
                (3 * blocks.indices[:, None] + np.arange(3)).ravel(),
                3 * blocks.indptr,
            ),
            shape=(count, points.size),
        )
        gap = np.where(meets, matrix @ points.ravel(), FAR_MM)
        return Gaps(gap, matrix, area)
