"""Elastic continuation of displacements known in a part of the lung. Ref: Alvarez 2021, sec. 6.2.

With kappa_b = 0 and no pressure on the surface the pressure vanishes everywhere, so only the solid is solved.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from scipy.sparse import coo_matrix

from poro.assembly import deformation_gradient
from poro.mesh.locate import locate
from poro.mesh.tetmesh import Array, TetMesh
from poro.solid import solid
from poro.springs import point_operator, springs
from poro.tissue import Tissue


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


def extrapolate(
    mesh: TetMesh,
    nodes: Array,
    displacement_mm: Array,
    tissue: Tissue,
    weights: Array | None = None,
    min_det: float = 0.05,
    max_rounds: int = 4,
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
        if rounds == max_rounds or not release.any() or (kept & ~release).sum() < 3:
            break
        kept &= ~release
    status = ExtrapolationStatus.SOLVED if kept.all() else ExtrapolationStatus.RELEASED
    if (det_f <= 0).any():
        status = ExtrapolationStatus.INVERTED
    return Extrapolation(u, det_f, nodes[~kept], rounds, status)


def _continue(mesh: TetMesh, nodes: Array, displacement: Array, tissue: Tissue, weights: Array | None) -> Array:
    still = np.zeros_like(mesh.points)
    if weights is None:
        order = np.argsort(nodes)
        return solid(mesh, tissue, nodes).solve(still, displacement[order])
    # A weight of 1 makes the spring as stiff as the tissue that one node stands for.
    stiffness = weights * tissue.young_kpa * np.cbrt(mesh.node_volumes[nodes])
    k = len(nodes)
    operator = coo_matrix((np.ones(k), (np.arange(k), nodes)), shape=(k, len(mesh.points))).tocsr()
    matrix, force = springs(operator, stiffness, displacement)
    return solid(mesh, tissue, np.zeros(0, int), matrix).solve(force)


@dataclass(frozen=True)
class Pull:
    """Springs at points of a deformed lung. points: (q, 3) mm; offset: (q, 3) mm; sigma_mm: (q,) uncertainty.

    normals: (q, 3) unit vectors along which alone the spring acts, or zero rows for all directions.
    """

    points: Array
    offset: Array
    sigma_mm: Array
    normals: Array


@dataclass(frozen=True)
class Correction:
    """Elastic displacement on top of a solved state. u: (n, 3) mm; det_f: (m,) of the correction alone; misfit_mm:
    (q,).
    """

    u: Array
    det_f: Array
    misfit_mm: Array
    influence: Array


def correct(
    mesh: TetMesh, u: Array, tissue: Tissue, pull: Pull, model_sigma: float = 0.05, robust: float = 3.0, rounds: int = 4
) -> Correction:
    """Least elastic energy that brings a solved state (n, 3) nearer to matched points, outliers losing influence
    (Cauchy).

    model_sigma: strain the solved state may be wrong by over one tenth of a litre; it sets how stiff the tissue is
    against millimetres of misfit. The elasticity starts from the deformed shape, so the correction is small even
    where u is large.
    """
    deformed = TetMesh(mesh.points + u, mesh.tets)
    where = locate(deformed, pull.points)
    operator = point_operator(where, len(u))
    axial = np.linalg.norm(pull.normals, axis=1) > 0.5
    shape = np.where(axial[:, None, None], pull.normals[:, :, None] * pull.normals[:, None, :], np.eye(3))
    # Energy per unit variance: a 0.1 l region strained by model_sigma weighs as much as one standard deviation of
    # misfit.
    unit = tissue.young_kpa * 1e5 * model_sigma**2
    influence = where.inside / (1 + np.minimum(where.distance, 1e3))
    field = np.zeros_like(u)
    for _ in range(rounds):
        stiffness = (unit * influence / pull.sigma_mm**2)[:, None, None] * shape
        anchor = 1e-9 * tissue.young_kpa * np.cbrt(deformed.node_volumes)
        matrix, force = springs(operator, stiffness, pull.offset)
        every = coo_matrix((np.repeat(anchor, 3), (np.arange(3 * len(u)),) * 2)).tocsr()
        field = solid(deformed, tissue, np.zeros(0, int), (matrix + every).tocsr()).solve(force)
        rest = np.einsum("qij,qj->qi", shape, pull.offset - operator @ field)
        misfit = np.linalg.norm(rest, axis=1)
        influence = where.inside / (1 + (misfit / (robust * pull.sigma_mm)) ** 2)
    det_f = np.linalg.det(deformation_gradient(deformed, field))
    return Correction(field, det_f, misfit, influence)
