"""Deflated lungs at many parameter values of one lung, solved in batches: what the benchmark's sweep measures.

Ref: Wendland 2005 (radial basis functions).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from poro.arrays import Array
from poro.collapse import PoroState, PoroSystem, Theta
from poro.collapse.model import without_wall
from poro.collapse.solution import contact_at, state_of, wall_forces
from poro.contact import ContactState, ContactStatus
from poro.contact.active_set import Guess
from vatsloc.study.bench.batched_contact import solve_contact_batch

BATCH_GROWTH = 5  # parameter values solved together for each one that is solved already
LARGEST_BATCH = 48  # more would only cost memory: 3 MB each at 1700 contact nodes
FORCE_PER_GAP = 3.0  # kPa mm: a node's force on the wall that weighs as much as 1 mm off it


def solve_many(system: PoroSystem, thetas: Sequence[Theta], tolerance_mm: float = 1e-3) -> list[PoroState]:
    """Deflated lungs at many parameter values, equal to those of `solve` within the tolerance.

    Solved in batches, each of which starts between the loads of those before.
    """
    if not thetas:
        return []
    system.pressure_basis.enrich(theta.kappa_b for theta in thetas)
    free = [without_wall(system, theta) for theta in thetas]
    loads = _load_amounts(system, thetas, [p for p, _ in free])
    order = _spread_order(loads)
    contacts: dict[int, ContactState] = {}
    k = order[0]
    contacts[k] = contact_at(system, thetas[k], free[k][1], None, tolerance_mm)
    while len(contacts) < len(thetas):
        done = order[: len(contacts)]
        batch = order[len(done) :][: min(BATCH_GROWTH * len(done), LARGEST_BATCH)]
        states = [contacts[k] for k in done]
        starts = interpolated_guesses(loads[done], states, loads[batch])
        unstopped = np.stack([free[k][1][system.contact_nodes] for k in batch])
        travel = [thetas[k].d_diaph_mm for k in batch]
        found = solve_contact_batch(system.compliance, system.wall, unstopped, travel, starts, tolerance_mm)
        for k, contact in zip(batch, found, strict=True):
            stopped = contact.status is ContactStatus.STOPPED
            contacts[k] = contact_at(system, thetas[k], free[k][1], None, tolerance_mm) if stopped else contact
    forces = np.stack([wall_forces(system, contacts[k]) for k in range(len(thetas))], axis=2)
    pushed = system.solid.solve(forces)
    return [
        state_of(system, theta, p, u + pushed[:, :, k], contacts[k])
        for k, (theta, (p, u)) in enumerate(zip(thetas, free, strict=True))
    ]


def interpolated_guesses(loads: Array, states: Sequence[ContactState], wanted: Array) -> list[Guess]:
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


def _load_amounts(system: PoroSystem, thetas: Sequence[Theta], pressures: Sequence[Array]) -> Array:
    """Loads (b, d), each in standard deviations: what the lung without wall answers to nearly linearly."""
    drops = [float(system.tissue.pleural_kpa - p.mean()) for p in pressures]
    loads = np.array([[p, t.phi, t.d_diaph_mm, *t.modes] for p, t in zip(drops, thetas, strict=True)])
    loads = loads - loads.mean(axis=0)
    spread = loads.std(axis=0)
    varied = spread > 1e-9 * np.abs(loads).max(axis=0, initial=1e-30)
    return np.asarray(loads[:, varied] / spread[varied])


def _spread_order(loads: Array) -> list[int]:
    """Order of loads (b, d) from the middle on, each the farthest from those before it."""
    order = [int(np.argmin(np.linalg.norm(loads, axis=1)))]
    away = np.linalg.norm(loads - loads[order[0]], axis=1)
    while len(order) < len(loads):
        away[order] = -1
        order.append(int(np.argmax(away)))
        away = np.minimum(away, np.linalg.norm(loads - loads[order[-1]], axis=1))
    return order
