"""Contact of one lung under many loads at once: one pass over the compliance serves all of them.

Ref: Hintermueller, Ito & Kunisch 2003 (the active set as a semismooth Newton method), with factors that are kept while
little changes; Wendland 2005 (radial basis functions).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from poro.contact.active_set import (
    GAP_TOLERANCE_MM,
    MAX_MOVE_MM,
    MIX_MM,
    QUICK_STEPS,
    ContactState,
    ContactStatus,
    Guess,
    Obstacle,
    settle,
)
from poro.contact.compliance import Compliance
from poro.contact.geometric_stiffness import group_springs
from poro.contact.kkt import KeptWall, saddle
from poro.linalg.anderson import Anderson
from poro.mesh.tetmesh import Array

KEEP_MM = 1.0  # last move up to which a factor may be kept
KEEP_FLIPS = 30  # and nodes that may have come or gone since it was made
KEEP_GAIN = 0.5  # and share of the move before that the last one must not exceed
FORCE_PER_GAP = 3.0  # kPa mm: a node's pull on the wall that weighs as much as 1 mm off it


@dataclass
class _Run:
    """One load on its way: displacements (nc, 3), normal forces (nc,), active set (nc,), and the wall it last met."""

    free: Array
    travel_mm: float
    u: Array
    force: Array
    active: Array
    moves: list[float] = field(default_factory=list)
    anderson: Anderson = field(default_factory=Anderson)
    kept: KeptWall | None = None
    settled: bool = False

    def may_keep(self) -> bool:
        """Whether the wall met before still steers towards the solution."""
        if self.kept is None or self.moves[-1] > KEEP_MM or self.kept.flips(self.active) > KEEP_FLIPS:
            return False
        return len(self.moves) < 2 or self.moves[-1] < KEEP_GAIN * self.moves[-2]

    def advance(self, gap: Array, gradient: Array, target: Array, change: Array, tolerance_mm: float) -> None:
        """Take the step to `target` (nc, 3) and exchange the nodes on the wrong side."""
        step = target - self.u
        self.moves.append(float(np.linalg.norm(step, axis=1).max(initial=0)))
        force = np.where(self.active, self.force + change, 0)
        ahead = gap + np.einsum("nd,nd->n", gradient, step)
        wrong = (self.active & (force < 0)) | (~self.active & (ahead < -GAP_TOLERANCE_MM))
        self.settled = self.moves[-1] < tolerance_mm and not wrong.any()
        force = np.where(self.active & ~wrong, force, 0)
        if self.settled or (self.moves[-1] < MIX_MM and not wrong.any()):
            self.u, self.force = (target, force) if self.settled else self.anderson.mix(step, target, force)
            return
        self.anderson.forget()
        self.u = self.u + min(1.0, MAX_MOVE_MM / max(self.moves[-1], 1e-30)) * step
        self.active, self.force = self.active ^ wrong, force


def settle_many(
    compliance: Compliance,
    obstacle: Obstacle,
    free: Array,
    travel_mm: Sequence[float],
    starts: Sequence[Guess | ContactState],
    tolerance_mm: float = 1e-3,
) -> list[ContactState]:
    """What `settle` finds, for displacements (b, nc, 3) without wall, all advanced together.

    Every step solves each load's linearized wall with its last factor where little has changed since, the residual
    always being exact. What has not come to rest after `QUICK_STEPS` goes on by itself, where cycling is detected.
    """
    runs = [
        _Run(u0, travel, start.u, start.force, start.active)
        for u0, travel, start in zip(free, travel_mm, starts, strict=True)
    ]
    for _ in range(QUICK_STEPS):
        live = [run for run in runs if not run.settled]
        if not live:
            break
        _step(compliance, obstacle, live, tolerance_mm)
    return [_ended(compliance, obstacle, run, tolerance_mm) for run in runs]


def _step(compliance: Compliance, obstacle: Obstacle, runs: list[_Run], tolerance_mm: float) -> None:
    walls = [obstacle.gap(run.u, run.travel_mm) for run in runs]
    free = np.stack([run.free for run in runs])
    pushed = free + compliance.apply_many(
        np.stack([wall[1] * run.force[:, None] for run, wall in zip(runs, walls, strict=True)])
    )
    changes, added = [], np.empty_like(free)
    for k, (run, (gap, gradient, hessian)) in enumerate(zip(runs, walls, strict=True)):
        kept = run.kept if run.kept and run.may_keep() else _met(compliance, obstacle, run, gradient, hessian)
        run.kept = kept
        drift = pushed[k] - run.u
        left = gap + np.einsum("nd,nd->n", gradient, drift), kept.springs.stretch(drift)
        change, pull = kept.change(compliance, run.active, gradient, run.force, left)
        changes.append(change)
        added[k] = gradient * change[:, None] + kept.springs.spread(pull)
    targets = pushed + compliance.apply_many(added)
    for run, (gap, gradient, _), target, change in zip(runs, walls, targets, changes, strict=True):
        run.advance(gap, gradient, target, change, tolerance_mm)


def _met(compliance: Compliance, obstacle: Obstacle, run: _Run, gradient: Array, hessian: Array) -> KeptWall:
    springs = group_springs(compliance, obstacle.rest, run.force, hessian)
    pool = np.flatnonzero(run.active)
    normal = gradient[pool]
    matrix, coupling = compliance.between(pool, normal), springs.along_normals(pool, normal)
    return KeptWall(pool, normal, springs, saddle(matrix, coupling, springs.matrix, compliance.matrix.dtype))


def _ended(compliance: Compliance, obstacle: Obstacle, run: _Run, tolerance_mm: float) -> ContactState:
    if not run.settled:
        last = Guess(run.u, run.force, run.active)
        return settle(compliance, obstacle, run.free, run.travel_mm, last, tolerance_mm)
    gap, gradient, hessian = obstacle.gap(run.u, run.travel_mm)
    steps, moves = len(run.moves), tuple(run.moves)
    found = (run.u, run.force, gap, gradient, hessian, run.active)
    return ContactState(*found, steps=steps, pivots=steps, moves=moves, status=ContactStatus.SETTLED)


def interpolated(loads: Array, states: Sequence[ContactState], wanted: Array) -> list[Guess]:
    """Guesses at loads `wanted` (b, d) between those of states, (s, d), by cubic radial functions with a linear trend.

    Force where there is contact and gap where there is none make one field whose sign is the active set.
    """
    trend, at = (np.column_stack([np.ones(len(x)), x]) for x in (loads, wanted))
    own, other = (np.linalg.norm(x[:, None] - loads, axis=2) ** 3 for x in (loads, wanted))
    rows = np.block([[own, trend], [trend.T, np.zeros(2 * trend.shape[1:])]])
    weights = np.linalg.lstsq(rows, np.concatenate([other, at], axis=1).T, rcond=None)[0][: len(loads)].T
    u = np.einsum("bs,snd->bnd", weights, np.stack([state.u for state in states]))
    signed = np.stack([np.where(state.active, state.force / FORCE_PER_GAP, -state.gap) for state in states])
    force = FORCE_PER_GAP * np.maximum(weights @ signed, 0)
    return [Guess(u[k], force[k], force[k] > 0) for k in range(len(wanted))]
