"""Frictionless Signorini contact with the chest wall by a primal-dual active set on the compliance of contact nodes.

Ref: Alvarez 2021, eqs. 12-14; Hueber & Wohlmuth 2005 (primal-dual active set); Murty 1974 (least-index pivoting);
Hintermueller, Ito & Kunisch 2003 (the active set as a semismooth Newton method).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np

from poro.arrays import Array
from poro.contact.chest_wall import ChestWall
from poro.contact.compliance import Compliance
from poro.contact.facing import Facing, Gaps
from poro.contact.geometric_stiffness import GeometricStiffness, geometric_stiffness
from poro.contact.kkt import kkt_factor
from poro.linalg.anderson import Anderson

GAP_TOLERANCE_MM = 1e-9
QUICK_STEPS = 10  # linearizations in which the active set is exchanged once, as in a semismooth Newton method
MAX_PIVOTS = 80  # of later ones, and of the first, which knows no active set
ALL_PIVOTS = 200  # of all linearizations; lungs that converge take 5 to 30, lost ones would go on for thousands
MAX_STEPS = 30  # linearizations in all
MIX_MM = 5.0  # steps below it, which what the geometric stiffness misses makes alike, are accelerated
MIX_FLIPS = 20  # nodes that may come and go meanwhile: some always do where the lung creeps along the wall
MAX_MOVE_MM = 20.0  # largest step over which a linearized wall is believed


class ContactStatus(Enum):
    """How the contact problem ended."""

    CONVERGED = "the active set and the contact points no longer change"
    PIVOTED = "converged, after single pivots where the active set cycled"
    STOPPED = "contact still changed when the iterations ran out"


@dataclass(frozen=True)
class Guess:
    """Where to start from: u (nc, 3) mm, force (nc + s,) kPa mm2 along the gap's gradient, active (nc + s,) bool."""

    u: Array
    force: Array
    active: Array


@dataclass(frozen=True)
class ContactState:
    """Solution of the contact problem on nc nodes.

    u: (nc, 3) mm; force: (nc + s,) kPa mm2 along the gap's gradient, at the wall and, behind that, at the s weighted
    gaps between pieces, none for one piece; gap: (nc + s,) mm; gradient, hessian: of the wall; between: gaps of the
    pieces; active: (nc + s,) bool; steps: outer iterations; pivots: active-set iterations in all; moves: last changes
    in mm.
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
    between: Gaps | None = None

    @property
    def nodal_force(self) -> Array:
        """Forces (nc, 3) kPa mm2 of the wall and of the pieces on each other."""
        count = len(self.u)
        total = self.gradient * self.force[:count, None]
        if self.between is not None:
            total = total + (self.between.matrix.T @ self.force[count:]).reshape(-1, 3)
        return np.asarray(total)


def solve_contact(
    compliance: Compliance,
    wall: ChestWall,
    free: Array,
    travel_mm: float,
    start: Guess | ContactState | None = None,
    tolerance_mm: float = 1e-3,
    facing: Facing | None = None,
    most_pivots: int = ALL_PIVOTS,
) -> ContactState:
    """Contact forces that keep every node in front of the wall, for the displacements `free` (nc, 3) without any wall.

    The gap is linearized where the nodes are and one exchange of the active set made, until no node moves by more than
    `tolerance_mm` and the set stays; where that takes long, every linear complementarity problem is solved to its end.
    facing: two surfaces among the contact nodes that may not pass through each other either. most_pivots: after which
    it is given up, `STOPPED`.
    """
    u = start.u if start else np.zeros_like(free)
    rows = len(free) + (len(facing.nodes) if facing else 0)
    active = start.active if start else np.zeros(rows, bool)
    force = start.force if start else np.zeros(rows)
    moves: list[float] = []
    pivots, pivoted, status = 0, False, ContactStatus.STOPPED
    anderson = Anderson()
    while len(moves) < MAX_STEPS and pivots < most_pivots:
        gap, gradient, hessian = wall.gap(u, travel_mm)
        stiffness = geometric_stiffness(compliance, wall.rest, force[: len(free)], hessian)
        between = facing.gaps(u) if facing else None
        linear = LinearizedContact(compliance, gap, gradient, u, free, stiffness, between)
        active = linear.within(active)
        quick = len(moves) < QUICK_STEPS and (start is not None or len(moves) > 0)
        before = active
        force, active, target, used, status = linear_complementarity(
            linear, active, 1 if quick else min(MAX_PIVOTS, most_pivots - pivots)
        )
        pivots += used
        pivoted = pivoted or status is ContactStatus.PIVOTED
        moves.append(float(np.linalg.norm(target - u, axis=1).max(initial=0)))
        if moves[-1] < tolerance_mm and status is not ContactStatus.STOPPED:
            u = target
            break
        if moves[-1] > MIX_MM or (active != before).sum() > MIX_FLIPS:
            anderson.restart()
            u = u + min(1.0, MAX_MOVE_MM / max(moves[-1], 1e-30)) * (target - u)
        else:
            u, force = anderson.mix(target - u, target, force)
            force = np.where(active, np.maximum(force, 0), 0)
    gap, gradient, hessian = wall.gap(u, travel_mm)
    between = facing.gaps(u) if facing else None
    if between is not None:
        gap = np.concatenate([gap, between.gap])
    if moves[-1] >= tolerance_mm or status is ContactStatus.STOPPED:
        status = ContactStatus.STOPPED
    elif pivoted and status is not ContactStatus.STOPPED:
        status = ContactStatus.PIVOTED
    return ContactState(u, force, gap, gradient, hessian, active, len(moves), pivots, tuple(moves), status, between)


@dataclass(frozen=True)
class LinearizedContact:
    """Contact about displacements u (nc, 3): gap (nc,), gradient (nc, 3), geometric stiffness; free: (nc, 3) without
    wall; between: s weighted gaps between pieces, whose numbers follow those of the nodes.
    """

    compliance: Compliance
    gap: Array
    gradient: Array
    u: Array
    free: Array
    stiffness: GeometricStiffness
    between: Gaps | None = None

    @cached_property
    def slack(self) -> Array:
        """Motion (r,) along the terms of the geometric stiffness when no contact force acts."""
        return self.stiffness.project(self.free - self.u)

    def within(self, active: Array) -> Array:
        """An active set (nc + s,) without gaps of nodes that face nothing any more."""
        return active if self.between is None else active & np.concatenate([self.gap < np.inf, self.between.meets])

    def gaps_at(self, u: Array) -> Array:
        """Linearized gaps (nc + s,) mm at displacements u (nc, 3)."""
        gap = self.gap + np.einsum("nd,nd->n", self.gradient, u - self.u)
        if self.between is None:
            return gap
        return np.concatenate([gap, self.between.gap + self.between.matrix @ (u - self.u).ravel()])

    def reduced(self, pool: Array) -> tuple[Array, Array, Array]:
        """Compliance (k, k) and gap (k,) of contacts `pool` along their gradients, and their coupling (k, r)."""
        at_wall, offset = pool[pool < len(self.gap)], self.gaps_at(self.free)[pool]
        n = self.gradient[at_wall]
        matrix, coupling = self.compliance.between(at_wall, n), self.stiffness.coupling(at_wall, n)
        rows = pool[len(at_wall) :] - len(self.gap)
        if self.between is None or not len(rows):
            return matrix, offset, coupling
        gradients, moved = self.between.matrix[rows], self.compliance.matrix
        response = np.asarray(gradients.astype(moved.dtype) @ moved, dtype=float)
        crossed = np.einsum("knd,nd->kn", response.reshape(len(rows), -1, 3)[:, at_wall], n)
        among = np.asarray(gradients @ response.T)
        return (
            np.block([[matrix, crossed.T], [crossed, (among + among.T) / 2]]),
            offset,
            np.concatenate([coupling, self.stiffness.coupling_of(gradients)]),
        )

    def balance(self, matrix: Array, offset: Array, coupling: Array) -> tuple[Array, Array]:
        """Normal forces (k,) that close the gaps of all contacts of a pool, and the geometric stiffness's (r,).

        Factored in the compliance's own precision and, where that is single, refined once.
        """
        own, count = self.compliance.matrix.dtype, len(offset)
        factor = kkt_factor(matrix, coupling, self.stiffness.compliance, own)
        left = np.concatenate([offset, self.slack])
        forces = -factor.solve(left[:, None])[:, 0]
        if own == np.float32:
            normal, turning = forces[:count], forces[count:]
            left[:count] += matrix @ normal + coupling @ turning
            left[count:] += coupling.T @ normal + self.stiffness.compliance @ turning
            forces = forces - factor.solve(left[:, None])[:, 0]
        return forces[:count], forces[count:]

    def displacement(self, pool: Array, force: Array, turning: Array) -> Array:
        """Displacements (nc, 3) under normal forces (k,) at contacts `pool` and the geometric stiffness's (r,)."""
        total, count = np.zeros_like(self.u), int((pool < len(self.gap)).sum())
        total[pool[:count]] = self.gradient[pool[:count]] * force[:count, None]
        if self.between is not None:
            rows = pool[count:] - len(self.gap)
            total += (self.between.matrix[rows].T @ force[count:]).reshape(-1, 3)
        return self.free + self.compliance.apply(total) + self.stiffness.displacements(turning)


def linear_complementarity(
    contact: LinearizedContact, active: Array, max_pivots: int = MAX_PIVOTS
) -> tuple[Array, Array, Array, int, ContactStatus]:
    """Forces (nc + s,) >= 0 with linearized gap >= 0 and gap . force = 0, from a guessed active set (nc + s,) bool.

    Returns forces, active set, displacements (nc, 3), pivots and status. When a set comes up twice, one node at a time
    is exchanged from there on.
    """
    seen: set[bytes] = set()
    single = False
    pool = np.flatnonzero(active)
    matrix, offset, coupling = contact.reduced(pool)
    for pivot in range(1, max_pivots + 1):
        rows = np.flatnonzero(active)
        if not np.isin(rows, pool).all():
            pool = np.union1d(pool, rows)
            matrix, offset, coupling = contact.reduced(pool)
        within = np.searchsorted(pool, rows)
        normal = np.zeros(len(pool))
        among = matrix if len(rows) == len(pool) else matrix[np.ix_(within, within)]
        normal[within], turning = contact.balance(among, offset[within], coupling[within])
        u = contact.displacement(pool, normal, turning)
        force = np.zeros(len(active))
        force[pool] = normal
        gap = contact.gaps_at(u)
        wrong = (active & (force < 0)) | (~active & (gap < -GAP_TOLERANCE_MM))
        if not wrong.any():
            return force, active, u, pivot, ContactStatus.PIVOTED if single else ContactStatus.CONVERGED
        key = np.packbits(active).tobytes()
        single = single or key in seen
        seen.add(key)
        if single:
            # Exchanging only the last violating node cannot cycle while the compliance is positive definite.
            wrong = np.arange(len(wrong)) == np.flatnonzero(wrong)[-1]
        active = active ^ wrong
    return force, active, u, max_pivots, ContactStatus.STOPPED
