"""Benchmark of the poroelastic lung: cost against size, and displacements and speed beside GetFEM's."""

from __future__ import annotations

import multiprocessing
import resource
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np

from poro.mesh.tetmesh import Array
from poro.model import PoroState, Theta, solve, solve_many, without_wall
from poro.solver import Multigrid
from poro.tissue import Tissue
from vatsloc.study.getfem_peer import getfem_python, run_getfem
from vatsloc.study.poro_lung import in_smooth_wall, lung, system_of

SIZES = (5_000, 16_000, 50_000, 160_000, 500_000)
COMPARED_TETS = 28_000
THETA = Theta(1.5e-8, 0.81, 8.0)
SWEEP = 50
_MEASURED = 3  # values of the sweep that GetFEM really solves; the rest is extrapolated from their mean
_TISSUE = Tissue()


def sweep_thetas(count: int = SWEEP) -> list[Theta]:
    """Parameter values that cover the range of a fit evenly: kappa_b 1e-10..1e-7, phi 0.65..0.92, travel 0..12 mm."""
    k = np.arange(count)
    # Additive golden-ratio sequences fill the box without a grid's repeats.
    a, b, c = ((k * step) % 1.0 for step in (0.8191725, 0.6710436, 0.5497005))
    return [Theta(10 ** (-10 + 3 * x), 0.65 + 0.27 * y, 12 * z) for x, y, z in zip(a, b, c, strict=True)]


def measure_size(tets: int) -> dict[str, Any]:
    """Seconds of set-up, of a free solution and of one with contact, and peak memory in MB of this process."""
    _warm()
    started = time.perf_counter()
    body = lung(tets)
    mesh_s = time.perf_counter() - started
    started = time.perf_counter()
    system = system_of(body, _TISSUE)
    setup_s = time.perf_counter() - started
    iterative = isinstance(system.solid.solver, Multigrid)
    started = time.perf_counter()
    if iterative:
        without_wall(system, THETA)
    else:
        solve(system, THETA)
    return {
        "tets": len(body.mesh.tets),
        "mesh_s": mesh_s,
        "setup_s": setup_s,
        "solve_s": time.perf_counter() - started,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "solver": "multigrid" if iterative else "factorization",
        "contact": not iterative,
    }


def _warm() -> None:
    """Compile the kernels and load the libraries, which no size should pay for."""
    solve(in_smooth_wall(system_of(lung(1_500), _TISSUE)), THETA)


def measure_sizes(sizes: tuple[int, ...], say: Callable[[str], None]) -> list[dict[str, Any]]:
    """`measure_size` of every size, each in a process of its own so that peaks do not add up."""
    rows = []
    for tets in sizes:
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            rows.append(pool.submit(measure_size, tets).result())
        say(f"{rows[-1]['tets']} tetrahedra: set-up {rows[-1]['setup_s']:.2f} s, solve {rows[-1]['solve_s']:.2f} s")
    return rows


def exponent(rows: list[dict[str, Any]], key: str) -> float | None:
    """Least-squares slope of log seconds against log tetrahedra, None for fewer than two sizes."""
    if len(rows) < 2:
        return None
    return float(np.polyfit(np.log([r["tets"] for r in rows]), np.log([r[key] for r in rows]), 1)[0])


def compare_getfem(tets: int, sweep: int, say: Callable[[str], None]) -> dict[str, Any] | None:
    """Largest relative differences to GetFEM and how many times faster we are; None when GetFEM is not installed.

    A single solution starts from the mesh for both. GetFEM's sweep is the mean of its measured solutions with wall
    times the number of values; ours is run.
    """
    python = getfem_python()
    if python is None:
        say("GetFEM is not installed (Debian: python3-getfem); the comparison is left out")
        return None
    _warm()
    body = lung(tets)
    started = time.perf_counter()
    system = in_smooth_wall(system_of(body, _TISSUE))
    setup_s = time.perf_counter() - started
    thetas = sweep_thetas(sweep)
    started = time.perf_counter()
    solve(system, thetas[0])
    first_s = time.perf_counter() - started
    started = time.perf_counter()
    states = solve_many(system, thetas)
    sweep_s = setup_s + first_s + time.perf_counter() - started
    say(f"ours: set-up {setup_s:.2f} s, first solution {first_s:.2f} s, {sweep} solutions {sweep_s:.2f} s with set-up")
    chosen = np.unique(np.linspace(0, sweep - 1, _MEASURED).astype(int))
    theirs = run_getfem(python, system, [thetas[k] for k in chosen])
    say(f"GetFEM: {theirs.contact_s.mean():.2f} s per solution with wall, {theirs.free_s.mean():.2f} s without")
    ours = [states[k] for k in chosen]
    free = [without_wall(system, thetas[k])[1] for k in chosen]
    their_sweep = theirs.mesh_s + sweep * float(theirs.contact_s.mean())
    return {
        "tets": len(body.mesh.tets),
        "rel_diff_free": _largest_difference(free, theirs.free),
        "rel_diff_contact": _largest_difference([s.u for s in ours], theirs.contact),
        "speedup_single": (theirs.mesh_s + float(theirs.contact_s[0])) / (setup_s + first_s),
        "speedup_sweep50": their_sweep / sweep_s,
        "ours_s": {"setup": setup_s, "first": first_s, "sweep": sweep_s},
        "getfem_s": {"mesh": theirs.mesh_s, "free": theirs.free_s.tolist(), "contact": theirs.contact_s.tolist()},
        "getfem_steps": theirs.steps.tolist(),
        "active_nodes": [_active(s) for s in ours],
        "sweep_is": f"{sweep} solutions run by us; GetFEM's estimated from {len(chosen)} measured ones",
    }


def _active(state: PoroState) -> int:
    return int(state.active.sum())


def _largest_difference(ours: list[Array], theirs: Array) -> float:
    return max(float(np.linalg.norm(a - b) / np.linalg.norm(b)) for a, b in zip(ours, theirs, strict=True))


def bench_poro(
    sizes: tuple[int, ...] = SIZES,
    compared_tets: int = COMPARED_TETS,
    sweep: int = SWEEP,
    say: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Both tables: cost against size with fitted exponents, and the comparison with GetFEM."""
    rows = measure_sizes(sizes, say)
    direct = [row for row in rows if row["contact"]]
    return {
        "sizes": rows,
        "exponents": {
            "setup": exponent(rows, "setup_s"),
            "setup_factorization": exponent(direct, "setup_s"),
            "solve_contact": exponent(direct, "solve_s"),
        },
        "getfem": compare_getfem(compared_tets, sweep, say),
    }


def table(result: dict[str, Any]) -> str:
    """The benchmark as text."""
    lines = ["tetrahedra   mesh s  set-up s  solve s  peak MB  solver         contact"]
    for r in result["sizes"]:
        lines.append(
            f"{r['tets']:10d} {r['mesh_s']:8.2f} {r['setup_s']:9.2f} {r['solve_s']:8.2f} {r['peak_mb']:8.0f}"
            f"  {r['solver']:13s}  {'yes' if r['contact'] else 'no'}"
        )
    for name, value in result["exponents"].items():
        if value is not None:
            lines.append(f"{name}: seconds ~ tetrahedra^{value:.2f}")
    g = result["getfem"]
    if g is None:
        return "\n".join([*lines, "GetFEM is not installed: no comparison."])
    ours, theirs = g["ours_s"], g["getfem_s"]
    return "\n".join(
        [
            *lines,
            f"GetFEM, {g['tets']} tetrahedra, the same wall: {g['sweep_is']}.",
            f"  displacements differ by {g['rel_diff_free']:.1e} without and {g['rel_diff_contact']:.1e} with contact",
            f"  one solution: {theirs['mesh'] + theirs['contact'][0]:.2f} s against {ours['setup'] + ours['first']:.2f}"
            f" s, {g['speedup_single']:.1f} times faster",
            f"  sweep: {g['speedup_sweep50'] * ours['sweep']:.0f} s against {ours['sweep']:.2f} s,"
            f" {g['speedup_sweep50']:.0f} times faster",
        ]
    )
