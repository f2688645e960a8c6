"""Benchmark of the poroelastic lung: displacements and speed beside GetFEM's, and cost against mesh size."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from poro.arrays import Array
from poro.collapse import PoroSystem, Theta, solve
from poro.collapse.model import without_wall
from poro.fem import Tissue
from vatsloc.study.bench.cost_poro import STAGES, cost_rows, measure_sizes, warm
from vatsloc.study.bench.getfem_peer import GetfemAnswer, getfem_python, run_getfem
from vatsloc.study.bench.poro_lung import Lung, lung, smooth_wall, system_of
from vatsloc.study.bench.sweep import solve_many
from vatsloc.study.tables import Row, markdown

COMPARED_TETS = 28_000
SWEEP = 50
_MEASURED = 4  # values of the sweep that GetFEM really solves; the rest is extrapolated from their mean
_TISSUE = Tissue()
_BOUNDS = """What bounds our seconds. Cold: the factor and the compliance of the contact nodes, once per lung, dense
products near the processor's peak (9 and 65 Gflop for 1708 nodes). The lung without wall alone takes about a tenth of
GetFEM's time with it, so that no contact solver could make a cold start much more than ten times faster. Warm: a value
alone takes about seven linearizations from no contact and twice as many active sets, each a dense Cholesky factor of
the nodes in contact and a pass over their compliance, 105 MB, as fast as memory allows. In a sweep a batched active set
of the benchmark's own advances up to 48 values together, so that one pass serves them as a product of matrices; they
start between the loads solved before (about five linearizations) and keep a factor while at most 30 nodes come or go
(about two factors a value). The lung's pressures, some eight factors of the flow, are a tenth of the sweep. Exponents
leave out the multigrid row. Contact needs the factor: beyond 6,000 contact nodes or with multigrid the table stops at
the lung without wall."""

_KEYS = """In the command's JSON `getfem.speedup_single` and `getfem.speedup_sweep50` are the last table's rows "wall,
warm" and "wall, 50 values, warm": pressure, weight, hilum and contact of each new value, on a lung whose mesh, factor
and compliance are there; the keys that end in `_cold` include these too. GetFEM's rows hold the same work, of which
its model keeps nothing from one value to the next."""


def sweep_thetas(count: int = SWEEP) -> list[Theta]:
    """Parameter values that cover the range of a fit evenly: kappa_b 1e-10..1e-7, phi 0.65..0.92, travel 0..12 mm."""
    k = np.arange(count)
    # Additive golden-ratio sequences fill the box without a grid's repeats.
    a, b, c = ((k * step) % 1.0 for step in (0.8191725, 0.6710436, 0.5497005))
    return [Theta(10 ** (-10 + 3 * x), 0.65 + 0.27 * y, 12 * z) for x, y, z in zip(a, b, c, strict=True)]


def compare_getfem(tets: int, sweep: int, say: Callable[[str], None]) -> dict[str, Any] | None:
    """Differences to GetFEM and processor seconds of both; None when GetFEM is not installed.

    Cold starts from the mesh; warm is another parameter value on a lung that is set up, contact unknown. GetFEM's
    model keeps nothing from one value to the next, so its warm solution lacks only the reading of the mesh, and its
    sweep is the mean of its measured solutions times the number of values; ours is run.
    """
    python = getfem_python()
    if python is None:
        say("GetFEM is not installed (Debian: python3-getfem); the comparison is left out")
        return None
    warm()
    body, thetas = lung(tets), sweep_thetas(sweep)
    spread = np.linspace(0, sweep - 1, min(_MEASURED, sweep)).astype(int)
    chosen = np.argsort([theta.kappa_b for theta in thetas])[spread]
    system, ours = _our_seconds(body, thetas, [thetas[k] for k in chosen])
    say("ours: " + ", ".join(f"{name} {seconds:.2f} s" for name, seconds in ours.items()))
    theirs = run_getfem(python, system, [thetas[k] for k in chosen])
    say(f"GetFEM: {theirs.contact_s.mean():.2f} s per solution with wall, {theirs.free_s.mean():.2f} s without")
    values = [_compared(system, thetas[k], theirs, i) for i, k in enumerate(chosen)]
    speed = _speed(ours, theirs, sweep)
    return {
        "tets": len(body.mesh.tets),
        "contact_nodes": len(system.contact_nodes),
        "threads": os.environ.get("OPENBLAS_NUM_THREADS", str(os.cpu_count())),
        "measured": len(chosen),
        "sweep": sweep,
        "values": values,
        "rel_diff_free": max(value["without wall"] for value in values),
        "rel_diff_contact": max(value["with wall"] for value in values),
        **_factors(speed, sweep),
        "speed": speed,
    }


def _our_seconds(body: Lung, thetas: list[Theta], chosen: list[Theta]) -> tuple[PoroSystem, dict[str, float]]:
    seconds: dict[str, float] = {}

    def timed(name: str, work: Callable[[], Any]) -> Any:
        started = time.process_time()
        result = work()
        seconds[name] = time.process_time() - started
        return result

    system = timed("set-up", lambda: system_of(body, _TISSUE, smooth_wall()))
    timed("without wall, first", lambda: without_wall(system, thetas[0]))
    timed("compliance", lambda: system.compliance.groups(system.wall.rest))
    timed("with wall, first", lambda: solve(system, thetas[0]))
    # Every value is new to the lung, and contact starts from none.
    for name, work in (("without wall", without_wall), ("with wall", solve)):
        spent = []
        for theta in chosen:
            lung_set_up = replace(system)  # forgets the pressures met so far
            without_wall(lung_set_up, Theta(0.0, 0.8))
            started = time.process_time()
            work(lung_set_up, theta)
            spent.append(time.process_time() - started)
        seconds[name] = float(np.mean(spent))
    forgetful = replace(system)
    timed("sweep", lambda: solve_many(forgetful, thetas))
    return system, seconds


def _compared(system: PoroSystem, theta: Theta, theirs: GetfemAnswer, number: int) -> Row:
    state = solve(system, theta)
    return {
        "kappa_b": theta.kappa_b,
        "phi": theta.phi,
        "travel mm": theta.d_diaph_mm,
        "nodes in contact": int(state.active.sum()),
        "mean motion mm": float(np.linalg.norm(state.u, axis=1).mean()),
        "without wall": _difference(without_wall(system, theta)[1], theirs.free[number]),
        "with wall": _difference(state.u, theirs.contact[number]),
        "GetFEM s": float(theirs.contact_s[number]),
        "GetFEM steps": int(theirs.steps[number]),
    }


def _difference(ours: Array, theirs: Array) -> float:
    return float(np.linalg.norm(ours - theirs) / np.linalg.norm(theirs))


def _speed(ours: dict[str, float], theirs: GetfemAnswer, sweep: int) -> list[Row]:
    """Seconds of both programs and their ratio, cold and warm."""
    free, contact = float(theirs.free_s.mean()), float(theirs.contact_s.mean())
    whole = ours["set-up"] + ours["compliance"]
    rows = (
        ("no wall, cold", theirs.mesh_s + free, ours["set-up"] + ours["without wall, first"]),
        ("no wall, warm", free, ours["without wall"]),
        ("wall, cold", theirs.mesh_s + contact, whole + ours["without wall, first"] + ours["with wall, first"]),
        ("wall, warm", contact, ours["with wall"]),
        (f"wall, {sweep} values, cold", theirs.mesh_s + sweep * contact, whole + ours["sweep"]),
        (f"wall, {sweep} values, warm", sweep * contact, ours["sweep"]),
    )
    return [{"what": what, "GetFEM s": a, "ours s": b, "times faster": a / b} for what, a, b in rows]


def _factors(speed: list[Row], sweep: int) -> dict[str, float]:
    """How many times faster with wall, one value and the sweep: on a lung that is set up, and "_cold" from the mesh."""
    times = {row["what"]: float(row["times faster"]) for row in speed}
    many = f"wall, {sweep} values"
    return {
        "speedup_single": times["wall, warm"],
        "speedup_single_cold": times["wall, cold"],
        f"speedup_sweep{sweep}": times[f"{many}, warm"],
        f"speedup_sweep{sweep}_cold": times[f"{many}, cold"],
    }


def bench_poro(
    sizes: tuple[int, ...] = (),
    compared_tets: int = COMPARED_TETS,
    sweep: int = SWEEP,
    say: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """The comparison with GetFEM, and the cost at `sizes`."""
    return {"getfem": compare_getfem(compared_tets, sweep, say), "sizes": measure_sizes(sizes, say)}


def page(result: dict[str, Any]) -> str:
    """The benchmark as a page of the documentation."""
    lines = ["# The poroelastic lung beside GetFEM, and what it costs", ""]
    lines += ["Made by `OPENBLAS_NUM_THREADS=1 vatsloc bench poro --cost --out FILE`.", ""]
    lines += [table(result), "", _KEYS, "", _BOUNDS]
    return "\n".join(lines) + "\n"


def table(result: dict[str, Any]) -> str:
    """The benchmark as markdown."""
    g = result["getfem"]
    lines = ["GetFEM is not installed: no comparison."]
    if g is not None:
        lines = [
            f"{g['tets']} tetrahedra, {g['contact_nodes']} contact nodes, the same mesh, loads and wall, "
            f"{g['threads']} BLAS threads for both. Differences are of displacements, relative in the 2-norm; "
            "seconds are of the processor, all threads.",
            "",
            markdown(g["values"]),
            "",
            "Cold starts from the mesh; warm is one more parameter value on a lung that is set up, contact "
            f"unknown. GetFEM solved {g['measured']} of the {g['sweep']} values; its sweep is "
            f"their mean times {g['sweep']}.",
            "",
            markdown(g["speed"]),
        ]
    rows = result["sizes"]
    if rows:
        lines += ["", "Cost by stage, each size in a process of its own:", ""]
        lines += [f"- {stage}: {what}" for stage, what in STAGES.items()]
        lines += ["", "Processor seconds", "", markdown(cost_rows(rows, "seconds"))]
        lines += ["", "Peak memory of the process in MB", "", markdown(cost_rows(rows, "mb"))]
    return "\n".join(lines)
