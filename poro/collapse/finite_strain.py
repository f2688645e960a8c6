"""Lung at finite strain in front of its chest wall: Newton with line search, load stepping, active set of contact.

Weight stays as on the body at rest; the pressure's force follows the deformed lung.
Ref: Alvarez 2021, eqs. 12-14; Bonet & Wood 2008, ch. 9.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np
from scipy.sparse import bsr_matrix, csr_matrix, diags

from poro.arrays import Array
from poro.contact.chest_wall import ChestWall
from poro.errors import SolverError
from poro.fem.constitutive import ConstitutiveModel
from poro.fem.forms import deformation_gradient, eigenstress_load, tangent_stiffness
from poro.linalg.dissection import Tree
from poro.linalg.solver import elimination_tree, linear_solver
from poro.mesh.tetmesh import TetMesh

_MAX_NEWTON = 25  # steps for one share of the load
_PATIENCE = 4  # where steps are counted: those without a smaller residual, after which the load is raised by less
_FEWEST = 5  # Newton steps that a share of the load takes at best
_SMALLEST_STEP = 1 / 64  # of the load
_SHRINK, _MAX_HALVINGS = 0.5, 12
_MAX_SETS = 15
_NEAR = 1e-2  # relative residual below which the full tangent is tried first


class FiniteStatus(Enum):
    """How a finite-strain solution ended."""

    SOLVED = "forces balance at finite strain"
    STOPPED = "the load could not be raised further: Newton did not converge on the smallest load step"
    OUT_OF_STEPS = "Newton took as many steps as it was given before all of the load was carried"


@dataclass(frozen=True)
class WallContact:
    """Chest wall in front of contact nodes (nc,), its moving part shifted by travel_mm."""

    wall: ChestWall
    nodes: Array
    travel_mm: float


@dataclass(frozen=True)
class FiniteProblem:
    """Body of one constitutive model, held at nodes `fixed` (k,) moved by imposed (k, 3) mm, under nodal forces load
    (n, 3) kPa mm2 and pressure_drop (m,) kPa: how far alpha p in an element lies below its value at the surface.
    """

    mesh: TetMesh
    material: ConstitutiveModel
    fixed: Array
    imposed: Array
    load: Array
    contact: WallContact | None = None
    pressure_drop: Array | None = None

    @cached_property
    def tree(self) -> Tree:
        """Order in which a tangent is eliminated: the same for all of them, since its entries are."""
        nothing = np.zeros((len(self.mesh.tets), 3, 3, 3, 3))
        return elimination_tree(tangent_stiffness(self.mesh, nothing), self.mesh.points)


@dataclass(frozen=True)
class FiniteState:
    """u: (n, 3) mm; force: (nc,) kPa mm2 along the gap's gradient; active: (nc,) bool; share: load carried, 1 when
    solved; residuals: relative ones of every Newton step; load_steps: accepted ones.
    """

    u: Array
    force: Array
    active: Array
    share: float
    residuals: tuple[float, ...]
    load_steps: int
    status: FiniteStatus


def deform(problem: FiniteProblem, tolerance: float = 1e-8, most_steps: float = np.inf) -> FiniteState:
    """Raise the load in steps, halved when Newton fails and doubled when it does not, until all of it is carried.

    tolerance: relative residual of a balanced lung; most_steps: Newton steps in all; no further share of the load is
    tried where they cannot carry the rest even at best.
    """
    contacts = 0 if problem.contact is None else len(problem.contact.nodes)
    u, force, active = np.zeros_like(problem.load), np.zeros(contacts), np.zeros(contacts, bool)
    share, step, taken = 0.0, 0.25, 0
    patience = _PATIENCE if np.isfinite(most_steps) else _MAX_NEWTON
    residuals: list[float] = []
    while share < 1:
        step = min(step, 1 - share)
        tried = _newton(problem, share, share + step, (u, force, active), residuals, (tolerance, patience))
        if tried is not None:
            u, force, active = tried
            share, step, taken = share + step, 2 * step, taken + 1
        else:
            step /= 2
            if step < _SMALLEST_STEP:
                break
        if len(residuals) + _FEWEST * _shares_at_best(1 - share, step) > most_steps:
            break
    ended = FiniteStatus.STOPPED if step < _SMALLEST_STEP else FiniteStatus.OUT_OF_STEPS
    status = FiniteStatus.SOLVED if share >= 1 else ended
    return FiniteState(u, force, active, share, tuple(residuals), taken, status)


def _shares_at_best(rest: float, step: float) -> int:
    """How many steps carry the rest of a load where each is twice as large as the one before, the first of `step`."""
    return int(np.ceil(np.log2(1 + rest / step) - 1e-9))


def _gap(problem: FiniteProblem, u: Array, share: float) -> tuple[Array, Array, Array]:
    if problem.contact is None:
        return np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3))
    return problem.contact.wall.gap(u[problem.contact.nodes], share * problem.contact.travel_mm)


def _respond(problem: FiniteProblem, f: Array, share: float) -> tuple[Array, Array, Array]:
    """Energy, stress and moduli of the tissue and of `share` of the pressure drop.

    The force -alpha grad p of the deformed lung does the work of the pressure drop q on the volume: energy q J.
    """
    energy, stress, moduli = problem.material.respond(f)
    if problem.pressure_drop is None:
        return energy, stress, moduli
    q = share * problem.pressure_drop * np.linalg.det(f)
    inverse = np.linalg.inv(f).transpose(0, 2, 1)
    pairs = np.einsum("mij,mkl->mijkl", inverse, inverse)
    return (
        energy + q,
        stress + q[:, None, None] * inverse,
        moduli + q[:, None, None, None, None] * (pairs - pairs.transpose(0, 1, 4, 3, 2)),
    )


def _newton(
    problem: FiniteProblem,
    before: float,
    share: float,
    start: tuple[Array, Array, Array],
    residuals: list[float],
    limits: tuple[float, int],
) -> tuple[Array, Array, Array] | None:
    """Displacement, contact forces and active set that carry `share` of the load, from those at `before`, or None.

    limits: residual of a balanced lung, and how many steps in a row may bring no smaller one.
    """
    tolerance, patience = limits
    u, force, active = start
    load = share * problem.load
    jump = (share - before) * problem.imposed
    nodes = np.zeros(0, int) if problem.contact is None else problem.contact.nodes
    last = least = np.inf
    in_vain = 0
    for _ in range(_MAX_NEWTON):
        _, stress, moduli = _respond(problem, deformation_gradient(problem.mesh, u), share)
        unbalanced = load - eigenstress_load(problem.mesh, stress)
        gap, gradient, hessian = _gap(problem, u, share)
        geometric = -force[:, None, None] * hessian
        # Far from balance the tangent may be indefinite; its convex part still descends.
        for convex in (True,) if last > _NEAR else (False, True):
            parts = moduli, geometric
            if convex:
                parts = _convex(moduli.reshape(-1, 9, 9)).reshape(moduli.shape), _convex(geometric)
            matrix = tangent_stiffness(problem.mesh, parts[0])
            if len(nodes):
                matrix = (matrix + _blocks(len(u), nodes, parts[1])).tocsr()
            step = _linearized_contact(problem, matrix, unbalanced, (gap, gradient, active), jump)
            if step is not None:
                break
        else:
            return None
        change, force, active = step
        length = _line_search(problem, u, change, load, share, force)
        if length is None:
            return None
        u = u + length * change
        jump = (1 - length) * jump
        gap, gradient, _ = _gap(problem, u, share)
        behind = ~active & (gap < -1e-6)
        _, stress, _ = _respond(problem, deformation_gradient(problem.mesh, u), share)
        rest = load - eigenstress_load(problem.mesh, stress)
        np.add.at(rest, nodes, gradient * force[:, None])
        reaction = rest[problem.fixed]
        rest[problem.fixed] = 0
        forces = (float(np.abs(part).max(initial=0)) for part in (load, reaction, force))
        scale = max(*forces, share * _force_of_pressure(problem), 1e-12)
        last = float(np.abs(rest).max()) / scale
        residuals.append(last)
        if last < tolerance and not behind.any() and length == 1:
            return u, force, active
        in_vain = 0 if last < least else in_vain + 1
        least = min(last, least)
        if in_vain == patience:
            return None
    return None


def _force_of_pressure(problem: FiniteProblem) -> float:
    """Nodal force of the pressure drop where it varies, kPa mm2: it balances itself, so reactions do not show it."""
    if problem.pressure_drop is None:
        return 0.0
    return float(np.abs(problem.pressure_drop).max() * np.cbrt(problem.mesh.volumes.mean()) ** 2)


def _linearized_contact(
    problem: FiniteProblem, matrix: csr_matrix, unbalanced: Array, contact: tuple[Array, Array, Array], jump: Array
) -> tuple[Array, Array, Array] | None:
    """Step, contact forces >= 0 and active set of the linearized problem; None when it has no lowest energy."""
    gap, gradient, active = contact
    nodes = np.zeros(0, int) if problem.contact is None else problem.contact.nodes
    for _ in range(_MAX_SETS):
        try:
            change, force = _constrained_step(problem, matrix, unbalanced, (gap, gradient, active), jump)
        except SolverError:
            return None
        ahead = gap + np.einsum("nd,nd->n", gradient, change[nodes])
        flipped = (active & (force < 0)) | (~active & (ahead < -1e-9))
        if not flipped.any():
            break
        active = active ^ flipped
    return change, np.maximum(force, 0), active


def _convex(matrices: Array) -> Array:
    """Symmetric matrices (m, k, k) with their negative eigenvalues set to zero."""
    values, vectors = np.linalg.eigh(matrices)
    return (vectors * np.maximum(values, 0)[:, None]) @ vectors.transpose(0, 2, 1)


def _blocks(count: int, nodes: Array, blocks: Array) -> csr_matrix:
    """Sparse (3n, 3n) with 3x3 blocks (nc, 3, 3) on the diagonal at nodes (nc,)."""
    full = np.zeros((count, 3, 3))
    full[nodes] = blocks
    return bsr_matrix((full, np.arange(count), np.arange(count + 1))).tocsr()


def _constrained_step(
    problem: FiniteProblem, matrix: csr_matrix, unbalanced: Array, contact: tuple[Array, Array, Array], jump: Array
) -> tuple[Array, Array]:
    """Newton step (n, 3) that closes the gap at active nodes and moves the held ones by `jump`; contact forces (nc,).

    Active nodes are rotated so that their first axis is the wall's normal, and that unknown is then imposed. Raises
    SolverError when the tangent is not positive definite.
    """
    gap, gradient, active = contact
    count = len(unbalanced)
    nodes = np.zeros(0, int) if problem.contact is None else problem.contact.nodes
    pressed = nodes[active]
    steep = np.linalg.norm(gradient[active], axis=1)
    frames = np.broadcast_to(np.eye(3), (count, 3, 3)).copy()
    frames[pressed] = _frames(gradient[active] / steep[:, None])
    rotation = bsr_matrix((frames, np.arange(count), np.arange(count + 1))).tocsr()
    rotated = (rotation @ matrix @ rotation.T).tocsr()
    imposed = np.zeros((count, 3))
    imposed[pressed, 0] = -gap[active] / steep
    imposed[problem.fixed] = jump
    known = np.zeros((count, 3), bool)
    known[pressed, 0] = True
    known[problem.fixed] = True
    free = diags((~known.ravel()).astype(float))
    right = (rotation @ unbalanced.ravel() - rotated @ imposed.ravel()) * ~known.ravel()
    scale = float(rotated.diagonal().mean())
    reduced = (free @ rotated @ free + diags(scale * known.ravel())).tocsr()
    change = linear_solver(reduced, problem.mesh.points, problem.tree).solve(
        right + scale * imposed.ravel() * known.ravel()
    )
    reaction = (rotated @ change - rotation @ unbalanced.ravel()).reshape(-1, 3)
    force = np.zeros(len(nodes))
    force[active] = reaction[pressed, 0] / steep
    return (rotation.T @ change).reshape(-1, 3), force


def _frames(normals: Array) -> Array:
    """Orthonormal rows (k, 3, 3) whose first is the given unit normal."""
    axis = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    second = np.cross(normals, axis)
    second /= np.linalg.norm(second, axis=1)[:, None]
    return np.stack([normals, second, np.cross(normals, second)], axis=1)


def _line_search(
    problem: FiniteProblem, u: Array, change: Array, load: Array, share: float, force: Array
) -> float | None:
    """Largest tried length at which energy plus penetration does not rise; None when every length raises it."""
    sharp = 2 * float(np.abs(force).max(initial=0))
    held = np.zeros(len(u), bool)
    held[problem.fixed] = True

    def merit(at: Array) -> float:
        f = deformation_gradient(problem.mesh, at)
        if not (np.linalg.det(f) > 0).all():
            return np.inf
        energy = float(_respond(problem, f, share)[0] @ problem.mesh.volumes) - float((load * at).sum())
        return energy + sharp * float(np.maximum(-_gap(problem, at, share)[0], 0).sum())

    before = merit(u)
    # A step that moves held nodes must be taken although it costs energy, so it is only kept from inverting elements.
    moves_held = bool(np.abs(change[held]).max(initial=0) > 1e-12)
    slack = 1e-9 * (abs(before) + 1)
    length = 1.0
    for _ in range(_MAX_HALVINGS):
        value = merit(u + length * change)
        if np.isfinite(value) and (moves_held or value <= before + slack):
            return length
        length *= _SHRINK
    return None
