"""Where the poroelastic lung stops being right: pressure bounds, inverted elements, nu towards 0.5, contact, hilum."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import bsr_matrix

from poro.assembly import deformation_gradient
from poro.choice import finite_problem
from poro.finite import deform
from poro.flow import Flow
from poro.laws import neo_hookean
from poro.model import PoroSystem, Theta, solve, without_wall
from poro.solid import solid
from poro.tissue import GRAVITY_KPA_PER_MM, Tissue
from vatsloc.study.poro_lung import lung, smooth_wall, system_of
from vatsloc.study.tables import Row, markdown

TETS = 3_000
_TISSUE = Tissue()


def _system(tets: int = TETS, tissue: Tissue = _TISSUE, hilum_radius_mm: float = 22.0) -> PoroSystem:
    return system_of(lung(tets, hilum_radius_mm), tissue, smooth_wall())


def pressure_bounds() -> list[Row]:
    """Lowest and highest pressure in Pa, consistent against lumped reaction, over kappa_b and two meshes."""
    rows = []
    for tets in (3_000, 24_000):
        mesh = lung(tets).mesh
        for kappa_b in 10.0 ** np.arange(-10, -3.5, 1):
            row: Row = {"tets": len(mesh.tets), "kappa_b": kappa_b}
            row["layer_over_edge"] = Flow(mesh, _TISSUE).resolved(kappa_b)
            for name, lumped in (("lumped", True), ("consistent", False)):
                p = Flow(mesh, _TISSUE, lumped).pressure(kappa_b)[0] * 1e3
                row |= {f"min_pa_{name}": float(p.min()), f"max_pa_{name}": float(p.max())}
            rows.append(row)
    return rows


def inverted_elements() -> list[Row]:
    """Smallest det F and inverted share over (kappa_b, phi), linear against neo-Hookean."""
    system, rows, law = _system(), [], neo_hookean(_TISSUE)
    for kappa_b in (1e-9, 1e-8, 1e-6):
        for phi in (0.3, 0.6, 0.9):
            theta = Theta(kappa_b, phi)
            linear, finite = solve(system, theta), deform(finite_problem(system, theta, law))
            det = np.linalg.det(deformation_gradient(system.mesh, finite.u))
            total = system.mesh.volumes.sum()
            rows.append(
                {
                    "kappa_b": kappa_b,
                    "phi": phi,
                    "linear_min_det": float(linear.det_f.min()),
                    "linear_inverted_percent": 100 * linear.inverted_share,
                    "linear_volume": float(linear.det_f @ system.mesh.volumes / total),
                    "finite_min_det": float(det.min()),
                    "finite_volume": float(det @ system.mesh.volumes / total),
                    "finite_load_carried": finite.share,
                    "newton_steps": len(finite.residuals),
                }
            )
    return rows


def towards_incompressible() -> list[Row]:
    """Mean motion under weight alone, without wall, as nu goes to 0.5, on two meshes."""
    rows = []
    for poisson in (0.35, 0.45, 0.49, 0.499, 0.4999):
        row: Row = {"poisson": poisson}
        for tets in (3_000, 24_000):
            u = without_wall(_system(tets, Tissue(poisson=poisson)), Theta(0.0, 0.7))[1]
            row[f"mean_mm_{tets}"] = float(np.linalg.norm(u, axis=1).mean())
        rows.append(row)
    return rows


def contact_methods(sizes: tuple[int, ...] = (1_500, TETS)) -> list[Row]:
    """Penetration and iterations of penalty contact over its stiffness, beside the active set, on two meshes."""
    rows, theta = [], Theta(1e-8, 0.8, 5.0)
    for tets in sizes:
        system = _system(tets)
        exact = solve(system, theta)
        gap = float(exact.gap[system.contact_nodes].min())
        rows.append(_contact_row(tets, "active set", gap, exact.iterations, exact.contact.pivots, 0.0))
        for stiffness in (0.1, 1.0, 10.0, 1000.0):
            u, steps, deepest = _penalty(system, theta, stiffness)
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


def _penalty(system: PoroSystem, theta: Theta, stiffness: float, most: int = 40) -> tuple[Any, int, float]:
    """Displacements, iterations (`most` when it cycles) and smallest gap under springs of stiffness kPa/mm."""
    mesh, nodes, obstacle = system.mesh, system.contact_nodes, system.obstacle
    p, _ = system.flow.pressure(theta.kappa_b)
    load = (system.pressure_load @ p).reshape(-1, 3)
    load = load + mesh.node_volumes[:, None] * system.gravity * GRAVITY_KPA_PER_MM * system.tissue.density(theta.phi)
    area = np.zeros(len(mesh.points))
    area[mesh.boundary.nodes] = mesh.boundary.node_areas
    u, count = np.zeros_like(load), np.arange(len(load))
    steps = 0
    while steps < most:
        steps += 1
        gap, gradient, hessian = obstacle.gap(u[nodes], theta.d_diaph_mm)
        pressing = np.where(gap < 0, stiffness * area[nodes], 0.0)
        blocks, pull = np.zeros((len(u), 3, 3)), load.copy()
        blocks[nodes] = pressing[:, None, None] * gradient[:, :, None] * gradient[:, None]
        bend = (pressing * np.minimum(gap, 0))[:, None, None] * hessian
        blocks[nodes] += bend
        pull[nodes] += np.einsum("nij,nj->ni", bend, u[nodes])
        along = np.einsum("nd,nd->n", gradient, u[nodes]) - gap
        pull[nodes] += (pressing * along)[:, None] * gradient
        springs = bsr_matrix((blocks, count, np.append(count, len(u)))).tocsr()
        ahead = solid(mesh, system.tissue, system.hilum, springs).solve(pull, system.hilum_displacement)
        moved = float(np.abs(ahead - u).max())
        u = u + min(1.0, 20 / max(moved, 1e-30)) * (ahead - u)
        if moved < 1e-3:
            break
    return u, steps, float(obstacle.gap(u[nodes], theta.d_diaph_mm)[0].min())


def small_hila() -> list[Row]:
    """How far the lung sags and how its worst element fares as the hilum that holds it shrinks."""
    rows = []
    for radius in (40.0, 30.0, 22.0, 18.0):
        system = _system(8_000, hilum_radius_mm=radius)
        state = solve(system, Theta(1e-9, 0.6))
        free = without_wall(system, Theta(1e-9, 0.6))[1]
        rows.append(
            {
                "hilum_radius_mm": radius,
                "hilum_nodes": len(system.hilum),
                "mean_mm_without_wall": float(np.linalg.norm(free, axis=1).mean()),
                "mean_mm": float(np.linalg.norm(state.u, axis=1).mean()),
                "min_det": float(state.det_f.min()),
                "iterations": state.iterations,
                "status": state.status.name,
            }
        )
    return rows


STUDIES: dict[str, Callable[[], list[Row]]] = {
    "pressure_bounds": pressure_bounds,
    "inverted_elements": inverted_elements,
    "towards_incompressible": towards_incompressible,
    "contact_methods": contact_methods,
    "small_hila": small_hila,
}


def stability_poro(out: Path, say: Callable[[str], None]) -> dict[str, list[Row]]:
    """Run every study, write a CSV and a plot of each and tables.md into `out`; returns the rows."""
    out.mkdir(parents=True, exist_ok=True)
    result, pages = {}, []
    for name, study in STUDIES.items():
        say(f"{name} ...")
        rows = result[name] = study()
        with (out / f"{name}.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
        pages.append(f"## {name}\n{(study.__doc__ or '').strip()}\n\n{markdown(rows)}\n")
    (out / "tables.md").write_text("\n".join(pages))
    plot(result, out)
    return result


PLOTS = {
    "pressure_bounds": ("kappa_b", ("min_pa_lumped", "min_pa_consistent")),
    "inverted_elements": ("kappa_b", ("linear_min_det", "finite_min_det")),
    "towards_incompressible": ("poisson", ("mean_mm_3000", "mean_mm_24000")),
    "small_hila": ("hilum_radius_mm", ("mean_mm_without_wall", "mean_mm")),
}


def plot(result: dict[str, list[Row]], out: Path) -> None:
    """One PNG per study in PLOTS; needs matplotlib, the extra `report`."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    for name, (x, ys) in PLOTS.items():
        figure, axes = pyplot.subplots(figsize=(6, 4))
        for y in ys:
            axes.plot([row[x] for row in result[name]], [row[y] for row in result[name]], "o", label=y)
        axes.set(xlabel=x, title=name, xscale="log" if x == "kappa_b" else "linear")
        axes.legend()
        figure.savefig(out / f"{name}.png", dpi=100)
        pyplot.close(figure)
