"""The chart as a picture (PNG, SVG) with a numbered key, and as a page that answers to the mouse, all in one file."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from registration.volume import Array
from vatsloc.errors import CaseError
from vatsloc.study.chart.chart import Row
from vatsloc.study.chart.points import (
    CLOCKS,
    COUNTED,
    MEASURES,
    PHASE_TITLES,
    PUBLISHED,
    Point,
    points_of,
)
from vatsloc.study.chart.tables import page, write_table
from vatsloc.study.chart.variants import Variant
from vatsloc.workflow.settings import PRESETS

BLUE, ORANGE, GREEN, GREY, INK = "#0072B2", "#D55E00", "#009E73", "#8a929c", "#1b1f24"
TICKS_S = {1: "1 s", 3: "3 s", 10: "10 s", 30: "30 s", 120: "2 min", 600: "10 min", 3600: "1 h", 14400: "4 h"}
TICKS_MM = (0.2, 0.5, 1, 2, 5, 10, 20, 50)
KEY_COLUMNS = 3
NUMBER, MARK = np.array([6.5, 5.0]), np.array([3.5, 3.5])
"""Half the width and height of a number of two digits, and of a mark, in points."""
RINGS = (12, 17, 23, 30, 38, 47, 57, 68, 80)
"""How far from its mark a number may stand, in points."""


def write_chart(rows: Sequence[Row], variants: Mapping[str, Variant], out: Path, clock: str = "seconds") -> None:
    """Write chart.png, .svg, .csv, .md and .html into `out`; needs matplotlib, the extra `report`."""
    points = points_of(rows, variants, clock)
    write_table(points, out / "chart.csv")
    (out / "chart.md").write_text(page(rows, points, clock), encoding="utf-8")
    (out / "chart.html").write_text(interactive(rows, variants, clock), encoding="utf-8")
    draw(points, [out / "chart.png", out / "chart.svg"], clock)


def require_matplotlib() -> None:
    """Raise CaseError where figures cannot be drawn: better before long runs than after them."""
    if find_spec("matplotlib") is None:
        raise CaseError('matplotlib is not installed; get it by pip install "vatsloc[report]", or ".[report]" here.')


def interactive(rows: Sequence[Row], variants: Mapping[str, Variant], clock: str = "seconds") -> str:
    """One HTML page with every point of all cases and of each one."""
    sets = {"all cases": points_of(rows, variants, clock)}
    sets |= {case: points_of(rows, variants, clock, case) for case in sorted({row.case for row in rows})}
    data: dict[str, Any] = {
        "phases": PHASE_TITLES,
        "clocks": {phase: f"{CLOCKS[clock]} {counted}" for phase, counted in COUNTED.items()},
        "measures": MEASURES,
        "sets": {name: [asdict(p) for p in points] for name, points in sets.items()},
        "published": [asdict(p) for p in PUBLISHED],
        "presets": tuple(PRESETS),
        "ticks": {"s": TICKS_S, "mm": TICKS_MM},
    }
    environment = jinja2.Environment(loader=jinja2.PackageLoader("vatsloc.study.chart", "."), autoescape=True)
    text = json.dumps(data).replace("<", "\\u003c")
    return environment.get_template("chart.html").render(data=text)


def draw(points: Sequence[Point], paths: Sequence[Path], clock: str = "seconds") -> None:
    """A row of panels for the mean and one for 95 %, a column per phase and one for tissue near the pleura, logarithmic
    axes, and under them the key to the numbers."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    matplotlib.rcParams["svg.hashsalt"] = "vatsloc"  # the same file from the same points
    key = {p.number: f"{p.number}  {p.variant}: {p.says}" for p in sorted(points, key=lambda p: p.number)}
    lines = math.ceil(len(key) / KEY_COLUMNS)
    height = 10.4 + 0.2 * lines
    figure, grid = pyplot.subplots(len(MEASURES), len(PHASE_TITLES), figsize=(19, height), squeeze=False)
    top = 1 - 0.35 / height
    figure.subplots_adjust(
        left=0.035, right=0.99, top=top, bottom=(0.95 + 0.2 * lines) / height, wspace=0.16, hspace=0.28
    )
    for axes_row, measure in zip(grid, MEASURES, strict=True):
        for axes, phase in zip(axes_row, PHASE_TITLES, strict=True):
            _panel(axes, [p for p in points if p.phase == phase], phase, measure)
            axes.set_xlabel(f"{CLOCKS[clock]}\n{COUNTED[phase]}", fontsize=9)
    for n, (number, text) in enumerate(key.items()):
        colour = ORANGE if any(p.number == number and p.variant in PRESETS for p in points) else INK
        at = 0.035 + (n // lines) * 0.96 / KEY_COLUMNS, (0.1 + 0.2 * (lines - 1 - n % lines)) / height
        figure.text(*at, text, fontsize=9, color=colour)
    for path in paths:
        metadata = {"Date": None} if path.suffix == ".svg" else None
        figure.savefig(path, dpi=100, metadata=metadata)
    pyplot.close(figure)


def _panel(axes: Any, panel: Sequence[Point], phase: str, measure: str) -> None:
    front = sorted((p for p in panel if measure in p.front), key=lambda p: p.seconds)
    axes.step([p.seconds for p in front], [getattr(p, measure) for p in front], where="post", color=BLUE, lw=1.2)
    for p in panel:
        preset = p.variant in PRESETS
        colour = _colour(p, measure)
        face = colour if p.complete else "none"
        axes.plot(p.seconds, getattr(p, measure), "D" if preset else "o", color=colour, mfc=face, ms=7 if preset else 5)
    if measure == "mean":
        for published in (p for p in PUBLISHED if p.phase == phase):
            for mm in published.mm:
                axes.plot(published.seconds, [mm, mm], "-", color=GREEN, lw=2.5, solid_capstyle="round")
            where = published.seconds[1], max(published.mm)
            axes.annotate(
                published.says, where, (0, 6), textcoords="offset points", color=GREEN, fontsize=8, ha="right"
            )
    axes.set(xscale="log", yscale="log")
    axes.set_title(f"{PHASE_TITLES[phase]}, {MEASURES[measure]}", fontsize=11)
    axes.set_ylabel("error, mm" if phase == "pleura" else "target registration error, mm", fontsize=9)
    axes.margins(x=0.12, y=0.12)
    shown_s = [s for s in TICKS_S if axes.get_xlim()[0] <= s <= axes.get_xlim()[1]]
    axes.set_xticks(shown_s, [TICKS_S[s] for s in shown_s])
    shown_mm = [mm for mm in TICKS_MM if axes.get_ylim()[0] <= mm <= axes.get_ylim()[1]]
    axes.set_yticks(shown_mm, [f"{mm:g}" for mm in shown_mm])
    axes.minorticks_off()
    axes.grid(color="#e3e6ea", lw=0.6)
    _numbers(axes, panel, measure)


def _colour(point: Point, measure: str) -> str:
    return ORANGE if point.variant in PRESETS else BLUE if measure in point.front else GREY


def _numbers(axes: Any, panel: Sequence[Point], measure: str) -> None:
    """Each point's number beside it, at the end of a line where others stand near."""
    points = sorted(panel, key=lambda p: (p.variant not in PRESETS, measure not in p.front, p.number))
    scale = 72 / axes.figure.dpi
    at = axes.transData.transform([(p.seconds, getattr(p, measure)) for p in points]) * scale if points else ()
    box = axes.get_window_extent().extents * scale
    for p, (x, y), (a, b) in zip(points, at, places(np.asarray(at), box), strict=True):
        colour = INK if measure in p.front and p.variant not in PRESETS else _colour(p, measure)
        axes.annotate(
            f"{p.number}",
            (p.seconds, getattr(p, measure)),
            (a - x, b - y),
            textcoords="offset points",
            color=colour,
            fontsize=8,
            ha="center",
            va="center",
            arrowprops={"arrowstyle": "-", "color": colour, "lw": 0.5, "shrinkA": 3, "shrinkB": 2},
        )


def places(marks: Array, box: Array) -> Array:
    """Where numbers of marks (n, 2) stand in a box (left, bottom, right, top), so that none lies on another number or
    on a mark: each at the nearest free place round its mark, in points."""
    found: list[Array] = []
    taken = [(mark, MARK) for mark in marks]
    for mark in marks:
        ring = (mark + r * np.array([np.cos(a), np.sin(a)]) for r in RINGS for a in np.arange(16) * np.pi / 8 + 0.4)
        inside = (spot for spot in ring if (spot - NUMBER > box[:2]).all() and (spot + NUMBER < box[2:]).all())
        free = (spot for spot in inside if all((np.abs(spot - o) > NUMBER + half).any() for o, half in taken))
        spot = next(free, mark)
        taken.append((spot, NUMBER))
        found.append(spot)
    return np.array(found).reshape(-1, 2)
