"""Where the collapse's fit stops being right, and whether a run knows: disturbed inputs, starts, identifiability."""

from __future__ import annotations

import csv
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from poro.collapse import PoroSystem, assemble
from poro.fem import Tissue
from poro.fit import FitStatus, Target, fit_collapse
from poro.fit import identifiability as identifiability_of
from poro.fit.identifiability import THETA_NAMES
from poro.fit.problem import bounds
from registration.maps.rigid import RigidTransform
from registration.volume import Array
from vatsloc.case import Case, read_case
from vatsloc.errors import VatslocError
from vatsloc.evaluation.inputs import Truth, read_truth
from vatsloc.study.chart.draw import require_matplotlib
from vatsloc.study.cohort.cohort import SILENT_MM
from vatsloc.study.stability.fit_draw import draw_disturbed
from vatsloc.study.tables import Row, markdown
from vatsloc.workflow.localization import Localization, checked, locate_nodule
from vatsloc.workflow.model_selection import fit_settings, surface_target
from vatsloc.workflow.observe import Observed, observe
from vatsloc.workflow.pneumothorax import collapse
from vatsloc.workflow.pose import ChangeOfPose, change_of_pose
from vatsloc.workflow.prepare import Prepared, prepare
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import Say, Stages, quiet

VERTEBRA_MM = 22.0
STARTS = 50


@dataclass(frozen=True)
class Scene:
    """A case up to its observations, its truth, and the settings it is run with."""

    settings: Settings
    case: Case
    truth: Truth
    prepared: Prepared
    pose: ChangeOfPose
    observed: Observed


Disturb = Callable[[Scene, np.random.Generator], Scene]


def stability_fit(cases: Sequence[Path], out: Path, settings: Settings, say: Say = quiet) -> None:
    """Write disturbed.csv and .png, starts.csv, identifiability.csv and tables.md to `out`, anew after every case.

    Raises CaseError as reading does, and without matplotlib.
    """
    require_matplotlib()
    tables: dict[str, list[Row]] = {"disturbed": [], "starts": [], "identifiability": []}
    for folder in cases:
        scene = read_scene(folder, settings)
        out.mkdir(parents=True, exist_ok=True)
        name = folder.resolve().name
        for what, disturb in DISTURBANCES.items():
            row = {"case": name, "disturbed": what} | disturbed(scene, disturb)
            tables["disturbed"].append(row)
            say(f"{name}: {what}: {row['landmarks_mm']} mm, {row['flagged'] or 'not flagged'}")
        system, target = _problem(scene)
        tables["starts"].append({"case": name} | random_starts(system, target, settings))
        tables["identifiability"] += [{"case": name} | row for row in identifiability(system, target, settings)]
        say(f"{name}: {STARTS} starts done")
        draw_disturbed(tables["disturbed"], SILENT_MM, out / "disturbed.png")
        for title, rows in tables.items():
            _write_csv(out / f"{title}.csv", rows)
        (out / "tables.md").write_text(page(tables), encoding="utf-8")


def disturbed(scene: Scene, disturb: Disturb) -> Row:
    """Errors in mm of a run on disturbed observations, its failed gates, and whether it failed without a word."""
    try:
        wrong = disturb(scene, np.random.default_rng(0))
        stages = Stages()
        found = collapse(wrong.case, wrong.prepared, wrong.pose, wrong.observed, scene.settings, stages)
        answer = locate_nodule(wrong.case, wrong.prepared, wrong.pose, found, scene.settings, stages)
        answer = checked(wrong.case, answer, scene.settings, stages)
    except VatslocError as error:
        return {"landmarks_mm": "", "nodule_mm": "", "flagged": type(error).__name__, "silent": False}
    mean, off = errors_mm(answer, scene.truth)
    flagged = [name for name, gate in answer.gates.items() if not gate.ok]
    silent = not flagged and max(mean, off or 0.0) > SILENT_MM
    return {
        "landmarks_mm": round(mean, 2),
        "nodule_mm": "" if off is None else round(off, 2),
        "flagged": ", ".join(flagged),
        "silent": silent,
    }


def errors_mm(answer: Localization, truth: Truth) -> tuple[float, float | None]:
    """Errors in mm of the chain, at landmarks on average and at the nodule; None where that is not known."""
    known, nodule = truth.landmarks, truth.nodule.nodule_deflated_ras
    mean = float(np.nanmean(np.linalg.norm(answer.def_from_ct(known.ct) - known.deflated, axis=1)))
    return mean, None if nodule is None else float(np.linalg.norm(answer.nodule_def - nodule))


def random_starts(system: PoroSystem, target: Target, settings: Settings, count: int = STARTS) -> Row:
    """How many fits from random starts over the whole box end within 2 % of the best cost, how far apart those leave
    the lung, how many ended elsewhere without a word (settled, by their own account), and seconds of a core for one.
    """
    rng = np.random.default_rng(1)
    low, high = (b[:3] for b in bounds(system))
    fits, began = [], time.process_time()
    for _ in range(count):
        x = rng.uniform(low, high)
        fits.append(fit_collapse(system, target, replace(fit_settings(settings), starts=((10 ** x[0], x[1], x[2]),))))
    costs = np.array([float(found.costs[0]) for found in fits])
    good = costs < 1.02 * costs.min()
    best = fits[int(np.argmin(costs))].state.u
    apart = [float(np.linalg.norm(fits[k].state.u - best, axis=1).max()) for k in np.flatnonzero(good)]
    elsewhere = [found for found, ok in zip(fits, good, strict=True) if not ok]
    return {
        "starts": count,
        "at the best cost": int(good.sum()),
        "farthest apart there, mm": round(max(apart), 2),
        "elsewhere, said to be settled": sum(found.status is FitStatus.CONVERGED for found in elsewhere),
        "default start over the best cost, %": round(
            100 * (float(fit_collapse(system, target, fit_settings(settings)).costs[0]) / costs.min() - 1), 1
        ),
        "core seconds a start": round((time.process_time() - began) / count, 1),
    }


def identifiability(system: PoroSystem, target: Target, settings: Settings) -> list[Row]:
    """Each parameter: estimate, standard deviation, strongest correlation, and the profile: by how many per cent the
    cost rises when it is held off by a tenth of its range and the others are fitted again.
    """
    chosen = fit_settings(settings)
    best = fit_collapse(system, target, chosen)
    known = identifiability_of(best, system)
    others = known.correlation - np.eye(len(known.names))
    low, high = (b[:3] for b in bounds(system))
    theta, rows = best.theta.vector()[:3], []
    for row, name in enumerate(known.names):
        k = THETA_NAMES.index(name)
        rises = []
        for sign in (-1, 1):
            x = theta.copy()
            x[k] = np.clip(x[k] + sign * 0.1 * (high[k] - low[k]), low[k], high[k])
            free = tuple(bool(i != k and chosen.free is not None and chosen.free[i]) for i in range(3))
            held = fit_collapse(system, target, replace(chosen, free=free, starts=((10 ** x[0], x[1], x[2]),)))
            rises.append(round(100 * (float(held.costs[0]) / float(best.costs[0]) - 1), 1))
        rows.append(
            {
                "parameter": name,
                "estimate": float(theta[k]),
                "sigma": float(known.sigma[row]),
                "strongest correlation": float(others[row][np.argmax(np.abs(others[row]))]),
                "cost rise below, %": rises[0],
                "cost rise above, %": rises[1],
                "singular value": float(known.singular[row]),
            }
        )
    return rows


def page(tables: dict[str, list[Row]]) -> str:
    """The tables as one markdown page, and the share of silent failures."""
    silent = [bool(row["silent"]) for row in tables["disturbed"]]
    intro = (
        "Made by `vatsloc stability fit CASES --out DIR`. Errors of the whole chain in mm, landmarks on average and "
        f"nodule; a silent failure is one of them beyond {SILENT_MM:g} mm with every gate passed: "
        f"**{sum(silent)} of {len(silent)}**."
    )
    picture = "![Errors by disturbance; hollow: flagged by a gate.](disturbed.png)"
    parts = ["# Where the fit of the collapse stops being right", intro, picture, markdown(tables["disturbed"])]
    if tables["starts"]:
        parts += ["## Fits to the surface from random starts over the whole box", markdown(tables["starts"])]
        parts += ["## What the visible surface tells about each parameter", markdown(tables["identifiability"])]
    return "\n\n".join(parts) + "\n"


def read_scene(folder: Path, settings: Settings) -> Scene:
    """A case folder with its truth, run up to its observations."""
    case, stages = read_case(folder), Stages()
    prepared = prepare(case, stages)
    pose = change_of_pose(case, prepared, settings, stages)
    return Scene(settings, case, read_truth(folder), prepared, pose, observe(case, prepared, pose, settings, stages))


def _problem(scene: Scene) -> tuple[PoroSystem, Target]:
    seen = scene.observed
    motion = seen.motion.displacement
    system = assemble(seen.model_mesh, Tissue(), scene.case.gravity_ras, seen.hilum_nodes, motion)
    return system, surface_target(seen.surface)


def _write_csv(path: Path, rows: list[Row]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def _noisy(sigma_mm: float) -> Disturb:
    """Surface points off along their normals."""

    def disturb(scene: Scene, rng: np.random.Generator) -> Scene:
        surface = scene.observed.surface
        points = surface.points + sigma_mm * rng.normal(size=(len(surface), 1)) * surface.normals
        return _with(scene, surface=replace(surface, points=points))

    return disturb


def _missing(share: float) -> Disturb:
    """No surface on one side of a plane across the lung."""

    def disturb(scene: Scene, rng: np.random.Generator) -> Scene:
        surface = scene.observed.surface
        along = surface.points @ direction(rng)
        keep = along >= np.quantile(along, share)
        parts = (surface.points, surface.normals, surface.confidence, surface.border)
        return _with(scene, surface=type(surface)(*(part[keep] for part in parts)))

    return disturb


def _tilted_gravity(degrees: float) -> Disturb:
    def disturb(scene: Scene, rng: np.random.Generator) -> Scene:
        gravity = scene.case.gravity_ras
        axis = np.cross(gravity, direction(rng))
        turn = RigidTransform.about(np.zeros(3), np.radians(degrees) * axis / np.linalg.norm(axis), np.zeros(3))
        return replace(scene, case=replace(scene.case, gravity_ras=turn(gravity[None])[0]))

    return disturb


def _hilum_off(mm: float) -> Disturb:
    def disturb(scene: Scene, rng: np.random.Generator) -> Scene:
        motion = scene.observed.motion
        return _with(scene, motion=replace(motion, displacement=motion.displacement + mm * direction(rng)))

    return disturb


def slipped_spine(scene: Scene, _rng: np.random.Generator) -> Scene:
    """The collapse's spine registered one vertebra too high; everything after it is observed again."""
    rigid = scene.observed.rigid
    slip = RigidTransform.about(np.zeros(3), np.zeros(3), np.array([0.0, 0.0, VERTEBRA_MM]))
    wrong = replace(rigid, moving_from_fixed=slip @ rigid.moving_from_fixed)
    seen = observe(scene.case, scene.prepared, scene.pose, scene.settings, Stages(), wrong)
    return replace(scene, observed=seen)


def _with(scene: Scene, **changes: object) -> Scene:
    return replace(scene, observed=replace(scene.observed, **changes))  # type: ignore[arg-type]


def direction(rng: np.random.Generator) -> Array:
    """A random direction (3,)."""
    x = rng.normal(size=3)
    return np.asarray(x / np.linalg.norm(x))


DISTURBANCES: dict[str, Disturb] = {
    "nothing": lambda scene, _rng: scene,
    "surface noise 2 mm": _noisy(2.0),
    "surface noise 5 mm": _noisy(5.0),
    "surface 40 % missing": _missing(0.4),
    "surface 80 % missing": _missing(0.8),
    "gravity off 30 degrees": _tilted_gravity(30.0),
    "hilum off 10 mm": _hilum_off(10.0),
    "spine off one vertebra": slipped_spine,
}
