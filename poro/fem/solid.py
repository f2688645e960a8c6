"""Linear elastic lung with imposed displacements. Ref: Alvarez 2021, eq. 10."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.sparse import csr_matrix

from poro.arrays import Array
from poro.fem.forms import KEPT_MESHES, stiffness
from poro.fem.tissue import Tissue
from poro.linalg.dissection import Tree
from poro.linalg.solver import ONCE_TOLERANCE, LinearSolver, elimination_tree, linear_solver, solver_for_few
from poro.mesh.tetmesh import TetMesh


@dataclass(frozen=True)
class Solid:
    """Factorized stiffness of a mesh held at nodes `fixed`; free_unknowns: rows of the unknowns that remain."""

    mesh: TetMesh
    fixed: Array
    free_unknowns: Array
    solver: LinearSolver
    coupling: csr_matrix

    def solve(self, force: Array, imposed: Array | None = None) -> Array:
        """Displacements (n, 3) or (n, 3, k) mm under nodal forces of that shape, with imposed displacements at `fixed`.

        force: kPa mm2; imposed: (nfixed, 3) or (nfixed, 3, k) mm, zero when left out.
        """
        shape = force.shape
        right = force.reshape(3 * shape[0], *shape[2:])[self.free_unknowns]
        u = np.zeros((3 * shape[0], *shape[2:]))
        if imposed is not None:
            held = imposed.reshape(3 * len(self.fixed), *shape[2:])
            right = right - self.coupling @ held
            u[unknowns_of(self.fixed)] = held
        u[self.free_unknowns] = self.solver.solve(right)
        return u.reshape(shape)


def unknowns_of(nodes: Array) -> Array:
    """Rows 3 * node + axis of nodes (k,), (3k,)."""
    return (np.asarray(nodes)[:, None] * 3 + np.arange(3)).ravel()


def _centred(points: Array) -> Array:
    return points - points.mean(axis=0) if len(points) else np.zeros((1, 3))


def solid(mesh: TetMesh, tissue: Tissue, fixed: Array, constraints: csr_matrix | None = None) -> Solid:
    """Factorize the elastic stiffness, plus that of optional point constraints (3n, 3n) kPa mm, with `fixed` held.

    Raises ValueError when neither fixed nodes nor constraints hold the body, SolverError when they do not suffice.
    """
    if constraints is None:
        _require_held(mesh, fixed)
    matrix = stiffness(mesh, tissue.lame_kpa, tissue.shear_kpa)
    if constraints is not None:
        matrix = (matrix + constraints).tocsr()
    fixed = np.unique(fixed).astype(np.int64)
    free, matrix, coupling = _parted(matrix, fixed)
    return Solid(mesh, fixed, unknowns_of(free), linear_solver(matrix, mesh.points[free]), coupling)


def continued(mesh: TetMesh, tissue: Tissue, fixed: Array, imposed: Array) -> Array:
    """Displacements (n, 3) mm of a body of which nodes `fixed` (k,), in ascending order, are moved by (k, 3) mm.

    As of `solid` and its `solve`, for less where that is asked for once, to the tolerance of `solver_for_few`. Raises
    as `solid`.
    """
    _require_held(mesh, fixed)
    free, matrix, coupling = _parted(stiffness(mesh, tissue.lame_kpa, tissue.shear_kpa), fixed)
    u = np.empty_like(mesh.points)
    u[fixed] = imposed
    u[free] = solver_for_few(matrix, mesh.points[free]).solve(-(coupling @ imposed.ravel())).reshape(-1, 3)
    return u


def _require_held(mesh: TetMesh, fixed: Array) -> None:
    if np.linalg.matrix_rank(_centred(mesh.points[fixed]), tol=1e-6) < 2:
        raise ValueError(f"{len(np.unique(fixed))} held nodes let the body move freely; hold three that span a plane")


def _parted(matrix: csr_matrix, fixed: Array) -> tuple[Array, csr_matrix, csr_matrix]:
    """Nodes that are free where distinct nodes `fixed` are held, the rows and columns of a stiffness that are theirs,
    and their rows with the columns of the held ones.
    """
    free = np.setdiff1d(np.arange(matrix.shape[0] // 3), fixed)
    rows = unknowns_of(free)
    reduced = matrix[rows]
    return free, reduced[:, rows].tocsr(), reduced[:, unknowns_of(fixed)].tocsr()


@dataclass(frozen=True)
class Constrained:
    """A body that point constraints alone hold, ready for nodal forces."""

    solver: LinearSolver

    def solve(self, force: Array) -> Array:
        """Displacements (n, 3) mm under nodal forces (n, 3) kPa mm2. Raises SolverError when the constraints do not
        suffice.
        """
        return self.solver.solve(force.ravel()).reshape(-1, 3)


def constrained(
    mesh: TetMesh, tissue: Tissue, constraints: csr_matrix, tolerance: float = ONCE_TOLERANCE
) -> Constrained:
    """A body held by point constraints (3n, 3n) kPa mm, for few forces, to a tolerance as of `solver_for_few`."""
    matrix = (stiffness(mesh, tissue.lame_kpa, tissue.shear_kpa) + constraints).tocsr()
    return Constrained(solver_for_few(matrix, mesh.points, _tree(mesh, tissue), tolerance))


def anchor(mesh: TetMesh, tissue: Tissue) -> Array:
    """Stiffness (3n,) kPa mm that holds a body where no constraint does; far below any tissue stiffness."""
    return np.repeat(1e-6 * tissue.young_kpa * np.cbrt(mesh.node_volumes), 3)


def prepare_solid(mesh: TetMesh, tissue: Tissue) -> None:
    """Do and keep what `constrained` needs of a mesh and a tissue alone, so that it need not be waited for."""
    _tree(mesh, tissue)


@lru_cache(maxsize=KEPT_MESHES)
def _tree(mesh: TetMesh, tissue: Tissue) -> Tree:
    """The stiffness alone tells it: a point constraint couples only what its tetrahedron does."""
    return elimination_tree(stiffness(mesh, tissue.lame_kpa, tissue.shear_kpa), mesh.points)
