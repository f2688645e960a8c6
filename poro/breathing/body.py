"""The rest of the body follows its lungs: an elastic body, and the mass-spring-damper network of the paper beside it.

Ref: Li & Porikli 2014, section 4 (eqs. 4-6); elastic moduli by grey value as in radiotherapy's finite elements.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, diags

from poro.arrays import Array
from poro.fem.constraints import point_constraints
from poro.fem.forms import tangent_stiffness
from poro.fem.tissue import Tissue
from poro.linalg.solver import LinearSolver, linear_solver
from poro.mesh import TetMesh, TriSurface, closest_points

SOFT_KPA, BONE_KPA, POISSON = 5.0, 300.0, 0.45
BONE_HU = 250.0
TOUCH_MM = 12.0
"""Body nodes no farther from a lung follow its border; along its normal alone, since the lung slides."""
HELD = 1e3
"""Stiffness of springs that hold, over soft tissue's."""
STEPS, SETTLED_MM = 500, 0.01
"""Of the network: the paper takes about 500 difference steps."""


@dataclass(frozen=True)
class Body:
    """The body around the lungs. still: (k,) nodes that do not move (spine); near: (q,) nodes that follow; borders: of
    the lungs at rest; solver: of the elastic body with both held.
    """

    mesh: TetMesh
    hu: Array
    still: Array
    near: Array
    normals: Array
    operator: csr_matrix
    stiffness: Array
    solver: LinearSolver

    def follow(self, wanted: Array) -> Array:
        """Displacement (n, 3) mm of the body when the border moves by wanted (q, 3) mm at the nodes `near`."""
        force = np.zeros_like(self.mesh.points)
        force[self.near] = np.einsum("qij,qj->qi", self.stiffness, wanted)
        return self.solver.solve(force.ravel()).reshape(-1, 3)


def body(mesh: TetMesh, hu: Array, still: Array, lungs: list[TriSurface]) -> Body:
    """Elastic body with moduli by the nodes' grey values hu (n,); still: (n,) bool; lungs: their borders at rest."""
    points = mesh.points
    reach, normals = np.full(len(points), np.inf), np.zeros_like(points)
    for border in lungs:
        found = closest_points(border, points)
        closer = np.abs(found.distance) < reach
        reach[closer] = np.abs(found.distance)[closer]
        normals[closer] = border.normals[found.triangle][closer]
    outer = np.zeros(len(points), bool)
    outer[mesh.boundary.nodes] = True
    near = np.flatnonzero((reach < TOUCH_MM) & outer & ~still)
    share = np.clip(hu[mesh.tets].mean(axis=1) / BONE_HU, 0, 1) ** 2
    young = SOFT_KPA + share * (BONE_KPA - SOFT_KPA)
    size = SOFT_KPA * np.cbrt(mesh.node_volumes)
    stiffness = HELD * size[near, None, None] * normals[near, :, None] * normals[near, None, :]
    operator = coo_matrix((np.ones(len(near)), (np.arange(len(near)), near)), shape=(len(near), len(points))).tocsr()
    held, _ = point_constraints(operator, stiffness, np.zeros((len(near), 3)))
    anchors = np.where(still, HELD * size, 1e-4 * size)
    matrix = (tangent_stiffness(mesh, _moduli(young)) + held + diags(np.repeat(anchors, 3))).tocsr()
    return Body(
        mesh, hu, np.flatnonzero(still), near, normals[near], operator, stiffness, linear_solver(matrix, points)
    )


def border_motion(lungs: list[TriSurface], moved: list[Array], points: Array) -> Array:
    """How far (q, 3) mm the lungs' borders, displaced by moved (n, 3) each, carry points (q, 3) next to them."""
    reach, motion = np.full(len(points), np.inf), np.zeros_like(points)
    for border, u in zip(lungs, moved, strict=True):
        found = closest_points(border, points)
        closer = np.abs(found.distance) < reach
        reach[closer] = np.abs(found.distance)[closer]
        here = np.einsum("qk,qkd->qd", found.barycentric, u[border.triangles[found.triangle]])
        motion[closer] = here[closer]
    return motion


def network(scene: Body, wanted: Array) -> tuple[Array, int]:
    """The same by masses, springs and critical dampers: displacement (n, 3) mm and steps taken.

    Masses by density (eq. 4), springs by grey value (section 4.1), damping 2 sqrt(m k) (eq. 6), by explicit steps;
    nodes next to a lung are carried along with its border, as the paper's are.
    """
    mesh = scene.mesh
    i, j = np.triu_indices(4, 1)
    edges = np.unique(
        np.sort(np.concatenate([mesh.tets[:, [a, b]] for a, b in zip(i, j, strict=True)]), axis=1), axis=0
    )
    a, b = edges.T
    hu = (scene.hu[a] + scene.hu[b]) / 2
    spring = spring_stiffness(hu)
    density = np.where(scene.hu < -13, 1.1e-3 * scene.hu + 1.06, 6e-4 * scene.hu + 1.081)
    mass = np.maximum(density, 0.05)
    n = len(mesh.points)
    stiff = np.bincount(a, spring, n) + np.bincount(b, spring, n)
    graph = coo_matrix((np.r_[spring, spring], (np.r_[a, b], np.r_[b, a])), shape=(n, n)).tocsr()
    damping = 2 * np.sqrt(mass * stiff / 10)
    dt = 0.9 * np.sqrt(mass / (2 * stiff)).min()
    u, v = np.zeros((n, 3)), np.zeros((n, 3))
    held = np.zeros(n, bool)
    held[scene.near], held[scene.still] = True, True
    u[scene.near] = wanted
    for taken in range(1, STEPS + 1):  # noqa: B007
        pull = graph @ u - stiff[:, None] * u
        v = (v + dt * pull / mass[:, None]) / (1 + dt * damping / mass)[:, None]
        v[held] = 0
        step = dt * v
        u = u + step
        if np.abs(step).max() < SETTLED_MM * 1e-2:
            break
    return u, taken


def spring_stiffness(hu: Array) -> Array:
    """Stiffness (n,) of springs between grey values hu (n,), without unit. Ref: section 4.1."""
    soft = 0.001 + 0.799 * np.clip((hu + 1000) / 1700, 0, 1)
    return np.where(hu > 700, 1 - 0.2 * np.exp(-(hu - 700) / 500), soft)


def _moduli(young: Array) -> Array:
    """Linear moduli (m, 3, 3, 3, 3) kPa for a Young's modulus (m,) per element."""
    unit, eye = Tissue(young_kpa=1.0, poisson=POISSON), np.eye(3)
    twice = np.einsum("ik,jl->ijkl", eye, eye) + np.einsum("il,jk->ijkl", eye, eye)
    one = unit.lame_kpa * np.einsum("ij,kl->ijkl", eye, eye) + unit.shear_kpa * twice
    return young[:, None, None, None, None] * one
