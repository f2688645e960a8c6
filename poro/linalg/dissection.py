"""Fill-reducing elimination tree by geometric nested dissection. Ref: George 1973; Duff & Reid 1983 (multifrontal)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix

from poro.arrays import Array


@dataclass(frozen=True)
class Front:
    """Nodes first..last (new numbering) eliminated together, later nodes they touch, and children in the tree."""

    first: int
    last: int
    border: Array
    children: tuple[int, ...]


@dataclass(frozen=True)
class Tree:
    """Elimination tree in postorder. order: (n,) old node number at each new place."""

    order: Array
    fronts: tuple[Front, ...]

    def factor_entries(self, block: int) -> int:
        """Numbers stored by a Cholesky factor with `block` unknowns per node."""
        own = np.array([f.last - f.first for f in self.fronts], float)
        border = np.array([len(f.border) for f in self.fronts], float)
        return int(block**2 * (own * (own + border)).sum())


def dissect(graph: csr_matrix, points: Array, leaf: int = 48) -> Tree:
    """Elimination tree of a symmetric node graph (n, n) over points (n, 3), cut across the longest side again and
    again.
    """
    pieces: list[Array] = []
    below: list[tuple[int, ...]] = []
    side = np.zeros(len(points), np.int64)
    stamp = 0

    def split(nodes: Array) -> tuple[int, ...]:
        nonlocal stamp
        if len(nodes) > leaf:
            x = points[nodes]
            along = x[:, np.argmax(np.ptp(x, axis=0))]
            left = along < np.median(along)
            if left.any():
                stamp += 2
                side[nodes] = stamp + left
                rows = nodes[left]
                touching = np.add.reduceat(
                    np.append(side[_neighbours(graph, rows)] == stamp, False),
                    np.append(0, np.cumsum(graph.indptr[rows + 1] - graph.indptr[rows]))[:-1],
                )
                separator, left_nodes = rows[touching > 0], rows[touching == 0]
                children = (split(left_nodes) if len(left_nodes) else ()) + split(nodes[~left])
                if len(separator) == 0:
                    return children
                pieces.append(separator)
                below.append(children)
                return (len(pieces) - 1,)
        pieces.append(nodes)
        below.append(())
        return (len(pieces) - 1,)

    split(np.arange(len(points)))
    order = np.concatenate(pieces)
    place = np.empty(len(points), np.int64)
    place[order] = np.arange(len(points))
    fronts: list[Front] = []
    first = 0
    for nodes, children in zip(pieces, below, strict=True):
        last = first + len(nodes)
        touched = np.concatenate([place[_neighbours(graph, nodes)], *(fronts[c].border for c in children)])
        fronts.append(Front(first, last, np.unique(touched[touched >= last]), children))
        first = last
    return Tree(order, tuple(fronts))


def _neighbours(graph: csr_matrix, rows: Array) -> Array:
    """Column numbers of several rows, one after the other."""
    length = graph.indptr[rows + 1] - graph.indptr[rows]
    offset = np.repeat(graph.indptr[rows] - np.append(0, np.cumsum(length)[:-1]), length)
    return graph.indices[offset + np.arange(length.sum())]
