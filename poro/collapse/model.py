"""The lung that is to collapse: everything about it that no parameter changes, and what it would do without its wall.

Pressure, weight, hilum and load modes act on it. Ref: Alvarez 2021, sec. 7.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix

from poro.arrays import Array
from poro.collapse.modes import LoadMode
from poro.contact.chest_wall import ChestWall
from poro.contact.compliance import Compliance
from poro.contact.levelset import LevelSet, level_set
from poro.fem.flow import Flow
from poro.fem.forms import body_load, gradient_load
from poro.fem.pressure_basis import PressureBasis
from poro.fem.solid import Solid, solid, unknowns_of
from poro.fem.tissue import GRAVITY_KPA_PER_MM, Tissue
from poro.mesh.patches import patches, principal_axis
from poro.mesh.tetmesh import TetMesh

KAPPA_B_BOUNDS = (1e-14, 1e-4)
PHI_BOUNDS = (0.0, 0.93)
DIAPHRAGM_BOUNDS_MM = (0.0, 40.0)


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


@dataclass(frozen=True)
class PoroSystem:
    """Everything about one lung that no parameter changes: factor, compliance, wall and load responses.

    pressure_basis: pressure and what it does at any kappa_b; it and the compliance serve every copy with another
    motion of the hilum or other modes.
    """

    mesh: TetMesh
    tissue: Tissue
    gravity: Array
    hilum: Array
    hilum_displacement: Array
    solid: Solid
    flow: Flow
    wall: ChestWall
    contact_nodes: Array
    compliance: Compliance
    pressure_basis: PressureBasis
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

    @property
    def pressure_load(self) -> csr_matrix:
        """Sparse (3n, n): nodal forces per kPa of pressure."""
        return self.pressure_basis.load


def assemble(
    mesh: TetMesh,
    tissue: Tissue,
    gravity: Array,
    hilum: Array,
    hilum_displacement: Array,
    modes: tuple[LoadMode, ...] = (),
    wall_level: LevelSet | None = None,
) -> PoroSystem:
    """Set a lung up once: factorize, make the chest wall from its own surface, find the diaphragm.

    gravity: (3,) unit vector RAS; hilum: (k,) nodes whose displacements (k, 3) mm are imposed; wall_level: distance to
    another chest wall than the lung's own surface, which is rounded over one edge. Raises ValueError when gravity is
    not a unit vector or fewer than three nodes hold.
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
    if wall_level is None:
        edge = float(np.sqrt(boundary.areas.mean() * 4 / np.sqrt(3)))
        wall_level = level_set(boundary, 0.7 * edge, edge)
    on_wall = ~np.isin(boundary.nodes, hilum)
    nodes = boundary.nodes[on_wall]
    rest = mesh.points[nodes]
    moving = patches(boundary, mesh.points[hilum]).diaphragm[on_wall]
    offset = np.minimum(wall_level.evaluate(rest)[0], 0)
    wall = ChestWall(wall_level, rest, moving, principal_axis(mesh), offset)
    place = np.full(3 * len(mesh.points), -1)
    place[body.free_unknowns] = np.arange(len(body.free_unknowns))
    compliance = Compliance(body.solver, place[unknowns_of(nodes)].reshape(-1, 3), len(body.free_unknowns))
    flow = Flow(mesh, tissue)
    basis = PressureBasis(flow, body, tissue.biot * gradient_load(mesh))
    at_hilum = hilum, hilum_displacement
    return PoroSystem(mesh, tissue, gravity, *at_hilum, body, flow, wall, nodes, compliance, basis, modes)


def still_lung(mesh: TetMesh, tissue: Tissue, gravity: Array, hilum: Array) -> PoroSystem:
    """The lung of `assemble` whose hilum (k,), in ascending order, does not move, with what contact at any parameter
    needs done and kept.
    """
    system = assemble(mesh, tissue, gravity, hilum, np.zeros((len(hilum), 3)))
    system.compliance.groups(system.wall.rest)
    return system


def without_wall(system: PoroSystem, theta: Theta) -> tuple[Array, Array]:
    """Pressure (n,) kPa, and displacements (n, 3) mm of the lung if nothing were in its way."""
    if len(theta.modes) != len(system.modes):
        raise ValueError(f"theta carries {len(theta.modes)} amplitudes, the system has {len(system.modes)} load modes")
    pressed = system.pressure_basis.solve(theta.kappa_b)
    by_weight = system.weight_response * system.tissue.density(theta.phi)
    return pressed.p, pressed.u + by_weight + system.hilum_response + system.mode_responses @ np.array(theta.modes)
