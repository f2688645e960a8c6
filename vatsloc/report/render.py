"""report.html from what a run knows: one file without a single outside address in it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from registration.volume import Array, Grid
from vatsloc.frames import flip_points
from vatsloc.report.charts import bars, box_plot
from vatsloc.report.data import (
    LUNG,
    MESH,
    NODULE,
    SURFACE,
    WINDOW_HU,
    Comparison,
    Nodule,
    Picture,
    ReportData,
    TreSection,
)
from vatsloc.report.landmarks import moved_by
from vatsloc.report.paint import as_bgr, draw_nodule, draw_outline, green_magenta, grey, jpeg
from vatsloc.report.planes import AXES, EDGE_LETTERS, Plane, box_of, plane_through, sample
from vatsloc.report.stack import stacks
from vatsloc.report.view3d import scene
from vatsloc.report.words import WORDS

STILL_PIXELS = 480
PAPER_WARNINGS = 4
"""How many warnings are printed; `report.css` hides the others on paper, so that two pages do."""

SCORES_FROM, SCORES_TO = "<!-- scores: evaluate writes here -->", "<!-- end of scores -->"

MEASURE_NAMES = {
    "rigid_ct_inflated": WORDS["rigid_ct_inflated"],
    "phase1": WORDS["score_phase1"],
    "rigid_ct_deflated": WORDS["rigid_ct_deflated"],
    "rigid_inflated_deflated": WORDS["rigid_inflated_deflated"],
    "phase2": WORDS["score_phase2"],
    "chain": WORDS["score_chain"],
}

# Keys of run.json that have a place of their own on the page; whatever else a run recorded is listed at its end.
_SHOWN = {
    "status",
    "nodule_lps",
    "nodule_ellipsoid95_mm",
    "theta",
    "seconds",
    "peak_mb",
    "peak_mb_by_stage",
    "skipped",
    "choices",
    "solid",
    "gates",
    "warnings",
}


@dataclass(frozen=True)
class View:
    """One picture of the page. src: data URI; edges: letters at left, top, right, bottom; aspect: width / height."""

    src: str
    alt: str
    edges: str
    plane: str
    aspect: float


def render(data: ReportData) -> str:
    """The whole page as text."""
    viewer = stacks(data.phases[-1], data.window_hu) if data.phases else []
    level, verdict = judge(data.run)
    gates = data.run.get("gates", {})
    seconds = data.run.get("seconds", {})
    stages = {name: float(s) for name, s in seconds.items() if name != "total"}
    chosen = {choice["part"] for choice in data.run.get("choices", ())}
    memory = data.run.get("peak_mb_by_stage") or {WORDS["whole_run"]: data.run.get("peak_mb")}
    memory = {name: float(mb) for name, mb in memory.items() if mb is not None}
    return _page("report.html").render(
        data=data,
        run=data.run,
        level=level,
        verdict=verdict,
        failed=[(name, gate) for name, gate in gates.items() if not gate["ok"]],
        passed=[(name, gate) for name, gate in gates.items() if gate["ok"]],
        nodule_ras=data.nodule.centre_ras,
        nodule_lps=flip_points(data.nodule.centre_ras),
        nearest_lps=None if data.nearest_surface_ras is None else flip_points(data.nearest_surface_ras),
        semi_axes=_semi_axes(data),
        viewer=viewer,
        scene_json=_script_json(scene(data, viewer)),
        moved=None if data.motion is None else moved_by(data.motion.nodule_before, data.nodule.centre_ras),
        mark=next((mark for mark in data.landmarks if mark.visible), None),
        phases=[(phase, _before_after(phase, data.window_hu)) for phase in data.phases],
        pictures=[(picture, _views(picture, data.window_hu)) for picture in data.pictures],
        seconds_chart=bars(stages, "s", WORDS["seconds_alt"]) if stages else None,
        memory_chart=bars(memory, "MB", WORDS["memory_alt"]) if memory else None,
        rest={k: json.dumps(v, indent=1, default=str) for k, v in data.run.items() if k not in _SHOWN},
        skipped={name: why for name, why in data.run.get("skipped", {}).items() if name not in chosen},
        colours={"nodule": NODULE, "lung": LUNG, "wall": MESH, "inflated": SURFACE},
        paper_warnings=PAPER_WARNINGS,
        scores_from=Markup(SCORES_FROM),
        scores_to=Markup(SCORES_TO),
    )


def write_forecast(path: Path, name: str, told: Mapping[str, Any], picture: Picture, nodule: Nodule) -> None:
    """Write the page of a forecast (UTF-8). told: what foresee.json holds; picture: the CT with the lung."""
    page = _page("forecast.html").render(
        level="warn",
        verdict=WORDS["forecast_verdict"],
        name=name,
        told=told,
        picture=picture,
        colour=NODULE,
        views=_views(picture, WINDOW_HU, nodule),
    )
    path.write_text(page, encoding="utf-8")


def with_scores(page: str, scores: TreSection) -> str:
    """A rendered page with its scores filled in, or filled in anew. Raises ValueError when it has no place for them."""
    head, found, rest = page.partition(SCORES_FROM)
    _, ended, tail = rest.partition(SCORES_TO)
    if not (found and ended):
        raise ValueError("this report.html has no place for scores; run localize again to write a new one")
    body = _page("scores.html").render(
        summary=scores.summary,
        names=MEASURE_NAMES,
        chart=box_plot({MEASURE_NAMES[m]: scores.errors_mm[m] for m in MEASURE_NAMES}, WORDS["tre_alt"]),
    )
    return f"{head}{SCORES_FROM}\n{body}\n{SCORES_TO}{tail}"


def judge(run: Mapping[str, Any]) -> tuple[str, str]:
    """Level ("ok", "warn" or "fail") and sentence of the banner: failed gates outweigh warnings."""
    failed = [name for name, gate in run.get("gates", {}).items() if not gate["ok"]]
    n_warnings = len(run.get("warnings", []))
    if failed:
        names = ", ".join(name.replace("_", " ") for name in failed)
        return "fail", WORDS["verdict_fail"].format(failed=len(failed), n=len(run["gates"]), names=names)
    if n_warnings:
        return "warn", WORDS["verdict_warning" if n_warnings == 1 else "verdict_warnings"].format(n=n_warnings)
    return "ok", WORDS["verdict_ok"]


def _before_after(phase: Comparison, window: tuple[float, float]) -> list[tuple[str, list[View]]]:
    """Blends before and after, in three planes each, with a heading."""
    rows: list[tuple[str, list[View]]] = [
        (WORDS["before"].format(image=phase.before_name), []),
        (WORDS["after"].format(image=phase.after_name), []),
    ]
    for plane in _planes(phase.fixed.grid, phase.nodule.centre_ras):
        below = grey(sample(phase.fixed, plane), window)
        first = green_magenta(grey(sample(phase.before, plane, phase.before_from_fixed), window), below)
        second = green_magenta(grey(sample(phase.after, plane), window), below)
        for outline in phase.outlines:
            draw_outline(second, plane, outline)
        for image, (heading, views) in zip((first, second), rows, strict=True):
            draw_nodule(image, plane, phase.nodule)
            alt = WORDS["blend_alt"].format(
                title=phase.title, heading=heading, plane=WORDS[plane.name], image=phase.fixed_name
            )
            views.append(_view(image, alt, plane))
    return rows


def _views(picture: Picture, window: tuple[float, float], nodule: Nodule | None = None) -> list[View]:
    views = []
    for plane in _planes(picture.image.grid, picture.at_ras):
        image = as_bgr(grey(sample(picture.image, plane), window))
        for outline in picture.outlines:
            draw_outline(image, plane, outline)
        if nodule is not None:
            draw_nodule(image, plane, nodule)
        views.append(_view(image, WORDS["picture_alt"].format(title=picture.title, plane=WORDS[plane.name]), plane))
    return views


def _view(image: Array, alt: str, plane: Plane) -> View:
    return View(jpeg(image, 86), alt, EDGE_LETTERS[plane.name], plane.name, plane.shape[1] / plane.shape[0])


def _planes(grid: Grid, at_ras: Array) -> list[Plane]:
    """Three planes through a point; pixels finer than voxels keep drawn lines crisp."""
    box = box_of(grid)
    spacing = max(float((box[1] - box[0]).max()) / STILL_PIXELS, 0.5)
    return [plane_through(name, at_ras, box, spacing) for name in AXES]


def _semi_axes(data: ReportData) -> list[float] | None:
    """Semi-axes in mm, longest first, whether or not their directions are known."""
    if data.nodule.ellipsoid is not None:
        return sorted(np.linalg.norm(data.nodule.ellipsoid, axis=1).tolist(), reverse=True)
    lengths = data.run.get("nodule_ellipsoid95_mm")
    return None if lengths is None or None in lengths else sorted(lengths, reverse=True)


def _script_json(value: Any) -> Markup:
    """JSON that may stand inside a script element."""
    return Markup(json.dumps(value, separators=(",", ":")).replace("<", "\\u003c"))


def _page(name: str) -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("vatsloc.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["w"] = WORDS
    return environment.get_template(name)
