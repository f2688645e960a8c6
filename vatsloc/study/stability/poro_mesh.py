"""What the shape of elements does: slivers of a given dihedral angle, and linear elements as nu nears 0.5."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import bisect
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import LinearOperator, eigsh

from poro.arrays import Array
from poro.collapse import PoroSystem, Theta, solve
from poro.fem import Tissue, solid
from poro.fem.forms import body_load, consistent_mass, stiffness
from poro.fem.tissue import GRAVITY_KPA_PER_MM
from poro.linalg import Multigrid, linear_solver
from poro.mesh import TetMesh
from poro.mesh.tetmesh import dihedral_angles
from vatsloc.study.bench.poro_lung import GRAVITY, Lung, lung, smooth_wall, system_of
from vatsloc.study.tables import Row

ANGLES_DEG = (10.0, 5.0, 2.0, 1.0, 0.5, 0.1, 0.01)
THETA = Theta(1e-8, 0.8, 5.0)
_WAVE = 2 * np.pi / 80  # 1/mm, of the flow that `towards_incompressible` imposes


def with_slivers(mesh: TetMesh, degrees: float, share: float = 0.03, seed: int = 0) -> tuple[TetMesh, Array]:
    """The mesh with inner nodes moved until the flattest tetrahedron around each has a dihedral angle of `degrees`.

    Returns it with the moved nodes (k,): a `share` of the inner ones, no two in the same tetrahedron.
    """
    points, free = mesh.points.copy(), np.ones(len(mesh.points), bool)
    free[mesh.boundary.nodes] = False
    inner = np.random.default_rng(seed).permutation(np.flatnonzero(free))
    moved: list[int] = []
    for node in inner:
        around = mesh.tets[(mesh.tets == node).any(axis=1)]
        if len(moved) >= share * len(inner):
            break
        if not free[around].any(axis=1).all() or not free[node]:
            continue
        face = around[0][around[0] != node]
        flattest = _flattest(points, around, int(node), points[face].mean(axis=0))
        if flattest(0.0) <= degrees:
            continue
        points[node] += bisect(lambda s, f=flattest: f(s) - degrees, 0, 1, xtol=1e-15) * (
            points[face].mean(axis=0) - points[node]
        )
        free[around] = False
        moved.append(int(node))
    return TetMesh(points, mesh.tets), np.array(moved)


def _flattest(points: Array, around: Array, node: int, towards: Array) -> Callable[[float], float]:
    """Smallest dihedral angle around a node on its way, 0 to 1, to a point; 0 where a tetrahedron is inside out."""

    def angle(share: float) -> float:
        x = points.copy()
        x[node] += share * (towards - x[node])
        star = TetMesh(x, around)
        return float(dihedral_angles(star).min()) if (star.volumes > 0).all() else 0.0

    return angle


def slivers(tets: int = 6_000) -> list[Row]:
    """The lung in its wall on meshes in which 3 % of the inner nodes are moved to make slivers of a given angle.

    Condition number of the stiffness; conjugate-gradient steps of multigrid to 1e-10 (200 at most) and how far its
    answer to the weight is from the factor's; mean distance at the nodes that were not moved to the good mesh's answer.
    """
    body, rows = lung(tets), []
    good = solve(system_of(body, Tissue(), smooth_wall()), THETA)
    for degrees in (None, *ANGLES_DEG):
        mesh, moved = (body.mesh, np.zeros(0, int)) if degrees is None else with_slivers(body.mesh, degrees)
        system = system_of(Lung(mesh, body.hilum, body.hilum_displacement), Tissue(), smooth_wall())
        state = solve(system, THETA)
        away = np.linalg.norm(np.delete(state.u - good.u, moved, axis=0), axis=1)
        rows.append(
            {
                "min_dihedral": float(dihedral_angles(mesh).min()),
                "moved_nodes": len(moved),
                **_solvers(system),
                "lowest_pa": 1e3 * float(state.p.min()),
                "min_det": float(state.det_f.min()),
                "contact_iterations": state.iterations,
                "factor_off_mm": float(away.mean()),
                "factor_off_max_mm": float(away.max()),
                "status": state.status.name,
            }
        )
    return rows


def _solvers(system: PoroSystem) -> Row:
    """What a mesh does to the factor and to multigrid."""
    mesh, rows, direct = system.mesh, system.solid.free_unknowns, system.solid.solver
    matrix = stiffness(mesh, system.tissue.lame_kpa, system.tissue.shear_kpa)[rows][:, rows].tocsr()
    right = body_load(mesh, GRAVITY * GRAVITY_KPA_PER_MM * 140).ravel()[rows]
    exact = direct.solve(right)
    iterative = linear_solver(matrix, mesh.points[np.unique(rows // 3)], limit=0)
    assert isinstance(iterative, Multigrid)
    row: Row = {
        "condition": _condition(matrix, direct.solve),
        "factor_residual": float(np.linalg.norm(matrix @ exact - right) / np.linalg.norm(right)),
    }
    try:
        off = float(np.linalg.norm(iterative.solve(right) - exact) / np.linalg.norm(exact))
        return row | {"multigrid_iterations": len(iterative.residuals) - 1, "multigrid_off": off}
    except RuntimeError:
        return row | {"multigrid_iterations": ">200", "multigrid_off": "-"}


def _condition(matrix: csr_matrix, inverse: Callable[[Array], Array]) -> float:
    """Largest eigenvalue of a symmetric positive definite matrix (n, n) times the largest one of its inverse."""
    start = np.random.default_rng(0).normal(size=matrix.shape[0])
    operators = (matrix, LinearOperator(matrix.shape, inverse, dtype=float))
    top = [eigsh(a, 1, which="LM", v0=start, tol=1e-3, return_eigenvectors=False)[0] for a in operators]
    return float(top[0] * top[1])


def towards_incompressible(sizes: tuple[int, int] = (3_000, 24_000)) -> list[Row]:
    """Error of a volume-preserving motion that its surface and a force impose, as nu goes to 0.5, on two meshes.

    u = 5 mm (sin ky, sin kz, sin kx) solves elasticity at every nu under the force mu k^2 u: what grows with nu is
    locking. Relative errors in L2, and the order between the meshes; the interpolant's own error beside.
    """
    rows: list[Row] = []
    meshes = [lung(size).mesh for size in sizes]
    for poisson in (0.35, 0.45, 0.49, 0.499, 0.4999):
        tissue, row = Tissue(poisson=poisson), Row(poisson=poisson)
        for size, mesh in zip(sizes, meshes, strict=True):
            row[f"rel_error_{size}"] = _error(mesh, tissue)
        steps = np.log(len(meshes[1].tets) / len(meshes[0].tets)) / 3
        row["order"] = float(np.log(row[f"rel_error_{sizes[0]}"] / row[f"rel_error_{sizes[1]}"]) / steps)
        rows.append(row)
    return rows


def _error(mesh: TetMesh, tissue: Tissue) -> float:
    exact = 5 * np.sin(_WAVE * mesh.points[:, [1, 2, 0]])
    mass, outer = consistent_mass(mesh), mesh.boundary.nodes
    u = solid(mesh, tissue, outer).solve(mass @ (tissue.shear_kpa * _WAVE**2 * exact), exact[np.sort(outer)])
    norms = [float(np.sqrt((field * (mass @ field)).sum())) for field in (u - exact, exact)]
    return norms[0] / norms[1]
