"""What the poroelastic lung costs against the number of tetrahedra, stage by stage."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from poro.collapse import Theta, solve
from poro.collapse.model import without_wall
from poro.fem import Tissue
from poro.linalg import Multigrid
from vatsloc.study.bench.isolated import isolated
from vatsloc.study.bench.poro_lung import lung, smooth_wall, system_of
from vatsloc.study.tables import Row
from vatsloc.workflow.stages import Stages

SIZES = (5_000, 16_000, 50_000, 160_000, 500_000)
THETA = Theta(1.5e-8, 0.81, 8.0)
NEXT = Theta(2.5e-8, 0.84, 6.0)
STAGES = {
    "mesh": "surface and tetrahedra from the signed distance",
    "factorization": "stiffness, its factor or multigrid hierarchy, wall, diaphragm",
    "without wall": "pressure, weight and hilum, the first parameter value",
    "compliance": "displacements of the contact nodes under forces at them, needed once",
    "contact": "the first solution with wall, once the compliance is known",
    "next value": "another kappa_b, phi and travel, started from that solution",
}
MOST_CONTACT_NODES = 6_000  # 1.3 GB of compliance


def warm() -> None:
    """Compile the kernels and load the libraries, which no size should pay for."""
    for tets in (1_500, 16_000):  # contact in double and in single precision
        solve(system_of(lung(tets), Tissue(), smooth_wall()), THETA)


def measure_size(tets: int) -> Row:
    """Processor seconds and peak MB of every stage for a lung of about `tets` tetrahedra, in this process."""
    warm()
    tissue, stages = Tissue(), Stages()
    with stages.stage("mesh"):
        body = lung(tets)
    with stages.stage("factorization"):
        system = system_of(body, tissue, smooth_wall())
    with stages.stage("without wall"):
        without_wall(system, THETA)
    iterative = isinstance(system.solid.solver, Multigrid)
    if not iterative and len(system.contact_nodes) <= MOST_CONTACT_NODES:
        with stages.stage("compliance"):
            system.compliance.groups(system.wall.rest)
        with stages.stage("contact"):
            first = solve(system, THETA)
        with stages.stage("next value"):
            solve(system, NEXT, first)
    return {
        "tets": len(body.mesh.tets),
        "contact_nodes": len(system.contact_nodes),
        "solver": "multigrid" if iterative else "factor",
        "seconds": dict(stages.cpu_seconds),
        "mb": dict(stages.peak_mb),
    }


def measure_sizes(sizes: tuple[int, ...], say: Callable[[str], None]) -> list[Row]:
    """`measure_size` of every size, each in a process of its own so that peaks do not add up."""
    rows = []
    for tets in sizes:
        rows.append(isolated(measure_size, tets))
        told = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in rows[-1]["seconds"].items())
        say(f"{rows[-1]['tets']} tetrahedra: {told}")
    return rows


def exponent(rows: list[Row], kind: str, stage: str) -> float | None:
    """Least-squares slope of log seconds or MB (`kind`) of a stage against log tetrahedra, over the sizes that are
    factored; None below two.
    """
    factored = [row for row in rows if row["solver"] == "factor"]
    pairs = [(row["tets"], row[kind][stage]) for row in factored if row[kind].get(stage, 0) > 0]
    if len(pairs) < 2:
        return None
    tets, values = np.array(pairs).T
    return float(np.polyfit(np.log(tets), np.log(values), 1)[0])


def cost_rows(rows: list[Row], kind: str) -> list[Row]:
    """One line per size and one of exponents, for a table of seconds or MB."""
    lines: list[Row] = []
    for row in rows:
        head = {"tetrahedra": row["tets"], "contact nodes": row["contact_nodes"], "solver": row["solver"]}
        lines.append(head | {stage: row[kind].get(stage, "-") for stage in STAGES})
    slopes = {stage: exponent(rows, kind, stage) for stage in STAGES}
    told = {stage: "-" if slope is None else f"{slope:.2f}" for stage, slope in slopes.items()}
    return [*lines, {"tetrahedra": "exponent", "contact nodes": "", "solver": ""} | told]
