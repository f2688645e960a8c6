"""From the chart's runs to its points: averages over the cases, the Pareto front, and a word on every preset."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, median

from vatsloc.study.chart.chart import Row
from vatsloc.study.chart.variants import PANELS, Variant
from vatsloc.workflow.settings import PRESETS

PHASE_TITLES = {
    "phase1": "Phase 1: CT to inflated",
    "phase2": "Phase 2: inflated to deflated",
    "chain": "Whole chain: CT to deflated",
    "pleura": "Whole chain, within 10 mm of the pleura",
}
COST_OF = {"pleura": "chain"}
"""Whose seconds a panel shows, where they are not its own."""
MEASURES = {"mean": "mean", "p95": "95 %"}


@dataclass(frozen=True)
class Point:
    """A variant in one panel. number: in the key; mean, p95: errors in mm, averaged over cases; seconds: their median
    by a clock; n: cases with an answer; front: measures for which no other point is both faster and better."""

    variant: str
    number: int
    says: str
    phase: str
    mean: float
    p95: float
    seconds: float
    n: int
    complete: bool
    front: tuple[str, ...] = ()


@dataclass(frozen=True)
class Published:
    """A point of the paper: errors in mm of a case (or from the best to the worst), and its range of seconds."""

    says: str
    phase: str
    mm: tuple[float, ...]
    seconds: tuple[float, float]


PUBLISHED = (
    Published("Alvarez 2021, 5 patients", "phase1", (1.0, 2.7), (600.0, 900.0)),
    Published("Alvarez 2021, 5 patients", "chain", (4.9, 10.3, 7.5, 11.2, 14.3), (4 * 3600.0, 6 * 3600.0)),
)
"""Means over the landmarks of real patients; ours are simulated images. Ref: Alvarez 2021, section 8."""


CLOCKS = {"seconds": "seconds", "cpu": "processor seconds of all threads"}
COUNTED = {
    "phase1": "of the phase, without reading and preparing the images",
    "phase2": "of the phase, without reading and preparing the images",
    "chain": "from the images on disk",
    "pleura": "from the images on disk",
}
"""What a panel's seconds count. Reading and preparing is the same for every variant, so a front is one without it."""


def points_of(
    rows: Sequence[Row], variants: Mapping[str, Variant], clock: str = "seconds", case: str | None = None
) -> list[Point]:
    """A point per variant and panel that shows it, of all cases or of one; fronts hold complete points alone."""
    rows = [row for row in rows if row.variant in variants]
    number = numbers(rows, variants)
    rows = [row for row in rows if case in (None, row.case)]
    cases = {row.case for row in rows}
    found = []
    for phase in PHASE_TITLES:
        panel = []
        for name, variant in variants.items():
            if phase not in PANELS[variant.scored]:
                continue
            own = [row for row in rows if row.variant == name]
            columns = (f"{phase}_mean", f"{phase}_p95", f"{COST_OF.get(phase, phase)}_{clock}")
            values = [[getattr(row, column) for row in own] for column in columns]
            good = [triple for triple in zip(*values, strict=True) if all(map(math.isfinite, triple))]
            if good:
                mean, p95, seconds = zip(*good, strict=True)
                n = len(good)
                triple = fmean(mean), fmean(p95), median(seconds)
                panel.append(Point(name, number[name], variant.says, phase, *triple, n, n == len(cases)))
        found += with_fronts(panel)
    return found


def numbers(rows: Sequence[Row], variants: Mapping[str, Variant]) -> dict[str, int]:
    """Numbers of the variants that were run, from 1, in the order of `variants`."""
    ran = {row.variant for row in rows}
    return {name: n for n, name in enumerate((name for name in variants if name in ran), 1)}


def with_fronts(panel: Sequence[Point]) -> list[Point]:
    """The points of one panel, each knowing of which measures it is on the front."""
    on: dict[str, list[str]] = {point.variant: [] for point in panel}
    for measure in MEASURES:
        for point in panel:
            if point.complete and dominating(point, panel, measure) is None:
                on[point.variant].append(measure)
    return [Point(**{**vars(point), "front": tuple(on[point.variant])}) for point in panel]


def dominating(point: Point, panel: Sequence[Point], measure: str) -> Point | None:
    """The best complete point that is no slower and no worse, and better in one of the two; None on the front."""

    def beats(other: Point) -> bool:
        mine, theirs = (point.seconds, getattr(point, measure)), (other.seconds, getattr(other, measure))
        return other.complete and theirs != mine and theirs[0] <= mine[0] and theirs[1] <= mine[1]

    better = [other for other in panel if other.phase == point.phase and beats(other)]
    return min(better, key=lambda other: getattr(other, measure)) if better else None


def told_of_presets(points: Sequence[Point]) -> list[str]:
    """A sentence per preset and panel: on the front, or which point beats it."""
    told = []
    for point in points:
        if point.variant not in PRESETS:
            continue
        head = f"{point.variant}, {PHASE_TITLES[point.phase]}:"
        for measure, name in MEASURES.items():
            other = dominating(point, points, measure)
            value = getattr(point, measure)
            if not point.complete:
                told.append(f"{head} not on the front of the {name}, since cases are missing.")
            elif other is None:
                told.append(f"{head} on the front of the {name} ({value:.2f} mm in {point.seconds:.0f} s).")
            else:
                told.append(
                    f"{head} not on the front of the {name}: {other.variant} has {getattr(other, measure):.2f} mm in "
                    f"{other.seconds:.0f} s, it {value:.2f} mm in {point.seconds:.0f} s."
                )
    return told
