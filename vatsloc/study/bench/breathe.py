"""Benchmark of the breathing lung: each driver's error beside its paper's, the share of motion left, and seconds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

from vatsloc.breathing.case import read_breath
from vatsloc.breathing.run import DRIVERS, run_driver
from vatsloc.breathing.score import score
from vatsloc.study.bench.breath_series import bench_series, is_series, read_series, series_table

STATES = 11
"""Odd, so that a quiet breath's deepest state is one of them."""
PAPERS: dict[str, dict[str, str]] = {
    "surface": {"paper": "Li 2008", "error_mm": "about 3 (vertical, four implants)", "seconds": "1500"},
    "pressure-volume": {"paper": "Eom 2010", "error_mm": "2.0 to 4.5", "seconds": "5400 to 9900"},
    "regional-pressure": {"paper": "Fuerst", "error_mm": "6.3 (E1), 5.4 (E2)", "seconds": "54000"},
    "one-scan": {"paper": "Li & Porikli 2014", "error_mm": "3.2 to 6.2", "seconds": "115 + 34"},
}
"""Errors at the other end of quiet breaths of other people; the motion of DIR-Lab's case 7, one of them, is 11.6 mm."""
MASKS, IMAGES, LANDMARKS = "masks", "images", "E2"
"""What a driver is shown: both masks; the registration of both images as well; the landmarks that score it as well."""


def bench_breathe(
    folders: Sequence[Path], drivers: Sequence[str] = tuple(DRIVERS), say: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Rows of every case and driver, and of every series. seconds, processor_seconds: reading, meshing and driving,
    without what is written.
    """
    cases: list[dict[str, Any]] = []
    series: list[dict[str, Any]] = []
    for folder in folders:
        say(f"{folder.name} ...")
        rows, kept = (_series_rows, series) if is_series(folder) else (_rows, cases)
        for row in rows(folder, drivers):
            kept.append(row)
            left = f"{row['mean']:.2f} of {row['initial_mean']:.1f} mm left, " if "mean" in row else ""
            say(f"{row['name']}: {row['driver']} by {row['by']}: {left}{row['seconds']:.0f} s")
    return {"cases": cases, "series": series}


def table(result: dict[str, Any]) -> str:
    """The benchmark as text."""
    head = f"{'case':14s}{'driver':20s}{'by':>8s}{'motion':>8s}{'left':>8s}{'95 %':>8s}{'share':>7s}{'s':>7s}"
    lines = [f"{head}   theirs (mm; s)"] if result["cases"] else []
    for row in result["cases"]:
        ours = " " * 31
        if "mean" in row:
            ours = f"{row['initial_mean']:8.1f}{row['mean']:8.2f}{row['p95']:8.1f}{row['share_left']:7.2f}"
        theirs = row["theirs"]
        lines.append(
            f"{row['name']:14s}{row['driver']:20s}{row['by']:>8s}{ours}{row['seconds']:7.0f}   "
            f"{theirs['paper']}: {theirs['error_mm']}; {theirs['seconds']}"
        )
        if row["registration"] is not None:
            lines.append(f"{'':14s}{'  its registration':20s}{'':16s}{row['registration']['mean']:8.2f}")
    if result["series"]:
        lines += series_table(result["series"])
    return "\n".join(lines)


def _rows(folder: Path, drivers: Sequence[str]) -> Iterator[dict[str, Any]]:
    first = read_breath(folder)
    for driver in drivers:
        shown = [MASKS] if first.images is None else [MASKS, IMAGES]
        if driver == "regional-pressure" and first.landmarks is not None:
            shown.append(LANDMARKS)
        for by in shown:
            began, used = perf_counter(), process_time()
            case = replace(read_breath(folder), masks_alone=by == MASKS)
            motion = run_driver(case, driver, STATES, lambda _: None, see_landmarks=by == LANDMARKS)
            times = {"seconds": perf_counter() - began, "processor_seconds": process_time() - used}
            row = {"name": case.name, "driver": driver, "by": by, "direction": motion.direction, **times}
            found = score(motion, case.landmarks)
            if found is not None:
                row |= {**found, "share_left": found["mean"] / found["initial_mean"]}
            beside = None if motion.registered is None else score(motion.registered, case.landmarks)
            yield {**row, "registration": beside, "theirs": PAPERS[driver]}


def _series_rows(folder: Path, drivers: Sequence[str]) -> Iterator[dict[str, Any]]:
    series = read_series(folder)
    for driver in drivers:
        for by in (MASKS, IMAGES):
            began, used = perf_counter(), process_time()
            motion, found = bench_series(series, driver, by == MASKS)
            times = {"seconds": perf_counter() - began, "processor_seconds": process_time() - used}
            row = {"name": series.case.name, "driver": driver, "by": by, "direction": motion.direction}
            yield {**row, **times, **found}
