"""The chart as a picture (PNG, SVG), tables (CSV, Markdown) and a page that answers to the mouse, all in one file."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jinja2

from vatsloc.errors import CaseError
from vatsloc.study.chart.chart import PHASES, Row
from vatsloc.study.chart.points import (
    CLOCKS,
    MEASURES,
    PHASE_TITLES,
    PUBLISHED,
    Point,
    points_of,
    told_of_presets,
)
from vatsloc.study.chart.variants import Variant
from vatsloc.workflow.settings import PRESETS

BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#8a929c"
TICKS_S = {1: "1 s", 3: "3 s", 10: "10 s", 30: "30 s", 120: "2 min", 600: "10 min", 3600: "1 h", 14400: "4 h"}
TICKS_MM = (0.2, 0.5, 1, 2, 5, 10, 20, 50)


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


def write_table(points: Sequence[Point], path: Path) -> None:
    """The chart's points, one line each."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["phase", "variant", "says", "mean_mm", "p95_mm", "seconds", "cases", "front"])
        for p in points:
            numbers = (f"{v:.4g}" for v in (p.mean, p.p95, p.seconds))
            writer.writerow([p.phase, p.variant, p.says, *numbers, p.n, " ".join(p.front)])


def page(rows: Sequence[Row], points: Sequence[Point], clock: str = "seconds") -> str:
    """Tables per phase, what there is to say of the presets, and what failed, as Markdown."""
    cases = sorted({row.case for row in rows})
    head = f"Cases: {', '.join(cases)}. mm are averages over the cases, s medians: {CLOCKS[clock]}."
    lines = [head, ""]
    for phase in PHASES:
        panel = sorted((p for p in points if p.phase == phase), key=lambda p: p.seconds)
        lines += [f"### {PHASE_TITLES[phase]}", "", "| variant | | mean, mm | 95 %, mm | s | cases | on the front of |"]
        lines.append("|---|---|---|---|---|---|---|")
        for p in panel:
            front = ", ".join(MEASURES[m] for m in p.front)
            lines.append(f"| {p.variant} | {p.says} | {p.mean:.2f} | {p.p95:.2f} | {p.seconds:.1f} | {p.n} | {front} |")
        lines.append("")
    lines += ["### Phase 2 by case, mean / 95 % at the landmarks; nodule, mm", "", *by_case(rows, cases), ""]
    lines += ["### Presets", "", *(f"- {sentence}" for sentence in told_of_presets(points)), ""]
    failed = [row for row in rows if row.failed]
    if failed:
        lines += ["### Without an answer", "", *(f"- {row.variant} on {row.case}: {row.failed}" for row in failed), ""]
    return "\n".join(lines)


def by_case(rows: Sequence[Row], cases: Sequence[str]) -> list[str]:
    """Lines of a Markdown table: every variant that deforms the collapsing lung on every case."""
    found = {(row.variant, row.case): row for row in rows if not math.isnan(row.phase2_mean)}
    lines = [f"| variant | {' | '.join(cases)} |", "|---" * (len(cases) + 1) + "|"]
    for variant in dict.fromkeys(variant for variant, _ in found):
        cells = []
        for case in cases:
            row = found.get((variant, case))
            cells.append("" if row is None else f"{row.phase2_mean:.2f} / {row.phase2_p95:.2f}; {row.nodule_mm:.2f}")
        lines.append(f"| {variant} | {' | '.join(cells)} |")
    return lines


def interactive(rows: Sequence[Row], variants: Mapping[str, Variant], clock: str = "seconds") -> str:
    """One HTML page with every point of all cases and of each one."""
    sets = {"all cases": points_of(rows, variants, clock)}
    sets |= {case: points_of(rows, variants, clock, case) for case in sorted({row.case for row in rows})}
    data: dict[str, Any] = {
        "phases": PHASE_TITLES,
        "clock": CLOCKS[clock],
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
    """A row of panels for the mean and one for 95 %, a column per phase, logarithmic axes."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    matplotlib.rcParams["svg.hashsalt"] = "vatsloc"  # the same file from the same points
    figure, grid = pyplot.subplots(len(MEASURES), len(PHASES), figsize=(15, 9), squeeze=False, layout="constrained")
    for axes_row, measure in zip(grid, MEASURES, strict=True):
        for axes, phase in zip(axes_row, PHASES, strict=True):
            _panel(axes, [p for p in points if p.phase == phase], phase, measure)
            axes.set_xlabel(CLOCKS[clock])
    for path in paths:
        metadata = {"Date": None} if path.suffix == ".svg" else None
        figure.savefig(path, dpi=110, metadata=metadata)
    pyplot.close(figure)


def _panel(axes: Any, panel: Sequence[Point], phase: str, measure: str) -> None:
    front = sorted((p for p in panel if measure in p.front), key=lambda p: p.seconds)
    axes.step([p.seconds for p in front], [getattr(p, measure) for p in front], where="post", color=BLUE, lw=1.2)
    for p in panel:
        preset, leading = p.variant in PRESETS, measure in p.front
        colour = ORANGE if preset else BLUE if leading else GREY
        face = colour if p.complete else "none"
        axes.plot(p.seconds, getattr(p, measure), "D" if preset else "o", color=colour, mfc=face, ms=8 if preset else 6)
    if measure == "mean":
        for published in (p for p in PUBLISHED if p.phase == phase):
            for mm in published.mm:
                axes.plot(published.seconds, [mm, mm], "-", color=GREEN, lw=2.5, solid_capstyle="round")
            where = (published.seconds[0] * published.seconds[1]) ** 0.5, max(published.mm)
            _label(axes, published.says, where, GREEN, (0, 8), "center")
    axes.set(xscale="log", yscale="log", title=f"{PHASE_TITLES[phase]}, {MEASURES[measure]}")
    axes.set(ylabel="target registration error, mm")
    axes.margins(x=0.24, y=0.12)
    shown_s = [s for s in TICKS_S if axes.get_xlim()[0] <= s <= axes.get_xlim()[1]]
    axes.set_xticks(shown_s, [TICKS_S[s] for s in shown_s])
    shown_mm = [mm for mm in TICKS_MM if axes.get_ylim()[0] <= mm <= axes.get_ylim()[1]]
    axes.set_yticks(shown_mm, [f"{mm:g}" for mm in shown_mm])
    axes.minorticks_off()
    axes.grid(color="#e3e6ea", lw=0.6)
    _names(axes, panel, measure)


def _names(axes: Any, panel: Sequence[Point], measure: str) -> None:
    """A name beside every point, the front's and the presets' first, moved down or up where another one stands."""
    taken: list[tuple[float, float]] = []
    important = sorted(panel, key=lambda p: (p.variant not in PRESETS, measure not in p.front))
    for p in important:
        x, y = axes.transData.transform((p.seconds, getattr(p, measure))) * 72 / axes.figure.dpi
        for dy in (3, -10, 12, -19, 21, -28, 30, -37, 39):
            if all(abs(y + dy - other) > 8.5 or abs(x - where) > 75 for where, other in taken):
                break
        taken.append((x, y + dy))
        colour = ORANGE if p.variant in PRESETS else "#1b1f24" if measure in p.front else GREY
        _label(axes, p.variant, (p.seconds, getattr(p, measure)), colour, (8, dy), "left")


def _label(axes: Any, text: str, at: tuple[float, float], colour: str, offset: tuple[float, float], side: str) -> None:
    axes.annotate(text, at, offset, textcoords="offset points", color=colour, fontsize=8, ha=side)
