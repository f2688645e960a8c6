"""The deflated lung at one parameter value, and its derivative. Ref: Alvarez 2021, sec. 7.2."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from poro.arrays import Array
from poro.collapse.model import PoroSystem, Theta, without_wall
from poro.contact.active_set import ContactState, ContactStatus, solve_contact
from poro.contact.sensitivity import contact_sensitivity
from poro.mesh.tetmesh import signed_volumes

NEARBY_PIVOTS = 40
"""Of the contact from a solution nearby, which takes 5 to 30."""


class PoroStatus(Enum):
    """How a forward solution ended."""

    SOLVED = "solved"
    INVERTED = "solved, but some elements are inverted: linear strain is out of its range"
    NOT_CONVERGED = "contact did not converge"


@dataclass(frozen=True)
class PoroState:
    """One deflated lung.

    u: (n, 3) mm; p: (n,) kPa; contact_pressure: (n,) kPa; det_f: (m,); gap: (n,) mm, infinite off the contact nodes;
    active: (n,) bool; iterations: outer contact steps; conflicts: contact nodes that the diaphragm has pushed behind
    the chest wall.
    """

    theta: Theta
    u: Array
    p: Array
    contact_pressure: Array
    det_f: Array
    gap: Array
    active: Array
    iterations: int
    conflicts: int
    status: PoroStatus
    contact: ContactState

    @property
    def inverted_share(self) -> float:
        """Share of elements with det F <= 0."""
        return float((self.det_f <= 0).mean())


def solve(system: PoroSystem, theta: Theta, start: PoroState | None = None, tolerance_mm: float = 1e-3) -> PoroState:
    """Deflated lung at one parameter value; `start`, any earlier state of this system, only saves iterations.

    tolerance_mm: largest last motion of a contact node.
    """
    p, free = without_wall(system, theta)
    contact = contact_at(system, theta, free, start.contact if start else None, tolerance_mm)
    return _with_wall(system, theta, p, free, contact)


def solve_nearby(system: PoroSystem, theta: Theta, start: PoroState) -> PoroState:
    """The same near a solution that is known, without the patience for what lies far from it: `NOT_CONVERGED` where the
    contact does not settle at once.
    """
    p, free = without_wall(system, theta)
    there = free[system.contact_nodes]
    contact = solve_contact(
        system.compliance, system.wall, there, theta.d_diaph_mm, start.contact, most_pivots=NEARBY_PIVOTS
    )
    return _with_wall(system, theta, p, free, contact)


def _with_wall(system: PoroSystem, theta: Theta, p: Array, free: Array, contact: ContactState) -> PoroState:
    return state_of(system, theta, p, free + system.solid.solve(wall_forces(system, contact)), contact)


def contact_at(
    system: PoroSystem, theta: Theta, free: Array, start: ContactState | None, tolerance_mm: float
) -> ContactState:
    """Contact of the lung whose displacements without wall are `free` (n, 3); loaded in steps where that is needed."""
    body, there = (system.compliance, system.wall), free[system.contact_nodes]
    contact = solve_contact(*body, there, theta.d_diaph_mm, start, tolerance_mm)
    if contact.status is not ContactStatus.STOPPED:
        return contact
    # Lungs under a heavy weight or a large pressure drop slide too far for one linearization: load them in steps.
    grown = None
    for share in np.linspace(0.2, 1, 5):
        grown = solve_contact(*body, share * there, share * theta.d_diaph_mm, grown, tolerance_mm)
    return grown or contact


def wall_forces(system: PoroSystem, contact: ContactState) -> Array:
    """Nodal forces (n, 3) of the wall."""
    force = np.zeros_like(system.mesh.points)
    force[system.contact_nodes] = contact.gradient * contact.force[:, None]
    return force


def state_of(system: PoroSystem, theta: Theta, p: Array, u: Array, contact: ContactState) -> PoroState:
    """The lung of displacements u (n, 3) and pressure p (n,) with its contact, as a state."""
    nodes, boundary = system.contact_nodes, system.mesh.boundary
    det_f = signed_volumes(system.mesh.points + u, system.mesh.tets) / system.mesh.volumes
    gap = np.full(len(u), np.inf)
    gap[nodes] = contact.gap
    area = np.zeros(len(u))
    area[boundary.nodes] = boundary.node_areas
    pressure = np.zeros(len(u))
    pressure[nodes] = contact.force * np.linalg.norm(contact.gradient, axis=1) / area[nodes]
    active = np.zeros(len(u), bool)
    active[nodes] = contact.active
    behind = system.wall.level.evaluate(system.wall.rest + u[nodes])[0] - system.wall.offset
    conflicts = int(((behind < -0.5) & system.wall.moving).sum())
    status = PoroStatus.INVERTED if (det_f <= 0).any() else PoroStatus.SOLVED
    if contact.status is ContactStatus.STOPPED:
        status = PoroStatus.NOT_CONVERGED
    return PoroState(theta, u, p, pressure, det_f, gap, active, contact.steps, conflicts, status, contact)


def sensitivity(system: PoroSystem, state: PoroState) -> Array:
    """Derivatives of u by the entries of Theta.vector(), (n, 3, 3 + k), at the state's active set."""
    n = len(system.mesh.points)
    by_log_kappa = system.pressure_basis.solve(state.theta.kappa_b).u_change * np.log(10)
    by_phi = system.weight_response * (system.tissue.density_fluid - system.tissue.density_solid)
    parts = [by_log_kappa, by_phi, np.zeros((n, 3))]
    free = np.concatenate([np.stack(parts, axis=2), system.mode_responses], axis=2)
    travel = np.zeros(free.shape[2])
    travel[2] = 1
    nodes = system.contact_nodes
    force = np.zeros_like(free)
    force[nodes] = contact_sensitivity(system.compliance, system.wall, state.contact, free[nodes], travel)
    return free + system.solid.solve(force)
