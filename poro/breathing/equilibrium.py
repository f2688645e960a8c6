"""Equilibrium of a lung at finite strain under pressure, weight, constraints and a cavity that it may not leave.

Newton with line search; where the tangent has no lowest energy its convex part serves. Displacements mm, pressures kPa.
Ref: Bonet & Wood 2008, ch. 9 (Newton, follower pressure); Eom 2010, eq. 1.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from scipy.sparse import bsr_matrix, csr_matrix, diags

from poro.arrays import Array
from poro.contact.levelset import LevelSet
from poro.errors import SolverError
from poro.fem.constitutive import ConstitutiveModel
from poro.fem.forms import deformation_gradient, eigenstress_load, tangent_stiffness
from poro.linalg.dissection import Tree
from poro.linalg.solver import LinearSolver, elimination_tree, linear_solver
from poro.mesh.tetmesh import TetMesh

MAX_STEPS = 30
_HALVINGS = 10
_NEAR = 1e-2
"""Relative residual below which the full tangent is tried before its convex part."""


class Balance(Enum):
    """How a search for balance ended."""

    BALANCED = "forces balance"
    STOPPED = "Newton stopped before the forces balanced"


@dataclass(frozen=True)
class ConstraintTerms:
    """Energy u K u / 2 - f u. matrix: (3n, 3n) kPa mm; force: (n, 3) kPa mm2."""

    matrix: csr_matrix
    force: Array

    def __add__(self, other: ConstraintTerms) -> ConstraintTerms:
        return ConstraintTerms((self.matrix + other.matrix).tocsr(), self.force + other.force)

    @staticmethod
    def none(nodes: int) -> ConstraintTerms:
        """No constraint at all."""
        return ConstraintTerms(csr_matrix((3 * nodes, 3 * nodes)), np.zeros((nodes, 3)))


@dataclass(frozen=True)
class Cavity:
    """Wall that pushes nodes back as k gap^2 / 2 once they are behind it, and draws those that leave it. level: the
    wall's distances (mm, positive within) and their shares of it, two while it moves from one shape to the other;
    stiffness: (k,) kPa mm of nodes (k,); offset: (k,) mm, distance at which nodes touch; pull: stiffness of what draws
    over that of what pushes, 0 for contact alone.
    """

    level: tuple[tuple[float, LevelSet], ...]
    nodes: Array
    stiffness: Array
    offset: Array
    pull: float = 0.0

    def distance(self, points: Array) -> tuple[Array, Array, Array]:
        """Distance (q,) mm within the wall, its slope (q, 3) and its Hessian (q, 3, 3) 1/mm at points (q, 3)."""
        value, slope, bend = np.zeros(len(points)), np.zeros_like(points), np.zeros((len(points), 3, 3))
        for share, level in self.level:
            if share > 0:
                v, g, h = level.evaluate(points)
                value, slope, bend = value + share * v, slope + share * g, bend + share * h
        return value, slope, bend

    def respond(self, points: Array) -> tuple[float, Array, Array]:
        """Energy, nodal forces (n, 3) and the convex part of their stiffness (n, 3, 3) at points (n, 3) mm.

        The wall's curvature counts: without it, a node off a bent wall is sent past its place by every step.
        """
        value, slope, bend = self.distance(points[self.nodes])
        gap = value - self.offset
        stiffness = self.stiffness * np.where(gap < 0, 1.0, self.pull)
        force, block = np.zeros_like(points), np.zeros((len(points), 3, 3))
        force[self.nodes] = -(stiffness * gap)[:, None] * slope
        bent = slope[:, :, None] * slope[:, None, :] + gap[:, None, None] * bend
        block[self.nodes] = convex(stiffness[:, None, None] * bent)
        return float((stiffness * gap**2).sum() / 2), force, block


@dataclass(frozen=True)
class Scene:
    """Tissue and all that acts on it. transpulmonary_kpa: uniform over the surface whatever its shape;
    constraints: wall, bronchi and dead loads.
    """

    mesh: TetMesh
    material: ConstitutiveModel
    constraints: ConstraintTerms
    transpulmonary_kpa: float = 0.0
    cavity: Cavity | None = None
    tree: Tree | None = field(default=None, repr=False)


@dataclass(frozen=True)
class Equilibrium:
    """u: (n, 3) mm; residuals: relative ones of every Newton step; solver: of the last tangent; balance: how it
    ended.
    """

    u: Array
    residuals: tuple[float, ...]
    solver: LinearSolver
    balance: Balance


def tree_of(mesh: TetMesh) -> Tree:
    """Elimination order of every tangent of a mesh, to be made once."""
    still = np.zeros((len(mesh.tets), 3, 3, 3, 3))
    return elimination_tree(tangent_stiffness(mesh, still), mesh.points)


def balance(scene: Scene, start: Array | None = None, tolerance: float = 1e-4) -> Equilibrium:
    """Displacement (n, 3) mm at which a scene's forces balance, from `start`; tolerance: residual over the loads.

    Raises SolverError when nothing holds the body.
    """
    u = np.zeros_like(scene.mesh.points) if start is None else start
    residuals: list[float] = []
    solver: LinearSolver | None = None
    for _ in range(MAX_STEPS):
        unbalanced, scale, tangents = _linearized(scene, u)
        residuals.append(float(np.abs(unbalanced).max() / scale))
        if residuals[-1] < tolerance and solver is not None:
            return Equilibrium(u, tuple(residuals), solver, Balance.BALANCED)
        solver, change = _step(scene, tangents, unbalanced, residuals[-1])
        length = _length(scene, u, change, float((unbalanced * change).sum()))
        if length is None:
            break
        u = u + length * change
    assert solver is not None
    return Equilibrium(u, tuple(residuals), solver, Balance.STOPPED)


def volume(mesh: TetMesh, u: Array) -> float:
    """Volume in mm3 of the mesh displaced by u (n, 3) mm."""
    return float(np.linalg.det(deformation_gradient(mesh, u)) @ mesh.volumes)


def _linearized(scene: Scene, u: Array) -> tuple[Array, float, tuple[Array, csr_matrix]]:
    """Unbalanced forces (n, 3), the scale of the loads, and moduli and the constraints' matrix at u."""
    f = deformation_gradient(scene.mesh, u)
    _, stress, moduli = _tissue(scene, f)
    drawn = scene.constraints.force - (scene.constraints.matrix @ u.ravel()).reshape(-1, 3)
    unbalanced = drawn - eigenstress_load(scene.mesh, stress)
    matrix = scene.constraints.matrix
    scale = max(
        float(np.abs(drawn).max()), abs(scene.transpulmonary_kpa) * float(scene.mesh.boundary.node_areas.mean()), 1e-9
    )
    if scene.cavity is not None:
        _, force, blocks = scene.cavity.respond(scene.mesh.points + u)
        unbalanced = unbalanced + force
        n = len(u)
        matrix = (matrix + bsr_matrix((blocks, np.arange(n), np.arange(n + 1))).tocsr()).tocsr()
    return unbalanced, scale, (moduli, matrix)


def _step(
    scene: Scene, tangents: tuple[Array, csr_matrix], unbalanced: Array, residual: float
) -> tuple[LinearSolver, Array]:
    moduli, matrix = tangents
    for safe in (True,) if residual > _NEAR else (False, True):
        used = convex(moduli.reshape(-1, 9, 9)).reshape(moduli.shape) if safe else moduli
        whole = (tangent_stiffness(scene.mesh, used) + matrix).tocsr()
        whole = (whole + diags(np.full(whole.shape[0], 1e-9 * whole.diagonal().mean()))).tocsr()
        try:
            solver = linear_solver(whole, scene.mesh.points, scene.tree)
            return solver, solver.solve(unbalanced.ravel()).reshape(-1, 3)
        except SolverError:
            if safe:
                raise
    raise AssertionError


def _tissue(scene: Scene, f: Array) -> tuple[Array, Array, Array]:
    """Tissue less the work of the pressure on the volume: energy -p J, whose stress is -p J F^-T."""
    energy, stress, moduli = scene.material.respond(f)
    if scene.transpulmonary_kpa == 0.0:
        return energy, stress, moduli
    p = scene.transpulmonary_kpa * np.linalg.det(f)
    inverse = np.linalg.inv(f).transpose(0, 2, 1)
    pairs = np.einsum("mij,mkl->mijkl", inverse, inverse)
    turned = pairs - pairs.transpose(0, 1, 4, 3, 2)
    return energy - p, stress - p[:, None, None] * inverse, moduli - p[:, None, None, None, None] * turned


def energy_of(scene: Scene, u: Array) -> float:
    """Stored energy less the work of the loads, kPa mm3; infinite where an element is inverted."""
    f = deformation_gradient(scene.mesh, u)
    if not (np.linalg.det(f) > 0).all():
        return np.inf
    tissue = scene.material.respond(f)[0] - scene.transpulmonary_kpa * np.linalg.det(f)
    constraints = u.ravel() @ (scene.constraints.matrix @ u.ravel()) / 2 - (scene.constraints.force * u).sum()
    wall = 0.0 if scene.cavity is None else scene.cavity.respond(scene.mesh.points + u)[0]
    return float(tissue @ scene.mesh.volumes + constraints + wall)


def _length(scene: Scene, u: Array, change: Array, slope: float) -> float | None:
    """Largest tried length that lowers the energy; None when none does."""
    before = energy_of(scene, u)
    slack = 1e-10 * (abs(before) + 1)
    length = 1.0
    for _ in range(_HALVINGS):
        if energy_of(scene, u + length * change) <= before - 1e-4 * length * slope + slack:
            return length
        length /= 2
    return None


def convex(matrices: Array) -> Array:
    """Symmetric matrices (m, k, k) with their negative eigenvalues set to zero."""
    values, vectors = np.linalg.eigh(matrices)
    return np.asarray((vectors * np.maximum(values, 0)[:, None]) @ vectors.transpose(0, 2, 1))
