"""The chart's numbers as tables: its points as CSV, and a page in Markdown that says what each part is worth."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import fmean, median

from vatsloc.study.chart.chart import PLEURA_MM, Row
from vatsloc.study.chart.points import CLOCKS, COUNTED, MEASURES, PHASE_TITLES, Point, told_of_presets

WITHOUT_MODEL = ("balanced", "elastic", "spline", "alone", "elastic-alone", "spline-alone")
"""What the poroelastic model is held against, followed by the images and alone."""
SCANS = {"balanced": "CT, inflated and deflated CBCT", "two-scans": "CT, deflated CBCT", "one-scan": "CT"}
"""Variants that differ in the scans they use."""
AUTO, ITS_ALL = "auto", "balanced"
"""The preset that leaves out most, and the one that it is held against."""


def write_table(points: Sequence[Point], path: Path) -> None:
    """The chart's points, one line each."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["phase", "number", "variant", "says", "mean_mm", "p95_mm", "seconds", "cases", "front"])
        for p in points:
            numbers = (f"{v:.4g}" for v in (p.mean, p.p95, p.seconds))
            writer.writerow([p.phase, p.number, p.variant, p.says, *numbers, p.n, " ".join(p.front)])


def page(rows: Sequence[Row], points: Sequence[Point], clock: str = "seconds") -> str:
    """Tables per panel and per case, what there is to say of the presets, and what failed, as Markdown."""
    cases = sorted({row.case for row in rows})
    lines = [f"Cases: {', '.join(cases)}. mm are averages over the cases, s medians, kernels compiled.", ""]
    for phase, title in PHASE_TITLES.items():
        panel = sorted((p for p in points if p.phase == phase), key=lambda p: p.seconds)
        lines += [f"### {title}", "", f"s: {CLOCKS[clock]} {COUNTED[phase]}.", ""]
        lines += [
            "| | variant | | mean, mm | 95 %, mm | s | cases | on the front of |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for p in panel:
            front = ", ".join(MEASURES[m] for m in p.front)
            numbers = f"{p.mean:.2f} | {p.p95:.2f} | {p.seconds:.1f} | {p.n}"
            lines.append(f"| {p.number} | {p.variant} | {p.says} | {numbers} | {front} |")
        lines.append("")
    tissue = f"### Tissue in view, whole chain: everywhere; within {PLEURA_MM:g} mm of the pleura, mean / 95 % mm"
    lines += [tissue, "", *by_case(rows, cases, tissue_cell), ""]
    landmarks = "### Phase 2 by case, mean / 95 % at the landmarks; nodule, mm"
    lines += [landmarks, "", *by_case(rows, cases, phase2_cell), ""]
    lines += with_fewer_scans(rows, clock) + worth_of_the_model(rows, cases) + saved_by_auto(rows, cases, clock)
    lines += ["### Presets", "", *(f"- {sentence}" for sentence in told_of_presets(points)), ""]
    failed = [row for row in rows if row.failed]
    if failed:
        lines += ["### Without an answer", "", *(f"- {row.variant} on {row.case}: {row.failed}" for row in failed), ""]
    return "\n".join(lines)


def tissue_cell(row: Row) -> str:
    """Errors of a variant on a case at tissue; empty where it has none."""
    if math.isnan(row.tissue_mean):
        return ""
    return f"{row.tissue_mean:.2f} / {row.tissue_p95:.1f}; {row.pleura_mean:.2f} / {row.pleura_p95:.1f}"


def phase2_cell(row: Row) -> str:
    """Errors of a variant on a case at landmarks and nodule; empty where it has none."""
    if math.isnan(row.phase2_mean):
        return ""
    return f"{row.phase2_mean:.2f} / {row.phase2_p95:.2f}; {row.nodule_mm:.2f}"


def by_case(rows: Sequence[Row], cases: Sequence[str], cell: Callable[[Row], str]) -> list[str]:
    """Lines of a Markdown table: every variant that has something to tell on every case."""
    told = {(row.variant, row.case): cell(row) for row in rows}
    lines = [f"| variant | {' | '.join(cases)} |", "|---" * (len(cases) + 1) + "|"]
    for variant in dict.fromkeys(variant for (variant, _), text in told.items() if text):
        lines.append(f"| {variant} | {' | '.join(told.get((variant, case), '') for case in cases)} |")
    return lines


def with_fewer_scans(rows: Sequence[Row], clock: str) -> list[str]:
    """What fewer scans cost in mm, and how long the last scan waits for an answer, on cases that all of them answer."""
    by_name = _by_name(rows)
    chosen = [name for name in SCANS if name in by_name]
    answered = [{case for case, row in by_name[name].items() if not row.failed} for name in chosen]
    common = sorted(set.intersection(*answered)) if len(chosen) > 1 else []
    if not common:
        return []
    lines = [
        f"### Fewer scans: mean mm over {', '.join(common)}, and median s from the last scan, read, to the answer",
        "",
    ]
    lines += [
        f"| variant | scans | {CLOCKS[clock]} after the last | landmarks | tissue in view | within {PLEURA_MM:g} mm "
        "of the pleura | nodule |",
        "|---" * 7 + "|",
    ]
    for name in chosen:
        own = [by_name[name][case] for case in common]
        means = [
            fmean(getattr(row, c) for row in own) for c in ("chain_mean", "tissue_mean", "pleura_mean", "nodule_mm")
        ]
        waited = median(getattr(row, f"after_{clock}") for row in own)
        lines.append(f"| {name} | {SCANS[name]} | {waited:.1f} | {' | '.join(f'{mm:.2f}' for mm in means)} |")
    return [*lines, ""]


def worth_of_the_model(rows: Sequence[Row], cases: Sequence[str]) -> list[str]:
    """What tissue is off by without the poroelastic model, less what it is with it, scene by scene."""
    by_name = _by_name(rows)
    chosen = [name for name in WITHOUT_MODEL if name in by_name]
    pairs = [(with_it, name) for with_it, name in _pairs(chosen) if name in by_name]
    if not pairs:
        return []
    lines = ["### What the poroelastic model is worth: mm by which tissue in view is further off without it, mean", ""]
    lines += [f"| without it | beside | {' | '.join(cases)} | all |", "|---" * (len(cases) + 3) + "|"]
    for with_it, name in pairs:
        worth = [_less(by_name[name].get(c), by_name[with_it].get(c), "tissue_mean") for c in cases]
        known = [mm for mm in worth if not math.isnan(mm)]
        cells = [*("" if math.isnan(mm) else f"{mm:+.2f}" for mm in worth), f"{fmean(known):+.2f}" if known else ""]
        lines.append(f"| {name} | {with_it} | {' | '.join(cells)} |")
    return [*lines, ""]


def saved_by_auto(rows: Sequence[Row], cases: Sequence[str], clock: str) -> list[str]:
    """What `auto` left out of each case, the seconds that this saved and what it cost in mm of tissue."""
    by_name = _by_name(rows)
    if AUTO not in by_name or ITS_ALL not in by_name:
        return []
    lines = [f"### What {AUTO} leaves out, beside {ITS_ALL}", ""]
    lines += [
        f"| case | left out | saves, {CLOCKS[clock]} | tissue is further off by, mm | nodule, mm |",
        "|---" * 5 + "|",
    ]
    for case in cases:
        auto, whole = by_name[AUTO].get(case), by_name[ITS_ALL].get(case)
        if auto is None or whole is None:
            continue
        saved, tissue, nodule = (_less(a, b, f) for a, b, f in _columns(auto, whole, clock))
        parts = _only_in(auto, whole)
        lines.append(f"| {case} | {parts or 'nothing'} | {saved:.1f} | {tissue:+.2f} | {nodule:+.2f} |")
    return [*lines, ""]


def _columns(auto: Row, whole: Row, clock: str) -> tuple[tuple[Row, Row, str], ...]:
    return (whole, auto, f"chain_{clock}"), (auto, whole, "tissue_mean"), (auto, whole, "nodule_mm")


def _only_in(auto: Row, whole: Row) -> str:
    """Parts that the one left out and the other did not."""
    others = whole.left_out.split(", ")
    return ", ".join(part for part in auto.left_out.split(", ") if part not in others)


def _pairs(chosen: Sequence[str]) -> list[tuple[str, str]]:
    """Each variant without the model and the one with it that it is held against."""
    full = [("balanced", name) for name in chosen if name in ("elastic", "spline")]
    return full + [("alone", name) for name in chosen if name in ("elastic-alone", "spline-alone")]


def _by_name(rows: Sequence[Row]) -> Mapping[str, Mapping[str, Row]]:
    names = dict.fromkeys(row.variant for row in rows)
    return {name: {row.case: row for row in rows if row.variant == name} for name in names}


def _less(a: Row | None, b: Row | None, column: str) -> float:
    """a less b, NaN where one is missing."""
    return math.nan if a is None or b is None else float(getattr(a, column) - getattr(b, column))
