"""Elastic continuation of displacements known in a part of the lung. Ref: Alvarez 2021, sec. 6.2.

With kappa_b = 0 and no pressure on the surface the pressure vanishes everywhere, so only the solid is solved.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from scipy.sparse import coo_matrix

from poro.arrays import Array
from poro.fem.constraints import point_constraints
from poro.fem.forms import deformation_gradient
from poro.fem.solid import constrained, continued
from poro.fem.tissue import Tissue
from poro.mesh.tetmesh import TetMesh


class ExtrapolationStatus(Enum):
    """How an extrapolation ended."""

    SOLVED = "all imposed displacements were used and no element is inverted"
    RELEASED = "imposed displacements that inverted elements were released"
    INVERTED = "elements stay inverted although the displacements around them were released"


@dataclass(frozen=True)
class Extrapolation:
    """Displacement of the whole mesh. u: (n, 3) mm; det_f: (m,); released: node numbers whose imposed value was
    dropped.
    """

    u: Array
    det_f: Array
    released: Array
    rounds: int
    status: ExtrapolationStatus


MAX_ROUNDS = 4
"""Of releasing nodes whose elements are squeezed."""


def extrapolate(
    mesh: TetMesh,
    nodes: Array,
    displacement_mm: Array,
    tissue: Tissue,
    weights: Array | None = None,
    min_det: float = 0.05,
) -> Extrapolation:
    """Continue displacements (k, 3) mm of `nodes` (k,) elastically to the whole mesh.

    weights: (k,) squared ratio of node spacing to the length over which a single value may be smoothed; exact when
    None. Values that turn an element below `min_det` are released, round by round. Raises ValueError for fewer than
    three nodes.
    """
    nodes = np.asarray(nodes)
    if len(np.unique(nodes)) < 3 or displacement_mm.shape != (len(nodes), 3):
        raise ValueError(
            f"need displacements (k, 3) at three or more nodes, got {displacement_mm.shape} at {len(nodes)}"
        )
    kept = np.ones(len(nodes), bool)
    rounds = 0
    while True:
        rounds += 1
        part = None if weights is None else weights[kept]
        u = _continue(mesh, nodes[kept], displacement_mm[kept], tissue, part)
        det_f = np.linalg.det(deformation_gradient(mesh, u))
        bad = np.unique(mesh.tets[det_f < min_det])
        release = kept & np.isin(nodes, bad)
        if rounds == MAX_ROUNDS or not release.any() or (kept & ~release).sum() < 3:
            break
        kept &= ~release
    status = ExtrapolationStatus.SOLVED if kept.all() else ExtrapolationStatus.RELEASED
    if (det_f <= 0).any():
        status = ExtrapolationStatus.INVERTED
    return Extrapolation(u, det_f, nodes[~kept], rounds, status)


def _continue(mesh: TetMesh, nodes: Array, displacement: Array, tissue: Tissue, weights: Array | None) -> Array:
    if weights is None:
        order = np.argsort(nodes)
        return continued(mesh, tissue, nodes[order], displacement[order])
    # A weight of 1 makes the constraint as stiff as the tissue that one node stands for.
    stiffness = weights * tissue.young_kpa * np.cbrt(mesh.node_volumes[nodes])
    k = len(nodes)
    operator = coo_matrix((np.ones(k), (np.arange(k), nodes)), shape=(k, len(mesh.points))).tocsr()
    matrix, force = point_constraints(operator, stiffness, displacement)
    return constrained(mesh, tissue, matrix).solve(force)
