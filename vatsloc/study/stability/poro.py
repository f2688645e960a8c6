"""Where the poroelastic lung stops being right: pressure bounds, inverted elements, hilum, and the studies beside."""

from __future__ import annotations

import csv
import inspect
from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np

from poro.arrays import Array
from poro.collapse import Theta, solve
from poro.collapse.choice import finite_problem
from poro.collapse.finite_strain import deform
from poro.collapse.model import without_wall
from poro.fem import Flow, Tissue, neo_hookean
from poro.fem.forms import deformation_gradient
from vatsloc.study.bench.poro_lung import HILUM_CENTRE, Lung, lung, smooth_wall, system_of
from vatsloc.study.stability.poro_contact import contact_meshes, contact_methods
from vatsloc.study.stability.poro_mesh import slivers, towards_incompressible
from vatsloc.study.stability.poro_page import page
from vatsloc.study.tables import Row

TETS = 3_000
_TISSUE = Tissue()


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
    """Smallest det F and inverted share over (kappa_b, phi) and the diaphragm's rise, linear against neo-Hookean."""
    system, rows, material = system_of(lung(TETS), _TISSUE, smooth_wall()), [], neo_hookean(_TISSUE)
    phis = (0.3, 0.6, 0.9)
    values = [*product((1e-9, 1e-8, 1e-6), phis, (0.0,)), *product((1e-9,), phis, (40.0,))]
    for theta in (Theta(*value) for value in values):
        linear, finite = solve(system, theta), deform(finite_problem(system, theta, material))
        det = np.linalg.det(deformation_gradient(system.mesh, finite.u))
        total = system.mesh.volumes.sum()
        rows.append(
            {
                "kappa_b": theta.kappa_b,
                "phi": theta.phi,
                "d_diaph_mm": theta.d_diaph_mm,
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


def small_hila(tets: int = 8_000) -> list[Row]:
    """How the lung fares, without wall, gently and strongly collapsed within it, as the hilum that holds it shrinks."""
    rows, gentle, strong = [], Theta(1e-9, 0.6), Theta(1e-6, 0.3)
    body = lung(tets, hilum_radius_mm=40.0)
    boundary = body.mesh.boundary
    near = np.linalg.norm(boundary.points - HILUM_CENTRE, axis=1)
    whole = len(body.hilum)
    for count in (whole, *(fewer for fewer in (40, 20, 10, 5, 4, 3, 2) if fewer < whole)):
        held = boundary.nodes[np.argsort(near)[:count]]
        row: Row = {"hilum_nodes": count, "hilum_radius_mm": float(np.sort(near)[count - 1])}
        rows.append(row)
        try:
            system = system_of(Lung(body.mesh, held, np.zeros((count, 3))), _TISSUE, smooth_wall())
        except ValueError as refusal:
            row |= dict.fromkeys(_HELD, "-") | {"status": f"refused: {refusal}"}
            continue
        hung = without_wall(system, gentle)[1]
        det = np.linalg.det(deformation_gradient(system.mesh, hung))
        row |= {"hung_mean_mm": _mean(hung), "hung_min_det": float(det.min())}
        row |= {"hung_inverted_percent": 100 * float((det <= 0).mean())}
        states = {name: solve(system, theta) for name, theta in (("gentle", gentle), ("strong", strong))}
        for name, state in states.items():
            row |= {f"{name}_mean_mm": _mean(state.u), f"{name}_min_det": float(state.det_f.min())}
        row |= {"strong_inverted_percent": 100 * states["strong"].inverted_share}
        row |= {"status": ", ".join(state.status.name for state in states.values())}
    return rows


_HELD = (
    *("hung_mean_mm", "hung_min_det", "hung_inverted_percent"),
    *("gentle_mean_mm", "gentle_min_det", "strong_mean_mm", "strong_min_det", "strong_inverted_percent"),
)


def _mean(u: Array) -> float:
    return float(np.linalg.norm(u, axis=1).mean())


STUDIES: dict[str, Callable[[], list[Row]]] = {
    "pressure_bounds": pressure_bounds,
    "inverted_elements": inverted_elements,
    "towards_incompressible": towards_incompressible,
    "contact_methods": contact_methods,
    "contact_meshes": contact_meshes,
    "slivers": slivers,
    "small_hila": small_hila,
}


def stability_poro(out: Path, say: Callable[[str], None]) -> dict[str, list[Row]]:
    """Run every study, write a CSV and a plot of each and tables.md into `out`; returns the rows."""
    out.mkdir(parents=True, exist_ok=True)
    result = {}
    for name, study in STUDIES.items():
        say(f"{name} ...")
        rows = result[name] = study()
        with (out / f"{name}.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
    claims = {name: inspect.cleandoc(study.__doc__ or "") for name, study in STUDIES.items()}
    (out / "tables.md").write_text(page(result, claims))
    plot(result, out)
    return result


PLOTS = {
    "pressure_bounds": ("kappa_b", ("min_pa_lumped", "min_pa_consistent")),
    "inverted_elements": ("kappa_b", ("linear_min_det", "finite_min_det")),
    "towards_incompressible": ("poisson", ("rel_error_3000", "rel_error_24000")),
    "contact_meshes": ("tets", ("off_finest_mm", "penalty_off_mm")),
    "slivers": ("min_dihedral", ("factor_off_mm", "multigrid_iterations")),
    "small_hila": ("hilum_nodes", ("gentle_min_det", "strong_min_det")),
}


def plot(result: dict[str, list[Row]], out: Path) -> None:
    """One PNG per study in PLOTS; needs matplotlib, the extra `report`."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    for name, (x, ys) in PLOTS.items():
        figure, axes = pyplot.subplots(figsize=(6, 4))
        for y in ys:
            known = [row for row in result[name] if row[y] != "-"]
            axes.plot([row[x] for row in known], [row[y] for row in known], "o", label=y)
        axes.set(xlabel=x, title=name, xscale="linear" if x == "poisson" else "log")
        axes.legend()
        figure.savefig(out / f"{name}.png", dpi=100)
        pyplot.close(figure)
