"""The paper's experiments as boxplots and one page of tables. Ref: Alvarez 2021, Figs. 9, 12, 13 and Table 3."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from vatsloc.evaluation.evaluate import DENSE_DEPTHS_MM
from vatsloc.evaluation.statistics import signed_rank_p
from vatsloc.study.paper.paper import BEFORE, COMPLETE, KINDS, STILL, VARIANTS, CaseRuns, Run
from vatsloc.study.tables import Row, markdown

FIGURES: dict[str, tuple[str, ...]] = {
    "before and after (Fig. 9)": (*BEFORE, COMPLETE),
    "A no change of pose, B no hilum, C complete (Fig. 12)": ("A", "B", COMPLETE),
    "with and without diaphragm (Fig. 13)": (STILL, COMPLETE),
}
"""What each row of the figure compares."""
PAIRS = (("rigid CT to deflated", COMPLETE), ("A", "B"), ("B", COMPLETE), (STILL, COMPLETE))
"""What Wilcoxon's test compares, worse expected first."""
COLOURS = ("#8a929c", "#56B4E9", "#D55E00")


def write_paper(results: Sequence[CaseRuns], out: Path) -> None:
    """Write paper.md and paper.png into `out`; needs matplotlib, the extra `report`."""
    (out / "paper.md").write_text(page(results), encoding="utf-8")
    draw(results, out / "paper.png")


def page(results: Sequence[CaseRuns]) -> str:
    """Errors, tests and parameters per case as Markdown."""
    parts = [
        "## Errors of the whole chain at the landmarks, mean ± standard deviation; of the nodule, mm",
        markdown([_errors(case) for case in results]),
        "## Tissue in view by depth below the pleura, whole chain of variant C, mean / 95 %, mm",
        markdown([_tissue(case) for case in results]),
        "## Two-sided p of Wilcoxon's signed-rank test, case by case; the smaller mean in brackets",
    ]
    for kind in KINDS:
        parts += [f"### {kind}", markdown([_tests(case, kind) for case in results])]
    parts += ["## Fitted parameters (the paper's Table 3)", markdown([_parameters(case) for case in results])]
    failed = [f"- {case.case}, {run.kind}, {run.variant}: {run.failed}" for case in results for run in _failed(case)]
    if failed:
        parts += ["## Without an answer", "\n".join(failed)]
    return "\n\n".join(parts) + "\n"


def draw(results: Sequence[CaseRuns], path: Path) -> None:
    """A row of panels per figure of the paper, a column per kind; boxes as the paper's, from quartile to quartile."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    size = (max(2 + 1.3 * len(results), 12), 11)
    figure, grid = pyplot.subplots(len(FIGURES), len(KINDS), figsize=size, sharey="row", layout="constrained")
    for axes_row, (title, variants) in zip(grid, FIGURES.items(), strict=True):
        for axes, kind in zip(axes_row, KINDS, strict=True):
            _panel(axes, results, kind, variants)
            axes.set_title(f"{kind}: {title}", fontsize=9)
    figure.savefig(path, dpi=70)
    pyplot.close(figure)


def _panel(axes: Any, results: Sequence[CaseRuns], kind: str, variants: Sequence[str]) -> None:
    width = 0.8 / len(variants)
    for k, variant in enumerate(variants):
        found = [(n, _found(case, kind, variant)) for n, case in enumerate(results)]
        drawn = [(n, run.errors[np.isfinite(run.errors)]) for n, run in found if run is not None]
        boxes = axes.boxplot(
            [errors for _, errors in drawn],
            positions=[n + (k - (len(variants) - 1) / 2) * width for n, _ in drawn],
            widths=0.85 * width,
            patch_artist=True,
            manage_ticks=False,
            medianprops={"color": "black"},
            flierprops={"marker": ".", "markersize": 3},
        )
        for box in boxes["boxes"]:
            box.set_facecolor(COLOURS[(k - len(variants)) % len(COLOURS)])
        if boxes["boxes"]:
            boxes["boxes"][0].set_label(variant)
    axes.set_xticks(range(len(results)), [case.case for case in results], rotation=40, ha="right", fontsize=8)
    axes.set_ylabel("target registration error, mm")
    axes.grid(axis="y", color="#e3e6ea", lw=0.6)
    axes.legend(fontsize=8)


def _found(case: CaseRuns, kind: str, variant: str) -> Run | None:
    return case.run("" if variant in BEFORE else kind, variant)


def _failed(case: CaseRuns) -> list[Run]:
    return [run for run in case.runs if run.failed]


def _errors(case: CaseRuns) -> Row:
    row: Row = {"case": case.case} | {name: _spread(case.run("", name)) for name in BEFORE}
    for kind in KINDS:
        row |= {f"{kind}, {variant}": _spread(case.run(kind, variant)) for variant in VARIANTS}
        complete = case.run(kind, COMPLETE)
        row[f"{kind}, nodule"] = "" if complete is None or complete.nodule_mm is None else f"{complete.nodule_mm:.2f}"
    return row


def _tissue(case: CaseRuns) -> Row:
    row: Row = {"case": case.case}
    for kind in KINDS:
        complete = case.run(kind, COMPLETE)
        found = () if complete is None else complete.tissue_mm
        for number, (from_mm, to_mm) in enumerate(pairwise(DENSE_DEPTHS_MM)):
            depth = f"{from_mm:g} to {to_mm:g} mm" if np.isfinite(to_mm) else f"{from_mm:g} mm and deeper"
            known = [mm for mm in found[number] if mm is not None] if number < len(found) else []
            row[f"{kind}, {depth}"] = " / ".join(f"{mm:.2f}" for mm in known)
    return row


def _spread(run: Run | None) -> str:
    return "" if run is None else f"{np.nanmean(run.errors):.2f} ± {np.nanstd(run.errors, ddof=1):.2f}"


def _tests(case: CaseRuns, kind: str) -> Row:
    row: Row = {"case": case.case}
    for first, second in PAIRS:
        runs = [_found(case, kind, variant) for variant in (first, second)]
        cell = ""
        if runs[0] is not None and runs[1] is not None:
            p = signed_rank_p(runs[0].errors, runs[1].errors)
            smaller = (first, second)[int(np.nanmean(runs[1].errors) < np.nanmean(runs[0].errors))]
            cell = "" if p is None else f"{p:.1e} ({smaller})"
        row[f"{first} / {second}"] = cell
    return row


def _parameters(case: CaseRuns) -> Row:
    row: Row = {"case": case.case}
    for kind in KINDS:
        complete = case.run(kind, COMPLETE)
        values = (None, None, None) if complete is None else complete.theta
        names = ("kappa_b, 1/(Pa s)", "phi", "d_diaph, mm")
        row |= {f"{kind}: {n}": "" if v is None else f"{v:.3g}" for n, v in zip(names, values, strict=True)}
    return row
