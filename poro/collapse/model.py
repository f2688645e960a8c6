"""The deflated lung: pressure, weight, hilum and load modes against cage and diaphragm. Ref: Alvarez 2021, sec. 7.2."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix

from poro.collapse.modes import LoadMode
from poro.contact.active_set import ContactState, ContactStatus, Obstacle, contact_sensitivity, settle
from poro.contact.batched_active_set import interpolated, settle_many
from poro.contact.compliance import Compliance
from poro.contact.levelset import LevelSet, level_set
from poro.fem.flow import Flow
from poro.fem.forms import body_load, gradient_load
from poro.fem.pressure_basis import Suction
from poro.fem.solid import Solid, solid, unknowns_of
from poro.fem.tissue import GRAVITY_KPA_PER_MM, Tissue
from poro.mesh.patches import patches, principal_axis
from poro.mesh.tetmesh import Array, TetMesh, signed_volumes

KAPPA_B_BOUNDS = (1e-14, 1e-4)
PHI_BOUNDS = (0.0, 0.93)
DIAPHRAGM_BOUNDS_MM = (0.0, 40.0)
WAVE_GROWTH = 5  # parameter values solved together for each one that is solved already
LARGEST_WAVE = 48  # more would only cost memory: 3 MB each at 1700 contact nodes


@dataclass(frozen=True)
class Theta:
    """Free parameters: kappa_b in 1/(Pa s), porosity phi, diaphragm travel in mm, and one amplitude per load mode."""

    kappa_b: float
    phi: float
    d_diaph_mm: float = 0.0
    modes: tuple[float, ...] = ()

    def vector(self) -> Array:
        """(log10 kappa_b, phi, d_diaph_mm, amplitudes...)."""
        return np.array([np.log10(self.kappa_b), self.phi, self.d_diaph_mm, *self.modes])

    @staticmethod
    def of(vector: Array) -> Theta:
        """Inverse of `vector`."""
        return Theta(float(10 ** vector[0]), float(vector[1]), float(vector[2]), tuple(float(a) for a in vector[3:]))


class PoroStatus(Enum):
    """How a forward solution ended."""

    SOLVED = "solved"
    INVERTED = "solved, but some elements are turned inside out: linear strain is out of its range"
    NOT_SETTLED = "contact did not settle"


@dataclass(frozen=True)
class PoroState:
    """One deflated lung.

    u: (n, 3) mm; p: (n,) kPa; contact_pressure: (n,) kPa; det_f: (m,); gap: (n,) mm, infinite off the contact nodes;
    active: (n,) bool; iterations: outer contact steps; conflicts: contact nodes that the diaphragm has pushed behind
    the cage.
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


@dataclass(frozen=True)
class PoroSystem:
    """Everything about one lung that no parameter changes: factor, compliance, obstacle and load responses."""

    mesh: TetMesh
    tissue: Tissue
    gravity: Array
    hilum: Array
    hilum_displacement: Array
    solid: Solid
    flow: Flow
    obstacle: Obstacle
    contact_nodes: Array
    compliance: Compliance
    modes: tuple[LoadMode, ...] = ()

    @cached_property
    def weight_response(self) -> Array:
        """Displacements (n, 3) per kg/m3, without wall."""
        return self.solid.solve(body_load(self.mesh, self.gravity * GRAVITY_KPA_PER_MM))

    @cached_property
    def hilum_response(self) -> Array:
        """Displacements (n, 3) that the hilum's motion alone would cause."""
        return self.solid.solve(np.zeros_like(self.mesh.points), self.hilum_displacement)

    @cached_property
    def mode_responses(self) -> Array:
        """Displacements (n, 3, k) per unit amplitude of every load mode."""
        n = len(self.mesh.points)
        if not self.modes:
            return np.zeros((n, 3, 0))
        force = np.stack([mode.force for mode in self.modes], axis=2)
        imposed = np.stack([mode.imposed for mode in self.modes], axis=2)[self.hilum]
        return self.solid.solve(force, imposed)

    @cached_property
    def suction(self) -> Suction:
        """Pressure and what it does at any kappa_b."""
        return Suction(self.flow, self.solid, self.pressure_load)

    @cached_property
    def pressure_load(self) -> csr_matrix:
        """Sparse (3n, n): nodal forces per kPa of pressure."""
        return self.tissue.biot * gradient_load(self.mesh)


def assemble(
    mesh: TetMesh,
    tissue: Tissue,
    gravity: Array,
    hilum: Array,
    hilum_displacement: Array,
    modes: tuple[LoadMode, ...] = (),
    wall: LevelSet | None = None,
) -> PoroSystem:
    """Set a lung up once: factorize, build the cage from its own surface, find the diaphragm.

    gravity: (3,) unit vector RAS; hilum: (k,) nodes whose displacements (k, 3) mm are imposed; wall: another cage than
    the lung's own surface, rounded over one edge. Raises ValueError when gravity is not a unit vector or fewer than
    three nodes hold.
    """
    gravity = np.asarray(gravity, float)
    if abs(np.linalg.norm(gravity) - 1) > 1e-3:
        raise ValueError(f"gravity must be a unit vector, got length {np.linalg.norm(gravity):.3f}")
    hilum = np.asarray(hilum)
    if len(np.unique(hilum)) < 3 or hilum_displacement.shape != (len(hilum), 3):
        raise ValueError(f"hilum needs three distinct nodes and displacements (k, 3), got {len(hilum)} nodes")
    order = np.argsort(hilum)
    hilum, hilum_displacement = hilum[order], np.asarray(hilum_displacement, float)[order]
    body = solid(mesh, tissue, hilum)
    boundary = mesh.boundary
    if wall is None:
        edge = float(np.sqrt(boundary.areas.mean() * 4 / np.sqrt(3)))
        wall = level_set(boundary, 0.7 * edge, edge)
    on_wall = ~np.isin(boundary.nodes, hilum)
    nodes = boundary.nodes[on_wall]
    rest = mesh.points[nodes]
    moving = patches(boundary, mesh.points[hilum]).diaphragm[on_wall]
    offset = np.minimum(wall.evaluate(rest)[0], 0)
    obstacle = Obstacle(wall, rest, moving, principal_axis(mesh), offset)
    place = np.full(3 * len(mesh.points), -1)
    place[body.free_unknowns] = np.arange(len(body.free_unknowns))
    compliance = Compliance(body.solver, place[unknowns_of(nodes)].reshape(-1, 3), len(body.free_unknowns))
    flow = Flow(mesh, tissue)
    return PoroSystem(mesh, tissue, gravity, hilum, hilum_displacement, body, flow, obstacle, nodes, compliance, modes)


def solve(system: PoroSystem, theta: Theta, start: PoroState | None = None, tolerance_mm: float = 1e-3) -> PoroState:
    """Deflated lung at one parameter value; `start`, any earlier state of this system, only saves iterations.

    tolerance_mm: largest last motion of a contact node.
    """
    p, free = without_wall(system, theta)
    contact = _settled(system, theta, free, start.contact if start else None, tolerance_mm)
    return _state(system, theta, p, free + system.solid.solve(_pushed(system, contact)), contact)


def solve_many(system: PoroSystem, thetas: Sequence[Theta], tolerance_mm: float = 1e-3) -> list[PoroState]:
    """Deflated lungs at many parameter values, equal to those of `solve` within the tolerance.

    Solved in waves, each of which starts between the loads of those before.
    """
    if not thetas:
        return []
    system.suction.learn(theta.kappa_b for theta in thetas)
    unstopped = [without_wall(system, theta) for theta in thetas]
    places = _load_amounts(system, thetas, [p for p, _ in unstopped])
    order = _spread_order(places)
    contacts: dict[int, ContactState] = {}
    k = order[0]
    contacts[k] = _settled(system, thetas[k], unstopped[k][1], None, tolerance_mm)
    while len(contacts) < len(thetas):
        known = order[: len(contacts)]
        wave = order[len(known) :][: min(WAVE_GROWTH * len(known), LARGEST_WAVE)]
        states = [contacts[k] for k in known]
        starts = interpolated(places[known], states, places[wave])
        free = np.stack([unstopped[k][1][system.contact_nodes] for k in wave])
        travel = [thetas[k].d_diaph_mm for k in wave]
        found = settle_many(system.compliance, system.obstacle, free, travel, starts, tolerance_mm)
        for k, contact in zip(wave, found, strict=True):
            stopped = contact.status is ContactStatus.STOPPED
            contacts[k] = _settled(system, thetas[k], unstopped[k][1], None, tolerance_mm) if stopped else contact
    forces = np.stack([_pushed(system, contacts[k]) for k in range(len(thetas))], axis=2)
    pushed = system.solid.solve(forces)
    return [
        _state(system, theta, p, free + pushed[:, :, k], contacts[k])
        for k, (theta, (p, free)) in enumerate(zip(thetas, unstopped, strict=True))
    ]


def _load_amounts(system: PoroSystem, thetas: Sequence[Theta], pressures: Sequence[Array]) -> Array:
    """Loads (b, d), each in standard deviations: what the lung without wall answers to nearly linearly."""
    drops = [float(system.tissue.pleural_kpa - p.mean()) for p in pressures]
    loads = np.array([[p, t.phi, t.d_diaph_mm, *t.modes] for p, t in zip(drops, thetas, strict=True)])
    loads = loads - loads.mean(axis=0)
    spread = loads.std(axis=0)
    varied = spread > 1e-9 * np.abs(loads).max(axis=0, initial=1e-30)
    return np.asarray(loads[:, varied] / spread[varied])


def _spread_order(places: Array) -> list[int]:
    """Order of places (b, d) from the middle on, each the farthest from those before it."""
    order = [int(np.argmin(np.linalg.norm(places, axis=1)))]
    away = np.linalg.norm(places - places[order[0]], axis=1)
    while len(order) < len(places):
        away[order] = -1
        order.append(int(np.argmax(away)))
        away = np.minimum(away, np.linalg.norm(places - places[order[-1]], axis=1))
    return order


def without_wall(system: PoroSystem, theta: Theta) -> tuple[Array, Array]:
    """Pressure (n,) kPa, and displacements (n, 3) mm of the lung if nothing were in its way."""
    if len(theta.modes) != len(system.modes):
        raise ValueError(f"theta carries {len(theta.modes)} amplitudes, the system has {len(system.modes)} load modes")
    sucked = system.suction.at(theta.kappa_b)
    by_weight = system.weight_response * system.tissue.density(theta.phi)
    return sucked.p, sucked.u + by_weight + system.hilum_response + system.mode_responses @ np.array(theta.modes)


def _settled(
    system: PoroSystem, theta: Theta, free: Array, start: ContactState | None, tolerance_mm: float
) -> ContactState:
    wall, there = (system.compliance, system.obstacle), free[system.contact_nodes]
    contact = settle(*wall, there, theta.d_diaph_mm, start, tolerance_mm)
    if contact.status is not ContactStatus.STOPPED:
        return contact
    # Very heavy or strongly sucked lungs slide too far for one linearization: load them in steps.
    grown = None
    for share in np.linspace(0.2, 1, 5):
        grown = settle(*wall, share * there, share * theta.d_diaph_mm, grown, tolerance_mm)
    return grown or contact


def _pushed(system: PoroSystem, contact: ContactState) -> Array:
    """Nodal forces (n, 3) of the wall."""
    force = np.zeros_like(system.mesh.points)
    force[system.contact_nodes] = contact.gradient * contact.force[:, None]
    return force


def _state(system: PoroSystem, theta: Theta, p: Array, u: Array, contact: ContactState) -> PoroState:
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
    behind = system.obstacle.level.evaluate(system.obstacle.rest + u[nodes])[0] - system.obstacle.offset
    conflicts = int(((behind < -0.5) & system.obstacle.moving).sum())
    status = PoroStatus.INVERTED if (det_f <= 0).any() else PoroStatus.SOLVED
    if contact.status is ContactStatus.STOPPED:
        status = PoroStatus.NOT_SETTLED
    return PoroState(theta, u, p, pressure, det_f, gap, active, contact.steps, conflicts, status, contact)


def sensitivity(system: PoroSystem, state: PoroState) -> Array:
    """Derivatives of u by the entries of Theta.vector(), (n, 3, 3 + k), at the state's active set."""
    n = len(system.mesh.points)
    by_log_kappa = system.suction.at(state.theta.kappa_b).u_change * np.log(10)
    by_phi = system.weight_response * (system.tissue.density_fluid - system.tissue.density_solid)
    parts = [by_log_kappa, by_phi, np.zeros((n, 3))]
    free = np.concatenate([np.stack(parts, axis=2), system.mode_responses], axis=2)
    travel = np.zeros(free.shape[2])
    travel[2] = 1
    nodes = system.contact_nodes
    force = np.zeros_like(free)
    force[nodes] = contact_sensitivity(system.compliance, system.obstacle, state.contact, free[nodes], travel)
    return free + system.solid.solve(force)
