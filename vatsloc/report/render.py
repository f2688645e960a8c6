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

from registration.volume import Array
from vatsloc.frames import flip_points
from vatsloc.report.charts import bars, box_plot
from vatsloc.report.data import NODULE, Comparison, Nodule, Outline, Picture, ReportData, TreSection
from vatsloc.report.paint import as_bgr, draw_nodule, draw_outline, green_magenta, grey, jpeg
from vatsloc.report.planes import AXES, EDGE_LETTERS, box_of, plane_through, ready, sample
from vatsloc.report.stack import stacks

SCORES_FROM, SCORES_TO = "<!-- scores: evaluate writes here -->", "<!-- end of scores -->"

MEASURE_NAMES = {
    "rigid_ct_inflated": "rigid: CT to inflated",
    "phase1": "phase 1: CT to inflated",
    "rigid_ct_deflated": "rigid: CT to deflated",
    "rigid_inflated_deflated": "rigid: inflated to deflated",
    "phase2": "phase 2: inflated to deflated",
    "chain": "whole chain: CT to deflated",
}

# Keys of run.json that have a place of their own on the page; whatever else a run recorded is listed at its end.
_SHOWN = {
    "status",
    "nodule_lps",
    "nodule_ellipsoid95_mm",
    "theta",
    "seconds",
    "peak_mb",
    "skipped",
    "gates",
    "warnings",
}


@dataclass(frozen=True)
class View:
    """One picture of the page. src: data URI; edges: letters at the left, top, right and bottom."""

    src: str
    alt: str
    edges: str
    plane: str


def render(data: ReportData) -> str:
    """The whole page as text."""
    viewer = stacks(data.phases[-1], data.window_hu) if data.phases else []
    level, verdict = judge(data.run)
    seconds = data.run.get("seconds", {})
    stages = {name: float(s) for name, s in seconds.items() if name != "total"}
    peak = data.run.get("peak_mb", {})
    memory = {str(k): float(v) for k, v in peak.items()} if isinstance(peak, Mapping) else {"whole run": float(peak)}
    return _page("report.html").render(
        data=data,
        run=data.run,
        level=level,
        verdict=verdict,
        nodule_ras=data.nodule.centre_ras,
        nodule_lps=flip_points(data.nodule.centre_ras),
        nearest_lps=None if data.nearest_surface_ras is None else flip_points(data.nearest_surface_ras),
        semi_axes=_semi_axes(data.nodule),
        viewer=viewer,
        viewer_json=_script_json([s.as_json() for s in viewer]),
        phases=[(phase, _before_after(phase, data.window_hu)) for phase in data.phases],
        pictures=[(picture, _views(picture, data.window_hu)) for picture in data.pictures],
        seconds_chart=bars(stages, "s", "seconds per stage") if stages else None,
        memory_chart=bars(memory, "MB", "highest memory per stage") if memory else None,
        rest={k: json.dumps(v, indent=1, default=str) for k, v in data.run.items() if k not in _SHOWN},
        nodule_colour=NODULE,
        legend=_legend(data),
        scores_from=Markup(SCORES_FROM),
        scores_to=Markup(SCORES_TO),
    )


def write_report(path: Path, data: ReportData) -> None:
    """Write report.html (UTF-8)."""
    path.write_text(render(data), encoding="utf-8")


def with_scores(page: str, scores: TreSection) -> str:
    """A rendered page with its scores filled in, or filled in anew. Raises ValueError when it has no place for them."""
    head, found, rest = page.partition(SCORES_FROM)
    _, ended, tail = rest.partition(SCORES_TO)
    if not (found and ended):
        raise ValueError("this report.html has no place for scores; run localize again to write a new one")
    body = _page("scores.html").render(
        summary=scores.summary,
        names=MEASURE_NAMES,
        chart=box_plot(
            {MEASURE_NAMES[m]: scores.errors_mm[m] for m in MEASURE_NAMES}, "target registration error per landmark"
        ),
    )
    return f"{head}{SCORES_FROM}\n{body}\n{SCORES_TO}{tail}"


def judge(run: Mapping[str, Any]) -> tuple[str, str]:
    """Level ("ok", "warn" or "fail") and sentence of the banner: failed gates outweigh warnings."""
    failed = [name for name, gate in run.get("gates", {}).items() if not gate["ok"]]
    n_warnings = len(run.get("warnings", []))
    if failed:
        return (
            "fail",
            f"Do not rely on this position: {len(failed)} of {len(run['gates'])} quality gates failed "
            f"({', '.join(name.replace('_', ' ') for name in failed)}).",
        )
    if n_warnings:
        return "warn", f"Every quality gate passed; {n_warnings} warning{'s' if n_warnings > 1 else ''} to read first."
    return "ok", "Every quality gate passed, no warnings."


def _before_after(phase: Comparison, window: tuple[float, float]) -> list[tuple[str, list[View]]]:
    """Blends before and after, in three planes each."""
    rows = []
    fixed = ready(phase.fixed)
    for when, moving in (("before", ready(phase.before)), ("after", ready(phase.after))):
        views = []
        for name in AXES:
            plane = plane_through(
                name, phase.nodule.centre_ras, box_of(phase.fixed.grid), _spacing(phase.fixed.grid.spacing)
            )
            image = green_magenta(grey(sample(moving, plane), window), grey(sample(fixed, plane), window))
            if when == "after":
                for outline in phase.outlines:
                    draw_outline(image, plane, outline)
            draw_nodule(image, plane, phase.nodule)
            alt = (
                f"{phase.title}, {when}: {name} plane, {phase.moving_name} in green over {phase.fixed_name} in magenta"
            )
            views.append(View(jpeg(image), alt, EDGE_LETTERS[name], name))
        rows.append((when, views))
    return rows


def _views(picture: Picture, window: tuple[float, float]) -> list[View]:
    views, volume = [], ready(picture.image)
    for name in AXES:
        plane = plane_through(name, picture.at_ras, box_of(picture.image.grid), _spacing(picture.image.grid.spacing))
        image = as_bgr(grey(sample(volume, plane), window))
        for outline in picture.outlines:
            draw_outline(image, plane, outline)
        views.append(View(jpeg(image), f"{picture.title}: {name} plane", EDGE_LETTERS[name], name))
    return views


def _spacing(voxel_mm: Array) -> float:
    """Pixel of the still pictures in mm: finer than a voxel, so that lines are crisp."""
    return float(np.clip(voxel_mm.min(), 0.8, 1.5) * 0.7)


def _semi_axes(nodule: Nodule) -> Array | None:
    if nodule.ellipsoid is None:
        return None
    return np.sort(np.linalg.norm(nodule.ellipsoid, axis=1))[::-1]


def _legend(data: ReportData) -> list[Outline]:
    return list({o.name: o for o in (data.phases[-1].outlines if data.phases else ())}.values())


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
    return environment.get_template(name)
