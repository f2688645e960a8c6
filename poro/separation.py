"""Two pieces of a body that overlap, pressed apart without friction: both give way as their tissue and their data let
them.

Registration moves each piece for itself and knows nothing of the other one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import diags
from scipy.spatial import cKDTree

from poro.arrays import Array
from poro.contact.active_set import ContactState, solve_contact
from poro.contact.chest_wall import ChestWall
from poro.contact.compliance import Compliance
from poro.contact.facing import Facing
from poro.contact.levelset import LevelSet
from poro.fem.constraints import interpolation_matrix, point_constraints
from poro.fem.forms import stiffness
from poro.fem.solid import anchor, unknowns_of
from poro.fem.tissue import Tissue
from poro.fit.elastic_correction import energy_per_datum
from poro.linalg.solver import linear_solver
from poro.mesh.locate import locate
from poro.mesh.pieces import Pieces

NEAR_MM = 15.0
"""How far from an overlap nodes take part in contact."""
TOLERANCE_MM = 0.05
"""Largest last motion of a contact node; facets that come and go may move some by 0.01 mm for ever."""


@dataclass(frozen=True)
class Held:
    """Points of a body that are known to be where they are. points: (q, 3) mm at rest; sigma_mm: (q,) how well."""

    points: Array
    sigma_mm: Array


@dataclass(frozen=True)
class Separation:
    """u: (n, 3) mm that separates the pieces, on top of where they were; before_mm3, after_mm3: their overlap; contact:
    of the nodes `nodes` (nc,), None where nothing overlapped.
    """

    u: Array
    before_mm3: float
    after_mm3: float
    nodes: Array
    contact: ContactState | None


def facing_pieces(pieces: Pieces, points: Array) -> Facing:
    """The surfaces of two pieces whose nodes are at points (n, 3), all nodes being contact nodes."""
    first, second = (nodes[part.boundary.nodes[part.boundary.triangles]] for part, nodes in map(pieces.part, (0, 1)))
    return Facing.of(points, first, second)


def hold_apart(
    pieces: Pieces, u: Array, tissue: Tissue, held: Held, wall: LevelSet, model_sigma: float = 0.05
) -> Separation:
    """The elastic displacement of least energy, that of the data included, after which pieces displaced by u (n, 3) mm
    no longer overlap.

    model_sigma: as in `elastic_correction`; wall: of the chest, behind which no node goes farther than it is.
    """
    mesh, still = pieces.mesh, np.zeros_like(u)
    whole = facing_pieces(pieces, mesh.points + u)
    gaps = whole.gaps(still)
    before = gaps.overlap_mm3
    deep = whole.nodes[gaps.gap < 0]
    surface = np.union1d(whole.first, whole.second)
    if not len(deep):
        return Separation(still, before, before, deep, None)
    near = cKDTree(whole.rest[deep]).query(whole.rest[surface], distance_upper_bound=NEAR_MM)[0] < NEAR_MM
    nodes = surface[near]
    operator = interpolation_matrix(locate(mesh, held.points), len(u))
    data, _ = point_constraints(operator, energy_per_datum(tissue, model_sigma) / held.sigma_mm**2, 0 * held.points)
    matrix = stiffness(mesh, tissue.lame_kpa, tissue.shear_kpa) + data + diags(anchor(mesh, tissue))
    solver = linear_solver(matrix.tocsr(), mesh.points)
    rest = whole.rest[nodes]
    contact = solve_contact(
        Compliance(solver, unknowns_of(nodes).reshape(-1, 3), u.size),
        ChestWall(wall, rest, np.zeros(len(nodes), bool), np.eye(3)[2], np.minimum(wall.evaluate(rest)[0], 0)),
        still[nodes],
        0.0,
        tolerance_mm=TOLERANCE_MM,
        facing=whole.among(nodes),
    )
    force = np.zeros_like(u)
    force[nodes] = contact.nodal_force
    moved = solver.solve(force.ravel()).reshape(-1, 3)
    return Separation(moved, before, whole.gaps(moved).overlap_mm3, nodes, contact)
