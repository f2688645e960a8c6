"""The scores as text for a terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vatsloc.evaluation.tre import BEFORE, MEASURES

_WHERE = {"landmarks": "landmarks", "inside_fov": "tissue seen", "outside_fov": "tissue unseen"}
_COLUMNS = ("mean", "sd", "median", "p95", "max")


def table(summary: Mapping[str, Any]) -> str:
    """Table of the dict that tre.json holds: a line per measure in mm, then the nodule."""
    lines = [f"{'TRE, mm':<26}" + "".join(f"{c:>8}" for c in _COLUMNS) + f"{'n':>6}  p, before and after"]
    for measure in MEASURES:
        s = summary[measure]
        numbers = "".join(f"{_mm(s[c]):>8}" for c in _COLUMNS)
        p = summary["wilcoxon_p"].get(measure) if measure in BEFORE else None
        lines.append(f"{measure:<26}{numbers}{s['n']:>6}" + ("" if p is None else f"  {p:.2g}"))
    dense = dict(summary.get("dense") or {})
    classes = dense.pop("by_depth", [])
    for where, errors in dense.items():
        for measure, s in errors.items():
            numbers = "".join(f"{_mm(s[c]):>8}" for c in _COLUMNS)
            lines.append(f"{f'{measure}, {_WHERE[where]}':<26}{numbers}{s['n']:>6}")
    lines += [
        f"within their 95 % radius (median {held['median_mm']:.1f} mm): "
        f"{held['share']:.1%} of {held['n']} {_WHERE[where]}"
        for where, held in summary["in_radius95"].items()
        if held["n"]
    ]
    lines += [_class_line(told) for told in classes if told["n"]]
    inside = {True: ", inside its 95 % ellipsoid", False: ", outside its 95 % ellipsoid", None: ""}
    lines.append(
        f"nodule: {_mm(summary['nodule_inflated_mm'])} mm off in the inflated CBCT, "
        f"{_mm(summary['nodule_deflated_mm'])} mm in the deflated one{inside[summary['nodule_in_ellipsoid95']]}"
    )
    return "\n".join([*lines, *(f"note: {warning}" for warning in summary["warnings"])])


def _class_line(told: Mapping[str, Any]) -> str:
    """One class of depth below the pleura."""
    to = "deeper" if told["to_mm"] is None else f"{told['to_mm']:.0f} mm"
    scores = (told[measure] or {"mean": None, "p95": None} for measure in ("phase1", "chain"))
    phase1, chain = (f"{_mm(score['mean'])} / {_mm(score['p95'])}" for score in scores)
    share = told["share_in_radius95"]
    held = "" if share is None else f", {share:.1%} within their 95 % radius"
    return f"tissue seen, {told['from_mm']:.0f} mm to {to}: mean / 95 % phase 1 {phase1}, chain {chain}{held}"


def _mm(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
