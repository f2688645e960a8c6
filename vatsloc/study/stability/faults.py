"""Faults put into runs on purpose: does a run notice that it is wrong?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from registration.maps.rigid import RigidTransform
from registration.volume import Array
from vatsloc.case import Case, read_case
from vatsloc.errors import VatslocError
from vatsloc.evaluation.inputs import Truth
from vatsloc.study.bench.check import BESIDE_TRUTH, beside_truth
from vatsloc.study.stability.fit import Scene, direction, errors_mm, read_scene, slipped_spine
from vatsloc.study.tables import Row, markdown
from vatsloc.workflow.localization import Localization, checked, locate_nodule
from vatsloc.workflow.localize import localize
from vatsloc.workflow.parted import in_pieces
from vatsloc.workflow.pneumothorax import Collapse, collapse, refined
from vatsloc.workflow.pose import ChangeOfPose
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import Say, Stages, quiet

WRONG_MM = 3.0
"""A run is wrong where its landmarks are off by more than this on average, or its nodule is."""
LOBE_SHARE, LOBE_MM = 0.35, 10.0

Fault = Callable[[Array, Array, np.random.Generator], Array]
"""From the lung's nodes before the collapse, placed by the spine, and where a run puts them, (n, 3) mm each, to where a
fault puts them."""


def stability_faults(cases: Sequence[Path], out: Path, settings: Settings, say: Say = quiet) -> None:
    """Write tables.md to `out`, anew after every case: each fault in each case, and whether the run noticed.

    Another patient's scan is the next case's, for the last one the first's. Raises CaseError as reading does.
    """
    rows: list[Row] = []
    beside: list[Row] = []
    for number, folder in enumerate(cases):
        scene, name = read_scene(folder, settings), folder.resolve().name
        other = read_case(cases[(number + 1) % len(cases)]) if len(cases) > 1 else None
        found = _finished(scene)
        beside += [{"case": name} | row for row in beside_truth(found, scene.truth.dense)]
        for fault, row in _rows(scene, other, found):
            rows.append({"case": name, "fault": fault} | row)
            say(f"{name}: {fault}: {row['landmarks, mm']} mm, {row['noticed by'] or 'not noticed'}")
        out.mkdir(parents=True, exist_ok=True)
        (out / "tables.md").write_text(page(rows, beside), encoding="utf-8")


def page(rows: list[Row], beside: list[Row]) -> str:
    """The table as a markdown page, with the shares of faults noticed, of silent ones and of false alarms."""
    wrong = [row for row in rows if row["wrong"]]
    noticed = sum(bool(row["noticed by"]) for row in wrong)
    by_check = sum("check" in str(row["noticed by"]) or "recognized" in str(row["noticed by"]) for row in wrong)
    right = [row for row in rows if not row["wrong"]]
    alarms = sum(bool(row["noticed by"]) for row in right)
    text = (
        "Made by `vatsloc stability faults CASES --out DIR`. A run is wrong where its landmarks are off by more than "
        f"{WRONG_MM:g} mm on average, or its nodule is; it noticed where a gate failed or the input was refused. Of "
        f"{len(rows)} runs {len(wrong)} were wrong: **{noticed} noticed** ({by_check} by the stage `check`), "
        f"**{len(wrong) - noticed} silent**. Of the {len(right)} right ones {alarms} were marked."
    )
    parts = ["# Does a run notice that it is wrong?", text, markdown(rows)]
    if beside:
        parts += ["## What is left over, beside the truth", BESIDE_TRUTH, markdown(beside)]
    return "\n\n".join(parts) + "\n"


def score(answer: Localization, truth: Truth) -> Row:
    """Errors of a run in mm, whether it is wrong, and which gates failed."""
    mean, nodule = errors_mm(answer, truth)
    failed = [name for name, gate in answer.gates.items() if not gate.ok]
    return {
        "landmarks, mm": round(mean, 2),
        "nodule, mm": "" if nodule is None else round(nodule, 2),
        "wrong": max(mean, nodule or 0.0) > WRONG_MM,
        "noticed by": ", ".join(failed),
    }


def _rows(scene: Scene, other: Case | None, found: Localization) -> list[tuple[str, Row]]:
    """Every fault and how the run fared; found: the run without any."""
    rows = [("nothing", score(found, scene.truth))]
    for name, fault in FAULTS.items():
        moved = fault(found.collapse.mesh_before.points, found.collapse.points_after, np.random.default_rng(0))
        wrong = replace(found.collapse, points_after=moved)
        rows.append((name, score(_answered(scene, found.pose, wrong), scene.truth)))
    for name, run in _whole_runs(scene, other).items():
        try:
            rows.append((name, score(run(), scene.truth)))
        except VatslocError as error:
            rows.append(
                (name, {"landmarks, mm": "", "nodule, mm": "", "wrong": True, "noticed by": type(error).__name__})
            )
    return rows


def _whole_runs(scene: Scene, other: Case | None) -> dict[str, Callable[[], Localization]]:
    """Faults that are in a run from the start, by name."""
    case, settings = scene.case, scene.settings
    runs = {"spine off one vertebra": lambda: _finished(slipped_spine(scene, np.random.default_rng(0)))}
    if case.cbct_inflated is not None:
        swapped = replace(case, cbct_inflated=case.cbct_deflated, cbct_deflated=case.cbct_inflated)
        runs["scans swapped"] = lambda: localize(swapped, settings, Stages())
    if other is not None:
        strange = replace(case, cbct_deflated=other.cbct_deflated)
        runs["deflated scan of another patient"] = lambda: localize(strange, settings, Stages())
    return runs


def _finished(scene: Scene) -> Localization:
    """The rest of a run, from its observations on."""
    stages = Stages()
    found = collapse(scene.case, scene.prepared, scene.pose, scene.observed, scene.settings, stages)
    pose, found = in_pieces(scene.prepared, scene.pose, found, scene.settings, stages)
    return _answered(scene, pose, refined(scene.case, scene.prepared, pose, found, scene.settings, stages))


def _answered(scene: Scene, pose: ChangeOfPose, found: Collapse) -> Localization:
    stages = Stages()
    answer = locate_nodule(scene.case, scene.prepared, pose, found, scene.settings, stages)
    return checked(scene.case, answer, scene.settings, stages)


def _shifted(mm: float) -> Fault:
    return lambda _before, nodes, rng: nodes + mm * direction(rng)


def _turned(degrees: float) -> Fault:
    def fault(_before: Array, nodes: Array, rng: np.random.Generator) -> Array:
        return RigidTransform.about(nodes.mean(axis=0), np.radians(degrees) * direction(rng), np.zeros(3))(nodes)

    return fault


def _part_shifted(_before: Array, nodes: Array, rng: np.random.Generator) -> Array:
    """The part of the lung beyond a plane, as a lobe that slid unseen."""
    along = nodes @ direction(rng)
    return np.where((along > np.quantile(along, 1 - LOBE_SHARE))[:, None], nodes + LOBE_MM * direction(rng), nodes)


FAULTS: dict[str, Fault] = {
    "shift 5 mm": _shifted(5.0),
    "shift 10 mm": _shifted(10.0),
    "shift 15 mm": _shifted(15.0),
    "turn 5 degrees": _turned(5.0),
    "one lobe off 10 mm": _part_shifted,
    "left and right exchanged": lambda _before, nodes, _rng: (
        np.array([-1, 1, 1]) * (nodes - nodes.mean(axis=0)) + nodes.mean(axis=0)
    ),
    "stale state: not collapsed": lambda before, _nodes, _rng: before,
    "nodes in another order": lambda _before, nodes, rng: rng.permutation(nodes),
}
"""Faults in a finished answer."""
