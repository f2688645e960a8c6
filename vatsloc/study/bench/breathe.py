"""Benchmark of the breathing lung: each driver's error at landmarks beside its paper's, the share of motion left."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

from vatsloc.breathing.case import read_breath
from vatsloc.breathing.run import DRIVERS, run_driver
from vatsloc.breathing.score import score

STATES = 11
"""Odd, so that a quiet breath's deepest state is one of them."""
PAPERS: dict[str, dict[str, str]] = {
    "surface": {"paper": "Li 2008", "error_mm": "about 3 (vertical, four implants)", "seconds": "1500"},
    "pressure-volume": {"paper": "Eom 2010", "error_mm": "2.0 to 4.5", "seconds": "5400 to 9900"},
    "regional-pressure": {"paper": "Fuerst", "error_mm": "6.3 (E1), 5.4 (E2)", "seconds": "54000"},
    "one-scan": {"paper": "Li & Porikli 2014", "error_mm": "3.2 to 6.2", "seconds": "115 + 34"},
}
"""Errors at the other end of quiet breaths of other people; the motion of DIR-Lab's case 7, one of them, is 11.6 mm."""


def bench_breathe(
    folders: Sequence[Path], drivers: Sequence[str] = tuple(DRIVERS), say: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Rows of every case and driver; seconds: reading, meshing and driving, without what is written."""
    rows = []
    for folder in folders:
        for driver in drivers:
            say(f"{folder.name}: {driver} ...")
            began = perf_counter()
            case = read_breath(folder)
            motion = run_driver(case, driver, STATES, lambda _: None)
            seconds = perf_counter() - began
            found = score(motion, case.landmarks)
            row = {"name": case.name, "driver": driver, "direction": motion.direction, "seconds": seconds}
            if found is not None:
                row |= {**found, "share_left": found["mean"] / found["initial_mean"]}
            rows.append({**row, "theirs": PAPERS[driver]})
    return {"cases": rows}


def table(result: dict[str, Any]) -> str:
    """The benchmark as text."""
    head = f"{'case':14s}{'driver':20s}{'motion':>8s}{'left':>8s}{'95 %':>8s}{'share':>7s}{'s':>7s}   theirs (mm; s)"
    lines = [head]
    for row in result["cases"]:
        ours = " " * 31
        if "mean" in row:
            ours = f"{row['initial_mean']:8.1f}{row['mean']:8.2f}{row['p95']:8.1f}{row['share_left']:7.2f}"
        theirs = row["theirs"]
        lines.append(
            f"{row['name']:14s}{row['driver']:20s}{ours}{row['seconds']:7.0f}   "
            f"{theirs['paper']}: {theirs['error_mm']}; {theirs['seconds']}"
        )
    return "\n".join(lines)
