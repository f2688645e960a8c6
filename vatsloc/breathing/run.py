"""One run of `vatsloc breathe`: read, drive, score, write. The folder appears whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

import vatsloc.breathing.one_scan as one_scan
import vatsloc.breathing.pressure_volume as pressure_volume
import vatsloc.breathing.regional_pressure as regional_pressure
import vatsloc.breathing.surface as surface
from poro.mesh.tetmesh import signed_volumes
from vatsloc.breathing.case import BreathCase, read_breath
from vatsloc.breathing.film import animated, as_png, frames
from vatsloc.breathing.images import write_images
from vatsloc.breathing.motion import Motion, along
from vatsloc.breathing.page import Strip, Table, page
from vatsloc.breathing.score import score
from vatsloc.breathing.signal import sampled
from vatsloc.errors import CaseError
from vatsloc.formats.folder import PROGRAM, whole_folder
from vatsloc.formats.meshes import TetraMesh, write_vtu

Drive = Callable[[BreathCase, int, Callable[[str], None]], Motion]
DRIVERS: Mapping[str, Drive] = {
    "pressure-volume": pressure_volume.drive,
    "regional-pressure": regional_pressure.drive,
    "one-scan": one_scan.drive,
    "surface": surface.drive,
}
"""How a breath is driven, by the name on the command line: one room's module per paper."""
RESULT, PAGE = "breath.json", "breath.html"
ARROWS = "From the front, arrows from the places in the first scan, coloured by their length in space"
STATES = (2, 200)
WAY = 11
"""States of the way between two scans, when a breath goes there and back along it."""


def breathe_case(
    folder: Path,
    out: Path,
    driver: str,
    count: int,
    say: Callable[[str], None],
    see_landmarks: bool = False,
    masks_alone: bool = False,
) -> dict[str, Any]:
    """Drive the lungs of a folder through `count` states and write them to `out`. Returns what `--json` prints.

    see_landmarks: the fit of regional pressures may see the landmarks too, and says so; masks_alone: two images, where
    there are, are not registered.
    """
    if driver not in DRIVERS:
        raise CaseError(f"{driver!r} is no driver; take {', '.join(DRIVERS)}.")
    if not STATES[0] <= count <= STATES[1]:
        raise CaseError(f"--states {count} is out of range; ask for {STATES[0]} to {STATES[1]}.")
    began = perf_counter()
    case = replace(read_breath(folder), masks_alone=masks_alone)
    with whole_folder(out, (RESULT, PAGE), is_breath) as partial:
        motion = run_driver(case, driver, count, say, see_landmarks)
        seconds = perf_counter() - began
        result = {
            "program": PROGRAM,
            "driver": driver,
            "direction": motion.direction,
            "seconds": seconds,
            "states": [
                {"volume_ml": motion.volume_ml(n), "pressure_pa": motion.pressure_pa[n]} for n in range(motion.count)
            ],
            "landmarks": score(motion, case.landmarks),
            "registration": None if motion.registered is None else score(motion.registered, case.landmarks),
            "warnings": list(motion.warnings),
            **motion.details,
        }
        write_states(partial, motion)
        views, more = write_images(partial, case, motion, say)
        result |= more
        pictures = frames(motion)
        (partial / "film.webp").write_bytes(animated(pictures))
        (partial / "arrows.png").write_bytes(as_png(pictures[motion.farthest]))
        if views:
            (partial / "coronal.webp").write_bytes(animated([np.stack([p] * 3, axis=2) for p in views[0].pictures]))
        strips = [Strip(ARROWS, pictures), *views]
        (partial / PAGE).write_text(page(case.name, result, strips, _tables(result)), encoding="utf-8")
        (partial / RESULT).write_text(json.dumps(result, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return result


def run_driver(
    case: BreathCase, driver: str, count: int, say: Callable[[str], None], see_landmarks: bool = False
) -> Motion:
    """The motion of a case by a driver's name: `count` states from scan to scan, or along the case's signal."""
    drive = DRIVERS[driver]
    if see_landmarks:
        if driver != "regional-pressure":
            raise CaseError(f"--fit-landmarks is an experiment of regional-pressure; leave it out with {driver}.")
        drive = partial(regional_pressure.drive, see_landmarks=True)
    if case.signal is None or driver == "one-scan":  # which follows a signal by itself
        return drive(case, count, say)
    t, volume = sampled(case.signal, count)
    motion = along(drive(case, WAY, say), volume)
    return replace(motion, details={**motion.details, "time_s": t.tolist(), "signal": volume.tolist()})


def is_breath(folder: Path) -> bool:
    """Whether a folder holds a result of `breathe`."""
    try:
        told = json.loads((folder / RESULT).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(told, dict) and told.get("program") == PROGRAM


def write_states(folder: Path, motion: Motion) -> None:
    """motion_NNN.vtu: all lungs in one file, LPS mm, with the displacement from the first scan and det F."""
    start, tets = motion.whole_mesh(0)
    start = np.concatenate([lung.mesh.points for lung in motion.lungs])
    lung_number = np.repeat(np.arange(len(motion.lungs)), [len(lung.mesh.tets) for lung in motion.lungs])
    before = np.concatenate([lung.mesh.volumes for lung in motion.lungs])
    for n in range(motion.count):
        points, _ = motion.whole_mesh(n)
        after = signed_volumes(points, tets)
        cells = {"det_f": after / before, "lung": lung_number.astype(np.int32)}
        write_vtu(folder / f"motion_{n:03d}.vtu", TetraMesh(points, tets, {"displacement": points - start}, cells))


def _tables(result: Mapping[str, Any]) -> list[Table]:
    told = result.get("tables", [])
    return [Table(t["title"], t["head"], [[str(cell) for cell in row] for row in t["rows"]]) for t in told]
