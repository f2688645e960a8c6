"""Batched active set: contact of one lung under many loads at once, so that one pass over the compliance serves all.

A benchmark's tool: a run solves one load after the other, each from the one before, and has no use for it.
Ref: Hintermueller, Ito & Kunisch 2003 (the active set as a semismooth Newton method); Gill et al. 1987 (bordering a
factor that is cached).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from poro.arrays import Array
from poro.contact import ChestWall, Compliance, ContactState, ContactStatus, solve_contact
from poro.contact.active_set import GAP_TOLERANCE_MM, MAX_MOVE_MM, MIX_MM, QUICK_STEPS, Guess
from poro.contact.geometric_stiffness import Directions, GeometricStiffness, geometric_stiffness
from poro.contact.kkt import KktFactor, kkt_factor
from poro.linalg import Anderson

KEEP_MM = 1.0  # last move up to which a factor may be cached
KEEP_FLIPS = 30  # and nodes that may have come or gone since it was made
KEEP_GAIN = 0.5  # and share of the move before that the last one must not exceed


@dataclass(frozen=True)
class CachedKktFactor:
    """Factor of a linearized contact at one active set, used while little changes.

    pool: (k,) its nodes; normal: (k, 3); stiffness, factor: of that linearization.
    """

    pool: Array
    normal: Array
    stiffness: GeometricStiffness
    factor: KktFactor

    def flips(self, active: Array) -> int:
        """Nodes in which the active set (nc,) bool differs from the factor's own."""
        return int(active.sum() + len(self.pool) - 2 * active[self.pool].sum())

    def change(
        self, compliance: Compliance, active: Array, normal: Array, force: Array, left: tuple[Array, Array]
    ) -> tuple[Array, Array]:
        """Change of the normal forces (nc,) and the geometric stiffness's (r,) that close the gaps and motions `left`
        over, (nc,) and (r,), at an active set (nc,) bool of nodes of normals (nc, 3) under forces (nc,).

        Nodes that have left the factor's set are held at no force, those that came are bordered to it.
        """
        gap, motion = left
        count = len(self.pool)
        inside = np.zeros(len(active), bool)
        inside[self.pool] = True
        gone, come = np.flatnonzero(inside & ~active), np.flatnonzero(active & ~inside)
        right = -np.concatenate([gap[self.pool], motion])
        border = np.zeros((len(right), len(come) + len(gone)))
        if len(come):
            toward = Directions(come, normal[come])
            border[:count, : len(come)] = -across(compliance, Directions(self.pool, self.normal), toward)
            border[count:, : len(come)] = -self.stiffness.coupling(come, normal[come]).T
        border[np.searchsorted(self.pool, gone), len(come) + np.arange(len(gone))] = 1
        solved = self.factor.solve(np.column_stack([right, border]))
        x, by_border = solved[:, 0], solved[:, 1:]
        change = np.zeros(len(active))
        if border.shape[1]:
            small = border.T @ by_border
            small[: len(come), : len(come)] -= compliance.between(come, normal[come])
            wanted = np.concatenate([gap[come], -force[gone]]) - border.T @ x
            extra = np.linalg.solve(small, wanted)
            x = x + by_border @ extra
            change[come] = extra[: len(come)]
        change[self.pool] = x[:count]
        change[gone] = -force[gone]
        return change, x[count:]


@dataclass
class _Run:
    """One load on its way: displacements (nc, 3), normal forces (nc,), active set (nc,), and its last factor."""

    free: Array
    travel_mm: float
    u: Array
    force: Array
    active: Array
    moves: list[float] = field(default_factory=list)
    anderson: Anderson = field(default_factory=Anderson)
    cached: CachedKktFactor | None = None
    converged: bool = False

    def may_keep(self) -> bool:
        """Whether the cached factor still steers towards the solution."""
        if self.cached is None or self.moves[-1] > KEEP_MM or self.cached.flips(self.active) > KEEP_FLIPS:
            return False
        return len(self.moves) < 2 or self.moves[-1] < KEEP_GAIN * self.moves[-2]

    def advance(self, gap: Array, gradient: Array, target: Array, change: Array, tolerance_mm: float) -> None:
        """Take the step to `target` (nc, 3) and exchange the nodes on the wrong side."""
        step = target - self.u
        self.moves.append(float(np.linalg.norm(step, axis=1).max(initial=0)))
        force = np.where(self.active, self.force + change, 0)
        ahead = gap + np.einsum("nd,nd->n", gradient, step)
        wrong = (self.active & (force < 0)) | (~self.active & (ahead < -GAP_TOLERANCE_MM))
        self.converged = self.moves[-1] < tolerance_mm and not wrong.any()
        force = np.where(self.active & ~wrong, force, 0)
        if self.converged or (self.moves[-1] < MIX_MM and not wrong.any()):
            self.u, self.force = (target, force) if self.converged else self.anderson.mix(step, target, force)
            return
        self.anderson.restart()
        self.u = self.u + min(1.0, MAX_MOVE_MM / max(self.moves[-1], 1e-30)) * step
        self.active, self.force = self.active ^ wrong, force


def solve_contact_batch(
    compliance: Compliance,
    wall: ChestWall,
    free: Array,
    travel_mm: Sequence[float],
    starts: Sequence[Guess | ContactState],
    tolerance_mm: float = 1e-3,
) -> list[ContactState]:
    """What `solve_contact` finds, for displacements (b, nc, 3) without wall, all advanced together.

    Every step solves each load's linearized contact with its last factor where little has changed since, the residual
    always being exact. What has not converged after `QUICK_STEPS` goes on by itself, where cycling is detected.
    """
    runs = [
        _Run(u0, travel, start.u, start.force, start.active)
        for u0, travel, start in zip(free, travel_mm, starts, strict=True)
    ]
    for _ in range(QUICK_STEPS):
        live = [run for run in runs if not run.converged]
        if not live:
            break
        _step(compliance, wall, live, tolerance_mm)
    return [_ended(compliance, wall, run, tolerance_mm) for run in runs]


def _step(compliance: Compliance, wall: ChestWall, runs: list[_Run], tolerance_mm: float) -> None:
    gaps = [wall.gap(run.u, run.travel_mm) for run in runs]
    free = np.stack([run.free for run in runs])
    pushed = free + apply_many(
        compliance, np.stack([gap[1] * run.force[:, None] for run, gap in zip(runs, gaps, strict=True)])
    )
    changes, added = [], np.empty_like(free)
    for k, (run, (gap, gradient, hessian)) in enumerate(zip(runs, gaps, strict=True)):
        cached = run.cached if run.cached and run.may_keep() else _factored(compliance, wall, run, gradient, hessian)
        run.cached = cached
        drift = pushed[k] - run.u
        left = gap + np.einsum("nd,nd->n", gradient, drift), cached.stiffness.project(drift)
        change, turning = cached.change(compliance, run.active, gradient, run.force, left)
        changes.append(change)
        added[k] = gradient * change[:, None] + cached.stiffness.nodal_forces(turning)
    targets = pushed + apply_many(compliance, added)
    for run, (gap, gradient, _), target, change in zip(runs, gaps, targets, changes, strict=True):
        run.advance(gap, gradient, target, change, tolerance_mm)


def _factored(compliance: Compliance, wall: ChestWall, run: _Run, gradient: Array, hessian: Array) -> CachedKktFactor:
    stiffness = geometric_stiffness(compliance, wall.rest, run.force, hessian)
    pool = np.flatnonzero(run.active)
    normal = gradient[pool]
    matrix, coupling = compliance.between(pool, normal), stiffness.coupling(pool, normal)
    factor = kkt_factor(matrix, coupling, stiffness.compliance, compliance.matrix.dtype)
    return CachedKktFactor(pool, normal, stiffness, factor)


def _ended(compliance: Compliance, wall: ChestWall, run: _Run, tolerance_mm: float) -> ContactState:
    if not run.converged:
        last = Guess(run.u, run.force, run.active)
        return solve_contact(compliance, wall, run.free, run.travel_mm, last, tolerance_mm)
    gap, gradient, hessian = wall.gap(run.u, run.travel_mm)
    steps, moves = len(run.moves), tuple(run.moves)
    found = (run.u, run.force, gap, gradient, hessian, run.active)
    return ContactState(*found, steps=steps, pivots=steps, moves=moves, status=ContactStatus.CONVERGED)


def apply_many(compliance: Compliance, force: Array) -> Array:
    """`Compliance.apply` for many forces (b, nc, 3) at once, a product of matrices, in the matrix's own precision."""
    matrix = compliance.matrix
    flat = force.reshape(len(force), -1).astype(matrix.dtype, copy=False) @ matrix
    return flat.astype(float, copy=False).reshape(force.shape)


def across(compliance: Compliance, moved: Directions, pushed: Directions) -> Array:
    """Motion (k, m) of contact nodes (k,) along their directions under unit forces at others (m,) along theirs."""
    return _across(compliance.matrix, moved, pushed)


@njit(cache=True)
def _across(matrix: Array, moved: Directions, pushed: Directions) -> Array:
    nodes, along = moved
    others, toward = pushed
    result = np.empty((len(nodes), len(others)))
    for j in range(len(others)):
        n, x, y, z = 3 * others[j], toward[j, 0], toward[j, 1], toward[j, 2]
        first, second, third = matrix[n], matrix[n + 1], matrix[n + 2]
        for i in range(len(nodes)):
            total = 0.0
            for axis in range(3):
                c = 3 * nodes[i] + axis
                total += along[i, axis] * (x * first[c] + y * second[c] + z * third[c])
            result[i, j] = total
    return result
