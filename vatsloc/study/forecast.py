"""Calibrates the forecast of a collapse (vatsloc/workflow/forecast.py) by phantoms that are moved, but never imaged.

Their persons and collapses are drawn anew, over the ranges of the suite's; the suite itself takes no part. Scanned
chests may join them, collapsed by the same physics.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from phantoms.recipes import SPECS, SUITE
from phantoms.spec import Collapse, PhantomSpec
from phantoms.states import make_states
from phantoms.thorax import draw_thorax
from phantoms.twin import Scan, twin_base
from registration.volume import Array
from vatsloc.evaluation.ellipsoid import in_ellipsoid
from vatsloc.formats.casefile import PleuralGas
from vatsloc.formats.folder import write_whole
from vatsloc.frames import Side
from vatsloc.synthetic import read_scan
from vatsloc.workflow.forecast import calibrated_motions, forecast
from vatsloc.workflow.pose import as_side
from vatsloc.workflow.stages import Say, quiet

FIRST_SEED, SCAN_SEEDS = 3000, 100
"""Seeds of the suite and of what tests and studies draw lie below; each scan's begin so many after those before."""
EVERY_CO2 = 3
"""One person in so many is insufflated with carbon dioxide."""
ELEMENT_MM = 18.0
TISSUE = 300
"""About how many points of a lung are forecast besides the nodule."""


def drawn_spec(seed: int) -> PhantomSpec:
    """A person's operation: every value drawn between the extremes of the suite's."""
    rng = np.random.default_rng([seed, 21])
    co2 = seed % EVERY_CO2 == 0
    collapse = Collapse(
        inflated=rng.uniform(0.82, 0.91),
        deflated=rng.uniform(0.25, 0.64),
        dome_rise=rng.uniform(-16.0, -12.0) if co2 else rng.uniform(3.0, 14.0),
        shift=rng.uniform(7.0, 38.0),
        gas="co2" if co2 else "air",
        patchiness=rng.uniform(0.3, 1.0),
        lobes_apart=rng.uniform(0.0, 0.3),
    )
    side, habitus = rng.choice(["right", "left"]), rng.choice(["average", "average", "obese"])
    return PhantomSpec(
        f"forecast {seed}", str(side), str(habitus), element=ELEMENT_MM, fused=rng.uniform(0, 1), collapse=collapse
    )


def moved(seed: int, scan: tuple[Scan, Side] | None = None) -> dict[str, Any]:
    """One person's row: gas, anatomy, and the best affine motion of the lung about its middle to either state against
    the spine, with R counted towards the operated side; what is left over as a covariance, mm2. scan: whose lung, and
    which, that of a drawn person where it is None.
    """
    spec = drawn_spec(seed)
    if scan is None:
        patient = draw_thorax(spec.side, spec.habitus, spec.lesion, seed, spec.fused).patient
    else:
        spec = replace(spec, side=scan[1], fused=1.0)
        patient = twin_base(scan[0], spec, seed, np.random.default_rng([seed, 12])).patient
    states, _, _ = make_states(patient, spec, np.random.default_rng([seed, 11]))
    mirror = np.array([1.0 if spec.side == "right" else -1.0, 1, 1])
    ct = states[0].samples[patient.lung.sample(states[0].samples) < 0]
    about = (ct - ct.mean(axis=0)) * mirror
    row: dict[str, Any] = {"seed": seed, "anatomy": "drawn" if scan is None else "scan", "gas": spec.collapse.gas}
    for name, state in zip(("inflated", "deflated"), states, strict=True):
        row[name] = affine_motion(about, (state.lung_map(ct) - ct) * mirror)
    return row


def affine_motion(about: Array, motion: Array) -> dict[str, Any]:
    """The affine map nearest to the motion (n, 3) of points (n, 3) about their middle, and what it leaves over."""
    terms = np.column_stack([np.ones(len(about)), about])
    best = np.linalg.lstsq(terms, motion, rcond=None)[0]
    left = motion - terms @ best
    return {"shift": best[0].tolist(), "gradient": best[1:].T.tolist(), "left": (left.T @ left / len(left)).tolist()}


def calibrate(out: Path, persons: int, scans: dict[Side, list[Path]], say: Say = quiet) -> None:
    """Write the rows of so many drawn persons, and of so many collapses of each scanned chest, to a JSON file; those
    that it holds are not made again. scans: the CTs, by the side of the lung to collapse.

    Raises InputRefused where a scan does not show what is needed.
    """
    rows = json.loads(out.read_text(encoding="utf-8")) if out.exists() else []
    made = {row["seed"] for row in rows}
    given: list[tuple[Path, Side] | None] = [None, *((ct, side) for side, cts in scans.items() for ct in cts)]
    for number, chest in enumerate(given):
        first = FIRST_SEED + number * SCAN_SEEDS
        seeds = [seed for seed in range(first, first + persons) if seed not in made]
        scan = (read_scan(*chest), chest[1]) if chest is not None and seeds else None
        for seed in seeds:
            say(f"person {seed} ...")
            rows.append(moved(seed, scan))
            write_whole(out, "[\n" + ",\n".join(json.dumps(_rounded(row)) for row in rows) + "\n]\n")


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_rounded(item) for item in value]
    return round(value, 5) if isinstance(value, float) else value


def bench_forecast(out: Path, names: list[str], say: Say = quiet) -> dict[str, Any]:
    """Forecasts of the suite's nodules beside where its phantoms' physics take them; rows that `out` holds are kept."""
    rows = json.loads(out.read_text(encoding="utf-8")) if out.exists() else []
    for name in names or [name for name in SUITE if not SPECS[name].refused]:
        if all(row["name"] != name for row in rows):
            say(f"phantom {name} ...")
            rows.append(scored(SPECS[name], SUITE[name]))
            write_whole(out, json.dumps(_rounded(rows), indent=1) + "\n")
    errors = [row["nodule_mm"] for row in rows]
    return {
        "cases": rows,
        "nodule_mean_mm": float(np.mean(errors)),
        "nodule_max_mm": float(np.max(errors)),
        "in_ellipsoid95": float(np.mean([row["in_ellipsoid95"] for row in rows])),
        "tissue_in_ellipsoid95": float(np.mean([row["tissue_in_ellipsoid95"] for row in rows])),
    }


def scored(spec: PhantomSpec, seed: int) -> dict[str, Any]:
    """One phantom's row: how far the nodule moves against the spine, how far off its forecast is, and whether the
    ellipsoids hold it and how much of the tissue about the lung.
    """
    patient = draw_thorax(spec.side, spec.habitus, spec.lesion, seed, spec.fused).patient
    states, _, _ = make_states(patient, spec, np.random.default_rng([seed, 11]))
    lung = states[1].samples[patient.lung.sample(states[1].samples) < 0]
    points = np.concatenate([patient.nodule.centre[None], lung[:: max(len(lung) // TISSUE, 1)]])
    there, motions = states[1].lung_map(points), calibrated_motions("deflated")
    side = as_side(spec.side)
    gas: PleuralGas = "co2" if spec.collapse.gas == "co2" else "air"
    found = [forecast(point, lung.mean(axis=0), side, motions, gas) for point in points]
    held = [in_ellipsoid(t - f.centre, f.semi_axes_mm, f.axes) for t, f in zip(there, found, strict=True)]
    return {
        "name": spec.name,
        "moves_mm": float(np.linalg.norm(there[0] - points[0])),
        "nodule_mm": float(np.linalg.norm(there[0] - found[0].centre)),
        "semi_axes_mm": found[0].semi_axes_mm.tolist(),
        "in_ellipsoid95": bool(held[0]),
        "tissue_in_ellipsoid95": sum(map(bool, held[1:])) / (len(held) - 1),
    }


def table(result: dict[str, Any]) -> str:
    """The rows as lines for people."""
    lines = [f"{'phantom':<22}{'moves':>8}{'off, mm':>9}{'longest':>9}  held"]
    for row in result["cases"]:
        held = "yes" if row["in_ellipsoid95"] else "no"
        lines.append(
            f"{row['name']:<22}{row['moves_mm']:>8.1f}{row['nodule_mm']:>9.1f}{row['semi_axes_mm'][0]:>9.1f}  {held}"
        )
    lines.append(f"mean {result['nodule_mean_mm']:.1f} mm, held {100 * result['in_ellipsoid95']:.0f} %")
    return "\n".join(lines)
