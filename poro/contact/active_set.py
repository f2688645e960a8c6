"""Frictionless Signorini contact with a rigid surface by a primal-dual active set on the compliance of contact nodes.

Ref: Alvarez 2021, eqs. 12-14; Hueber & Wohlmuth 2005 (primal-dual active set); Murty 1974 (least-index pivoting);
Hintermueller, Ito & Kunisch 2003 (the active set as a semismooth Newton method).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np
from scipy.linalg import lu_factor, lu_solve, solve

from poro.contact.compliance import Compliance
from poro.contact.geometric_stiffness import Springs, group_springs
from poro.contact.kkt import saddle
from poro.contact.levelset import LevelSet
from poro.linalg.anderson import Anderson
from poro.mesh.tetmesh import Array

GAP_TOLERANCE_MM = 1e-9
QUICK_STEPS = 10  # linearizations in which the active set is exchanged once, as in a semismooth Newton method
MAX_PIVOTS = 80  # of later ones, and of the first, which knows no active set
ALL_PIVOTS = 200  # of all linearizations; settled lungs take 5 to 30, lost ones would go on for thousands
MIX_MM = 5.0  # below it what the springs miss of the wall's curvature makes one step like the other, and is mixed away
MIX_FLIPS = 20  # nodes that may come and go meanwhile: some always do where the lung creeps along the wall
REFINEMENTS = 8  # of a factor in single precision, before double precision has to do
MAX_MOVE_MM = 20.0  # largest step over which a linearized wall is believed


class ContactStatus(Enum):
    """How the contact problem ended."""

    SETTLED = "the active set and the contact points no longer change"
    PIVOTED = "the active set cycled and was settled by single pivots"
    STOPPED = "contact still changed when the iterations ran out"


@dataclass(frozen=True)
class Obstacle:
    """Rigid wall around the lung, a part of which moves along an axis.

    level: distance to the wall, positive inside; rest: (nc, 3) mm contact nodes at rest; moving: (nc,) bool, nodes that
    face the moving part; axis: (3,) unit vector; offset: (nc,) mm subtracted so that no node starts behind the wall.
    """

    level: LevelSet
    rest: Array
    moving: Array
    axis: Array
    offset: Array

    def gap(self, u: Array, travel_mm: float) -> tuple[Array, Array, Array]:
        """Gap (nc,) mm, its gradient (nc, 3) and Hessian (nc, 3, 3) at displacements u (nc, 3)."""
        value, gradient, hessian = self.level.evaluate(self.rest + u - travel_mm * self.moving[:, None] * self.axis)
        return value - self.offset, gradient, hessian


@dataclass(frozen=True)
class Guess:
    """Where to start from: u (nc, 3) mm, force (nc,) kPa mm2 along the gap's gradient, active (nc,) bool."""

    u: Array
    force: Array
    active: Array


@dataclass(frozen=True)
class ContactState:
    """Solution of the contact problem on nc nodes.

    u: (nc, 3) mm; force: (nc,) kPa mm2 along the gap's gradient; gap, gradient, hessian: of the obstacle there;
    active: (nc,) bool; steps: outer iterations; pivots: active-set iterations in all; moves: last changes in mm.
    """

    u: Array
    force: Array
    gap: Array
    gradient: Array
    hessian: Array
    active: Array
    steps: int
    pivots: int
    moves: tuple[float, ...]
    status: ContactStatus


def settle(
    compliance: Compliance,
    obstacle: Obstacle,
    free: Array,
    travel_mm: float,
    start: Guess | ContactState | None = None,
    tolerance_mm: float = 1e-3,
    max_steps: int = 30,
) -> ContactState:
    """Contact forces that keep every node in front of the wall, for the displacements `free` (nc, 3) without any wall.

    The gap is linearized where the nodes are and one exchange of the active set made, until no node moves by more than
    `tolerance_mm` and the set stays; where that takes long, every linear complementarity problem is solved to its end.
    """
    u = start.u if start else np.zeros_like(free)
    active = start.active if start else np.zeros(len(free), bool)
    force = start.force if start else np.zeros(len(free))
    moves: list[float] = []
    pivots, pivoted, status = 0, False, ContactStatus.STOPPED
    anderson = Anderson()
    while len(moves) < max_steps and pivots < ALL_PIVOTS:
        gap, gradient, hessian = obstacle.gap(u, travel_mm)
        springs = group_springs(compliance, obstacle.rest, force, hessian)
        wall = Linearized(compliance, gap, gradient, u, free, springs)
        quick = len(moves) < QUICK_STEPS and (start is not None or len(moves) > 0)
        before = active
        force, active, target, used, status = complementarity(wall, active, 1 if quick else MAX_PIVOTS)
        pivots += used
        pivoted = pivoted or status is ContactStatus.PIVOTED
        moves.append(float(np.linalg.norm(target - u, axis=1).max(initial=0)))
        if moves[-1] < tolerance_mm and status is not ContactStatus.STOPPED:
            u = target
            break
        if moves[-1] > MIX_MM or (active != before).sum() > MIX_FLIPS:
            anderson.forget()
            u = u + min(1.0, MAX_MOVE_MM / max(moves[-1], 1e-30)) * (target - u)
        else:
            u, force = anderson.mix(target - u, target, force)
            force = np.where(active, np.maximum(force, 0), 0)
    gap, gradient, hessian = obstacle.gap(u, travel_mm)
    if moves[-1] >= tolerance_mm or status is ContactStatus.STOPPED:
        status = ContactStatus.STOPPED
    elif pivoted and status is not ContactStatus.STOPPED:
        status = ContactStatus.PIVOTED
    return ContactState(u, force, gap, gradient, hessian, active, len(moves), pivots, tuple(moves), status)


@dataclass(frozen=True)
class Linearized:
    """Wall seen from displacements u (nc, 3): gap (nc,), gradient (nc, 3), curvature springs; free: (nc, 3) without
    wall.
    """

    compliance: Compliance
    gap: Array
    gradient: Array
    u: Array
    free: Array
    springs: Springs

    @cached_property
    def slack(self) -> Array:
        """Stretch (r,) of the springs when no contact force acts."""
        return self.springs.stretch(self.free - self.u)

    def reduced(self, pool: Array) -> tuple[Array, Array, Array]:
        """Compliance (k, k) and gap (k,) of nodes `pool` along their normals, and how springs move them (k, r)."""
        n = self.gradient[pool]
        offset = self.gap[pool] + np.einsum("nd,nd->n", n, (self.free - self.u)[pool])
        return self.compliance.between(pool, n), offset, self.springs.along_normals(pool, n)

    def balance(self, matrix: Array, offset: Array, coupling: Array) -> tuple[Array, Array]:
        """Normal forces (k,) that close the gaps of all nodes of a pool, and the springs' forces (r,).

        Factored in the compliance's own precision and, where that is single, refined once.
        """
        own, count = self.compliance.matrix.dtype, len(offset)
        factor = saddle(matrix, coupling, self.springs.matrix, own)
        left = np.concatenate([offset, self.slack])
        forces = -factor.solve(left[:, None])[:, 0]
        if own == np.float32:
            push, pull = forces[:count], forces[count:]
            left[:count] += matrix @ push + coupling @ pull
            left[count:] += coupling.T @ push + self.springs.matrix @ pull
            forces = forces - factor.solve(left[:, None])[:, 0]
        return forces[:count], forces[count:]

    def displacement(self, pool: Array, force: Array, pull: Array) -> Array:
        """Displacements (nc, 3) under normal forces (k,) at nodes `pool` and the springs' forces (r,)."""
        total = np.zeros_like(self.u)
        total[pool] = self.gradient[pool] * force[:, None]
        return self.free + self.compliance.apply(total) + self.springs.motion(pull)


def complementarity(
    wall: Linearized, active: Array, max_pivots: int = MAX_PIVOTS
) -> tuple[Array, Array, Array, int, ContactStatus]:
    """Forces (nc,) >= 0 with linearized gap >= 0 and gap . force = 0, from a guessed active set (nc,) bool.

    Returns forces, active set, displacements (nc, 3), pivots and status. When a set comes up twice, one node at a time
    is exchanged from there on.
    """
    seen: set[bytes] = set()
    single = False
    pool = np.flatnonzero(active)
    matrix, offset, coupling = wall.reduced(pool)
    for pivot in range(1, max_pivots + 1):
        rows = np.flatnonzero(active)
        if not np.isin(rows, pool).all():
            pool = np.union1d(pool, rows)
            matrix, offset, coupling = wall.reduced(pool)
        within = np.searchsorted(pool, rows)
        push = np.zeros(len(pool))
        among = matrix if len(rows) == len(pool) else matrix[np.ix_(within, within)]
        push[within], pull = wall.balance(among, offset[within], coupling[within])
        u = wall.displacement(pool, push, pull)
        force = np.zeros(len(active))
        force[pool] = push
        gap = wall.gap + np.einsum("nd,nd->n", wall.gradient, u - wall.u)
        wrong = (active & (force < 0)) | (~active & (gap < -GAP_TOLERANCE_MM))
        if not wrong.any():
            return force, active, u, pivot, ContactStatus.PIVOTED if single else ContactStatus.SETTLED
        key = np.packbits(active).tobytes()
        single = single or key in seen
        seen.add(key)
        if single:
            # Exchanging only the last violating node cannot cycle while the compliance is positive definite.
            wrong = np.arange(len(wrong)) == np.flatnonzero(wrong)[-1]
        active = active ^ wrong
    return force, active, u, max_pivots, ContactStatus.STOPPED


def contact_sensitivity(
    compliance: Compliance, obstacle: Obstacle, state: ContactState, free: Array, travel: Array
) -> Array:
    """Derivatives of the contact forces, (nc, 3, k), at a fixed active set.

    free: (nc, 3, k) derivatives of the displacements without wall; travel: (k,) derivatives of the wall's travel. The
    wall's curvature turns the forces as the nodes slide; normal and turning forces come from one symmetric system.
    """
    active = np.flatnonzero(state.active)
    sliding, along, strength = _node_springs(np.where(state.active, state.force, 0), state.hessian)
    rows = np.concatenate([active, sliding])
    direction = np.concatenate([state.gradient[active], along])
    result = np.zeros_like(free)
    if len(rows) == 0:
        return result
    matrix = compliance.between(rows, direction)
    matrix += np.diag(np.concatenate([np.zeros(len(active)), 1 / strength]))
    drift = -(obstacle.moving[:, None] * obstacle.axis)[:, :, None] * travel
    weight = -_solved(matrix, np.einsum("rd,rdk->rk", direction, (free + drift)[rows]))
    np.add.at(result, rows, direction[:, :, None] * weight[:, None])
    return result


def _solved(matrix: Array, right: Array) -> Array:
    """Solutions (r, k) of a symmetric indefinite matrix (r, r): factored in single precision and refined, which is
    several times as fast; in double where that does not converge.
    """
    scale = 1 / np.sqrt(np.abs(np.diag(matrix)))
    scaled, wanted = matrix * np.outer(scale, scale), right * scale[:, None]
    factor = lu_factor(scaled.astype(np.float32), check_finite=False)
    x = np.zeros_like(wanted)
    for _ in range(REFINEMENTS):
        left = wanted - scaled @ x
        if np.linalg.norm(left) < 1e-9 * np.linalg.norm(wanted):
            return x * scale[:, None]
        x = x + lu_solve(factor, left.astype(np.float32), check_finite=False)
    return np.asarray(solve(matrix, right, assume_a="sym"))


def _node_springs(force: Array, hessian: Array, cut: float = 1e-4) -> tuple[Array, Array, Array]:
    """Nodes (r,), directions (r, 3) and strengths (r,) kPa mm of the wall's curvature under forces (nc,), node by
    node.
    """
    nodes = np.flatnonzero(force)
    values, vectors = np.linalg.eigh(-force[nodes, None, None] * hessian[nodes])
    flat = values.ravel()
    keep = np.abs(flat) > cut * np.abs(flat).max(initial=0)
    return np.repeat(nodes, 3)[keep], vectors.transpose(0, 2, 1).reshape(-1, 3)[keep], flat[keep]
