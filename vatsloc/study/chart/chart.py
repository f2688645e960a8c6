"""The chart: what each part of the method buys in millimetres, and what it costs in seconds, over a set of cases."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from poro.fit import FitStatus
from registration.volume import Array
from vatsloc.case import Case, read_case
from vatsloc.errors import InputRefused, NotConverged, VatslocError
from vatsloc.evaluation.inputs import Truth, read_truth
from vatsloc.evaluation.statistics import summarize
from vatsloc.evaluation.tre import RunMaps, target_registration_errors
from vatsloc.study.chart.fewer_scans import foreseen, without_inflated
from vatsloc.study.chart.variants import Scored, Variant
from vatsloc.study.cohort.scored import Tissue, run_maps
from vatsloc.workflow.observe import observe
from vatsloc.workflow.parted import in_pieces
from vatsloc.workflow.pneumothorax import Collapse, collapse, modelled, refined
from vatsloc.workflow.pose import ChangeOfPose, change_of_pose
from vatsloc.workflow.prepare import Prepared, prepare, prepare_before
from vatsloc.workflow.settings import load_settings
from vatsloc.workflow.stages import Say, Stages, quiet

RUNS = "runs.csv"
PHASES = ("phase1", "phase2", "chain")
PLEURA_MM = 10.0
"""Tissue nearer to the pleura than this has a panel of its own: most nodules that need localizing lie there."""
SPINES = {"phase1": "spine CT to inflated", "phase2": "spine inflated to deflated"}
NAN = float("nan")


@dataclass(frozen=True)
class Row:
    """One variant on one case. *_mean, *_p95: target registration errors, mm; *_seconds: of a phase's own stages, the
    chain's from the images on disk to the nodule's place, reading and preparation included; *_cpu: the same as
    processor seconds, which other programs disturb less; after_*: what is left to do once the last scan is there and
    read; tissue_*, pleura_*: errors of the chain at tissue that both
    cone-beam CTs show, everywhere and within `PLEURA_MM` of the pleura; left_out: parts that the scene did not need;
    load: processes that ran on the machine at its end; failed: why there is no number.
    """

    variant: str
    case: str
    phase1_mean: float = NAN
    phase1_p95: float = NAN
    phase1_seconds: float = NAN
    phase1_cpu: float = NAN
    phase2_mean: float = NAN
    phase2_p95: float = NAN
    phase2_seconds: float = NAN
    phase2_cpu: float = NAN
    chain_mean: float = NAN
    chain_p95: float = NAN
    chain_seconds: float = NAN
    chain_cpu: float = NAN
    after_seconds: float = NAN
    after_cpu: float = NAN
    tissue_mean: float = NAN
    tissue_p95: float = NAN
    pleura_mean: float = NAN
    pleura_p95: float = NAN
    nodule_mm: float = NAN
    left_out: str = ""
    load: float = NAN
    failed: str = ""


def run_chart(cases: Sequence[Path], variants: Mapping[str, Variant], out: Path, say: Say = quiet) -> list[Row]:
    """Run every variant on every case that out/runs.csv lacks; all its rows, of this run's and of earlier ones."""
    out.mkdir(parents=True, exist_ok=True)
    known = {(row.variant, row.case) for row in read_rows(out / RUNS)}
    warm = False
    for folder in cases:
        name = folder.resolve().name
        missing = {v: variant for v, variant in variants.items() if (v, name) not in known}
        if not missing:
            continue
        if not warm:
            say(f"{name}: a run to compile and warm the kernels ...")
            warm_up(folder)
            warm = True
        for row in measure_case(folder, missing):
            append_row(out / RUNS, row)
            say(f"{name}, {row.variant}: {row.failed or _errors(row)}")
    return read_rows(out / RUNS)


def _errors(row: Row) -> str:
    first = "" if math.isnan(row.phase1_mean) else f"phase 1 {row.phase1_mean:.2f}, "
    return f"{first}chain {row.chain_mean:.2f} mm, {row.chain_cpu:.0f} s"


def warm_up(folder: Path) -> None:
    """Let everything be compiled that a run needs."""
    case, settings, stages = read_case(folder), load_settings("fast", None), Stages()
    prepared = prepare(case, stages)
    pose = change_of_pose(case, prepared, settings, stages)
    observed = observe(case, prepared, pose, settings, stages)
    refined(case, prepared, pose, collapse(case, prepared, pose, observed, settings, stages), settings, stages)


@dataclass(frozen=True)
class _Cost:
    """What stages took: seconds by the clock and of the processors."""

    seconds: float
    cpu: float

    @staticmethod
    def of(stages: Stages, *names: str) -> _Cost:
        """Of the named stages, of all without names."""
        chosen = names or tuple(stages.seconds)
        return _Cost(sum(stages.seconds[n] for n in chosen), sum(stages.cpu_seconds[n] for n in chosen))

    def __add__(self, other: _Cost) -> _Cost:
        return _Cost(self.seconds + other.seconds, self.cpu + other.cpu)

    def named(self, phase: str) -> dict[str, Any]:
        """Columns of a row."""
        return {f"{phase}_seconds": self.seconds, f"{phase}_cpu": self.cpu}


@dataclass
class _CaseRuns:
    """A case whose images are read and prepared once; what that took counts for every variant's chain. read,
    last: what reading and the deflated scan's preparation took of that.
    """

    case: Case
    truth: Truth
    prepared: Prepared
    tissue: Tissue
    cost: _Cost
    read: _Cost
    last: _Cost
    poses: dict[str, tuple[ChangeOfPose, Stages]] = field(default_factory=dict)

    def pose(self, variant: Variant) -> tuple[ChangeOfPose, Stages]:
        """Phase 1 and its log; the same one is not run again."""
        settings = variant.settings
        shaped_by = settings.registration, settings.refinement, settings.mesh.edge_mm, settings.leave_out
        key = f"{variant.register.__name__} {shaped_by}"
        if key not in self.poses:
            stages = Stages()
            found = change_of_pose(self.case, self.prepared, settings, stages, variant.register)
            self.poses[key] = found, stages
        return self.poses[key]


def measure_case(folder: Path, variants: Mapping[str, Variant]) -> Iterator[Row]:
    """A row per variant. What a user can act on becomes the row's `failed`."""
    stages, last = Stages(), Stages()
    with stages.stage("read"):
        case = read_case(folder)
    if case.cbct_inflated is None:
        raise InputRefused(f"{folder} has no inflated CBCT; the chart holds every variant against three scans.")
    before = prepare_before(case, case.cbct_inflated, stages)
    prepared, truth = prepare(case, last, before), read_truth(folder)
    tissue, cost = Tissue.of(prepared, truth), _Cost.of(stages) + _Cost.of(last)
    runs = _CaseRuns(case, truth, prepared, tissue, cost, _Cost.of(stages, "read"), _Cost.of(last))
    ways = {Scored.SPINES: _spines, Scored.CHAIN: _fewer_scans}
    for name, variant in variants.items():
        row = Row(name, folder.resolve().name)
        try:
            row = ways.get(variant.scored, _run)(runs, variant, row)
        except (VatslocError, ImportError) as error:
            row = replace(row, failed=str(error).split("\n")[0])
        yield replace(row, load=os.getloadavg()[0])


def _run(runs: _CaseRuns, variant: Variant, row: Row) -> Row:
    pose, before = runs.pose(variant)
    phase1, rigid = _Cost.of(before), pose.inf_from_ct_rigid
    if variant.scored is Scored.POSE:
        maps = RunMaps(rigid, rigid, rigid, pose.inf_from_ct, rigid, rigid)
        row = replace(row, left_out=_left_out(before))
        return replace(_scored(runs.truth, maps, row, ("phase1",)), **phase1.named("phase1"))
    stages = Stages()
    pose, collapse = _collapse(runs, variant, pose, stages)
    if collapse.fit.status is FitStatus.CONTACT:
        raise NotConverged("the contact of the collapsing lung did not settle")
    maps = run_maps(pose, collapse)
    row = replace(row, left_out=_left_out(before, stages))
    row = replace(row, **(runs.last + _Cost.of(stages)).named("after"))
    return _told(runs, maps, row, phase1, _Cost.of(stages))


def _fewer_scans(runs: _CaseRuns, variant: Variant, row: Row) -> Row:
    """The chain alone: its landmarks, tissue and nodule, and what it took with reading all scans."""
    before, after = Stages(), Stages()
    if variant.scans == 1:
        maps = foreseen(runs.case, runs.prepared, after)
    else:
        maps = without_inflated(runs.case, variant.settings, before, after)
    row = replace(row, left_out=_left_out(before, after), **_nodule_and_tissue(runs, maps))
    took = runs.read + _Cost.of(before) + _Cost.of(after)
    row = replace(row, **took.named("chain"), **_Cost.of(after).named("after"))
    return _scored(runs.truth, maps, row, ("chain",))


def _collapse(runs: _CaseRuns, variant: Variant, pose: ChangeOfPose, stages: Stages) -> tuple[ChangeOfPose, Collapse]:
    """What follows the change of pose, as `localize` does it but for what the variant changes."""
    settings = variant.settings
    observed = observe(runs.case, runs.prepared, pose, settings, stages)
    with stages.named():
        model = variant.select(runs.case.gravity_ras, runs.prepared, observed, settings, stages)
        collapse = modelled(runs.prepared, pose, observed, model, settings, stages)
        if variant.pieces:
            pose, collapse = in_pieces(runs.prepared, pose, collapse, settings, stages)
        if variant.blocks:
            collapse = refined(runs.case, runs.prepared, pose, collapse, settings, stages)
    return pose, collapse


def _spines(runs: _CaseRuns, variant: Variant, row: Row) -> Row:
    """The pose alone: what both phases start from."""
    stages = Stages()
    pose = change_of_pose(runs.case, runs.prepared, variant.settings, stages, variant.register)
    rigid = pose.inf_from_ct_rigid
    def_from_inf = observe(runs.case, runs.prepared, pose, variant.settings, stages).def_from_inf_rigid
    there, back = (_Cost.of(stages, SPINES[phase]) for phase in ("phase1", "phase2"))
    chain = def_from_inf @ rigid
    return _told(runs, RunMaps(rigid, chain, def_from_inf, rigid, def_from_inf, chain), row, there, back)


def _told(runs: _CaseRuns, maps: RunMaps, row: Row, phase1: _Cost, phase2: _Cost) -> Row:
    """The row with errors at landmarks, tissue and nodule, and what both phases took."""
    row = replace(row, **_nodule_and_tissue(runs, maps))
    row = replace(row, **phase1.named("phase1"), **phase2.named("phase2"))
    return _scored(runs.truth, maps, replace(row, **(runs.cost + phase1 + phase2).named("chain")), PHASES)


def _nodule_and_tissue(runs: _CaseRuns, maps: RunMaps) -> dict[str, Any]:
    """Errors of the chain at the nodule, and at tissue that both cone-beam CTs show where there is dense truth."""
    nodule = {"nodule_mm": _off(maps.def_from_ct(runs.case.nodule.centre_ras[None]), runs.truth)}
    if len(runs.tissue.ct) == 0:
        return nodule
    errors = runs.tissue.errors_mm(maps)
    found = {"tissue": summarize(errors), "pleura": summarize(errors[runs.tissue.depth_mm < PLEURA_MM])}
    return nodule | {f"{name}_{what}": getattr(s, what) for name, s in found.items() for what in ("mean", "p95")}


def _left_out(*logs: Stages) -> str:
    """Parts that the scene did not need, by name."""
    return ", ".join(choice.part for log in logs for choice in log.choices if not choice.kept)


def _scored(truth: Truth, maps: RunMaps, row: Row, phases: Sequence[str]) -> Row:
    errors = target_registration_errors(truth.landmarks, maps).mm
    found = {phase: summarize(errors[phase]) for phase in phases}
    return replace(
        row, **{f"{phase}_{what}": getattr(s, what) for phase, s in found.items() for what in ("mean", "p95")}
    )


def _off(predicted: Array, truth: Truth) -> float:
    true = truth.nodule.nodule_deflated_ras
    return NAN if true is None else float(np.linalg.norm(predicted[0] - true))


def append_row(path: Path, row: Row) -> None:
    """Add a line to the table, and its head where it is new."""
    new = not path.exists()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        if new:
            writer.writerow(f.name for f in fields(Row))
        writer.writerow("" if v != v else f"{v:.4g}" if isinstance(v, float) else v for v in astuple(row))


def read_rows(path: Path) -> list[Row]:
    """Rows of a table that `append_row` wrote, none where it is missing. Raises InputRefused for another table."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        table = csv.DictReader(file)
        if table.fieldnames != [f.name for f in fields(Row)]:
            raise InputRefused(f"{path} is not a table of this version's chart; give another --out.")
        texts = ("variant", "case", "left_out", "failed")
        try:
            return [_row({k: v if k in texts else float(v or "nan") for k, v in line.items()}) for line in table]
        except (TypeError, ValueError) as error:
            raise InputRefused(f"{path} has a damaged line ({error}); delete the line and go on.") from error


def _row(values: dict[str, Any]) -> Row:
    return Row(**values)
