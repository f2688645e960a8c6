"""Contact by active set beside penalties: how deep, how many steps, and what finer meshes change."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import bsr_matrix

from poro.collapse import PoroState, PoroSystem, Theta, solve
from poro.fem import Tissue, solid
from poro.fem.tissue import GRAVITY_KPA_PER_MM
from poro.mesh import interpolate, locate
from vatsloc.study.bench.poro_lung import lung, smooth_wall, system_of
from vatsloc.study.tables import Row

THETA = Theta(1e-8, 0.8, 5.0)
PENALTY_KPA_PER_MM = 1.0  # the stiffest at which plain Newton converges


def contact_methods(sizes: tuple[int, ...] = (1_500, 3_000)) -> list[Row]:
    """Penetration and iterations of penalty contact over its stiffness, beside the active set, on two meshes."""
    rows: list[Row] = []
    for tets in sizes:
        system = system_of(lung(tets), Tissue(), smooth_wall())
        exact = solve(system, THETA)
        gap = float(exact.gap[system.contact_nodes].min())
        rows.append(_contact_row(tets, "active set", gap, exact.iterations, exact.contact.pivots, 0.0))
        for stiffness in (0.1, 1.0, 10.0, 1000.0):
            u, steps, deepest = _penalty(system, THETA, stiffness)
            away = float(np.linalg.norm(u - exact.u) / np.linalg.norm(exact.u))
            rows.append(_contact_row(tets, f"penalty {stiffness:g} kPa/mm", deepest, steps, steps, away))
    return rows


def _contact_row(tets: int, method: str, gap: float, steps: int, solves: int, away: float) -> Row:
    return {
        "tets": tets,
        "method": method,
        "deepest_mm": max(0.0, -gap),
        "iterations": steps,
        "set_changes": solves,
        "rel_diff": away,
    }


def contact_meshes(sizes: tuple[int, ...] = (1_500, 3_000, 6_000, 12_000, 24_000)) -> list[Row]:
    """Active set and penalty of 1 kPa/mm on ever finer meshes, displacements beside the finest mesh's active set."""
    solved = []
    for tets in sizes:
        system = system_of(lung(tets), Tissue(), smooth_wall())
        solved.append((system, solve(system, THETA), _penalty(system, THETA, PENALTY_KPA_PER_MM)))
    finest, reference, _ = solved[-1]
    rows: list[Row] = []
    for system, state, (soft, soft_steps, soft_deepest) in solved:
        there = interpolate(locate(finest.mesh, system.mesh.points), reference.u)
        rows.append(
            {
                "tets": len(system.mesh.tets),
                "contact_nodes": len(system.contact_nodes),
                "iterations": state.iterations,
                "set_changes": state.contact.pivots,
                "deepest_mm": max(0.0, -float(state.gap[system.contact_nodes].min())),
                **_pressed(system, state),
                "off_finest_mm": float(np.linalg.norm(state.u - there, axis=1).mean()),
                "penalty_iterations": soft_steps,
                "penalty_deepest_mm": max(0.0, -soft_deepest),
                "penalty_off_mm": float(np.linalg.norm(soft - there, axis=1).mean()),
            }
        )
    return rows


def _pressed(system: PoroSystem, state: PoroState) -> Row:
    """Share of the contact nodes' area that touches, and the mean pressure there in Pa."""
    boundary = system.mesh.boundary
    area = np.zeros(len(state.u))
    area[boundary.nodes] = boundary.node_areas
    touching = float(area[state.active].sum())
    return {
        "touching_percent": 100 * touching / float(area[system.contact_nodes].sum()),
        "mean_pressure_pa": 1e3 * float((area * state.contact_pressure).sum()) / touching,
    }


def _penalty(system: PoroSystem, theta: Theta, stiffness: float, most: int = 40) -> tuple[Any, int, float]:
    """Displacements, iterations (`most` when it cycles) and smallest gap under penalties of stiffness kPa/mm."""
    mesh, nodes, wall = system.mesh, system.contact_nodes, system.wall
    p, _ = system.flow.pressure(theta.kappa_b)
    load = (system.pressure_load @ p).reshape(-1, 3)
    load = load + mesh.node_volumes[:, None] * system.gravity * GRAVITY_KPA_PER_MM * system.tissue.density(theta.phi)
    area = np.zeros(len(mesh.points))
    area[mesh.boundary.nodes] = mesh.boundary.node_areas
    u, count = np.zeros_like(load), np.arange(len(load))
    steps = 0
    while steps < most:
        steps += 1
        gap, gradient, hessian = wall.gap(u[nodes], theta.d_diaph_mm)
        pressing = np.where(gap < 0, stiffness * area[nodes], 0.0)
        blocks, force = np.zeros((len(u), 3, 3)), load.copy()
        blocks[nodes] = pressing[:, None, None] * gradient[:, :, None] * gradient[:, None]
        geometric = (pressing * np.minimum(gap, 0))[:, None, None] * hessian
        blocks[nodes] += geometric
        force[nodes] += np.einsum("nij,nj->ni", geometric, u[nodes])
        along = np.einsum("nd,nd->n", gradient, u[nodes]) - gap
        force[nodes] += (pressing * along)[:, None] * gradient
        penalty = bsr_matrix((blocks, count, np.append(count, len(u)))).tocsr()
        ahead = solid(mesh, system.tissue, system.hilum, penalty).solve(force, system.hilum_displacement)
        moved = float(np.abs(ahead - u).max())
        u = u + min(1.0, 20 / max(moved, 1e-30)) * (ahead - u)
        if moved < 1e-3:
            break
    return u, steps, float(wall.gap(u[nodes], theta.d_diaph_mm)[0].min())
