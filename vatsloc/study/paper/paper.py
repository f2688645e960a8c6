"""The paper's own experiments on cases with truth: before and after, variants A to C, the diaphragm, parameters.

Ref: Alvarez 2021, section 8.3 with Fig. 9 and Table 3, section 8.4 with Figs. 12 and 13.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from poro.fit import FitStatus
from vatsloc.case import Case, read_case
from vatsloc.errors import VatslocError
from vatsloc.evaluation.evaluate import errors_by_depth
from vatsloc.evaluation.inputs import Truth, read_truth
from vatsloc.evaluation.tre import RunMaps, target_registration_errors
from vatsloc.formats.folder import write_whole
from vatsloc.study.cohort.scored import Tissue, run_maps
from vatsloc.workflow.observe import Observed, observe
from vatsloc.workflow.parted import in_pieces
from vatsloc.workflow.pneumothorax import collapse, refined
from vatsloc.workflow.pose import ChangeOfPose, change_of_pose
from vatsloc.workflow.prepare import Prepared, prepare
from vatsloc.workflow.settings import Settings, settings_of
from vatsloc.workflow.stages import Say, Stages, quiet

BEFORE = {"rigid CT to deflated": "rigid_ct_deflated", "rigid inflated to deflated": "rigid_inflated_deflated"}
COMPLETE, STILL = "C", "C, diaphragm still"
VARIANTS: dict[str, dict[str, Any]] = {
    "A": {"registration": {"on": False}, "model": {"hilum": False}},
    "B": {"model": {"hilum": False}},
    COMPLETE: {},
    STILL: {"model": {"diaphragm": False}},
}
"""Settings of the paper's variants: no change of pose, no hilum deformation, complete; and complete without
diaphragm."""

_PAPERS_MODEL = {
    "model": {"cost": "plain"},
    "keypoints": {"on": False},
    "residual": {"on": False},
    "refinement": {"on": False},
}
KINDS: dict[str, dict[str, Any]] = {"paper's model": _PAPERS_MODEL, "vatsloc": {}}
"""Both ways that every variant is run: fitted to the surface alone as in the paper, and with all that came after."""


@dataclass(frozen=True)
class Run:
    """One variant of one kind on one case. errors_mm: at the landmarks, None where one has no truth; theta: kappa_b in
    1/(Pa s), phi, d_diaph in mm; failed: why there is no answer; tissue_mm: (mean, 95 %) of the tissue in view in each
    class of depth between DENSE_DEPTHS_MM, None where there is none, nothing without dense truth.
    """

    kind: str
    variant: str
    errors_mm: tuple[float | None, ...] = ()
    nodule_mm: float | None = None
    theta: tuple[float, ...] = ()
    failed: str = ""
    tissue_mm: tuple[tuple[float | None, ...], ...] = ()

    @property
    def errors(self) -> np.ndarray:
        """(n,) mm, NaN where there is no truth."""
        return np.array([np.nan if e is None else e for e in self.errors_mm])


@dataclass(frozen=True)
class CaseRuns:
    """All runs of a case; those of kind "" are the rigid poses that they started from."""

    case: str
    runs: tuple[Run, ...]

    def run(self, kind: str, variant: str) -> Run | None:
        """The run of that name, None where it has no answer."""
        return next((r for r in self.runs if (r.kind, r.variant) == (kind, variant) and not r.failed), None)


def run_paper(cases: Sequence[Path], out: Path, jobs: int = 1, say: Say = quiet) -> list[CaseRuns]:
    """Every variant on every case, `jobs` cases at once; what `out` has of an earlier run is kept.

    Raises CaseError and InputRefused as reading a case does.
    """
    out.mkdir(parents=True, exist_ok=True)
    files = {folder: out / f"{folder.resolve().name}.json" for folder in cases}
    missing = [folder for folder, file in files.items() if not file.exists()]
    say(f"{len(cases) - len(missing)} of {len(cases)} cases are done, {len(missing)} to run")
    with ProcessPoolExecutor(jobs, get_context("spawn"), max_tasks_per_child=1) as pool:
        running = {pool.submit(measure_case, folder): folder for folder in missing}
        for done in as_completed(running):
            found = done.result()
            write_whole(files[running[done]], json.dumps(asdict(found), indent=1) + "\n")
            say(f"{found.case} done")
    return [read_runs(file) for file in files.values()]


def read_runs(file: Path) -> CaseRuns:
    """What `run_paper` wrote of one case."""
    known = json.loads(file.read_text(encoding="utf-8"))
    return CaseRuns(known["case"], tuple(Run(**{k: _frozen(v) for k, v in run.items()}) for run in known["runs"]))


def measure_case(folder: Path) -> CaseRuns:
    """All variants on one case; what is prepared or observed alike is so once. A case whose images are refused has
    failed in all of them.
    """
    case, truth = read_case(folder), read_truth(folder)
    try:
        prepared = prepare(case, Stages())
    except VatslocError as error:
        refused = tuple(Run(kind, variant, failed=str(error)) for variant in VARIANTS for kind in KINDS)
        return CaseRuns(folder.resolve().name, refused)
    tissue = Tissue.of(prepared, truth)
    poses: dict[bool, ChangeOfPose] = {}
    seen: dict[tuple[bool, bool], Observed] = {}
    runs: list[Run] = []
    for variant, over in VARIANTS.items():
        chosen = settings_of("balanced", over)
        moves, hilum = chosen.registration.on, chosen.model.hilum
        try:
            if moves not in poses:
                poses[moves] = change_of_pose(case, prepared, chosen, Stages())
            if (moves, hilum) not in seen:
                seen[moves, hilum] = observe(case, prepared, poses[moves], chosen, Stages())
            scene = _Scene(case, truth, tissue, prepared, poses[moves], seen[moves, hilum])
            runs += _collapses(scene, variant)
        except VatslocError as error:
            runs += [Run(kind, variant, failed=str(error)) for kind in KINDS]
    return CaseRuns(folder.resolve().name, tuple(dict.fromkeys(runs)))


@dataclass(frozen=True)
class _Scene:
    """A case up to what was observed."""

    case: Case
    truth: Truth
    tissue: Tissue
    prepared: Prepared
    pose: ChangeOfPose
    observed: Observed


def _collapses(scene: _Scene, variant: str) -> list[Run]:
    """A variant in both kinds, and the poses before it if it is the complete one. Pieces and blocks follow as in a run,
    but not in the paper's model.
    """
    runs, case, truth, prepared = [], scene.case, scene.truth, scene.prepared
    for kind in KINDS:
        settings, pose = settings_for(variant, kind), scene.pose
        found = collapse(case, prepared, pose, scene.observed, settings, Stages())
        if found.fit.status is FitStatus.CONTACT:
            runs.append(Run(kind, variant, failed="the contact did not settle"))
            continue
        if settings.refinement.on:
            pose, found = in_pieces(prepared, pose, found, settings, Stages())
            found = refined(case, prepared, pose, found, settings, Stages())
        maps = run_maps(pose, found)
        errors = target_registration_errors(truth.landmarks, maps).mm
        true = truth.nodule.nodule_deflated_ras
        start = case.nodule.centre_ras[None]
        off = None if true is None else float(np.linalg.norm(maps.def_from_inf(maps.inf_from_ct(start))[0] - true))
        theta = found.fit.theta
        known = (theta.kappa_b, theta.phi, theta.d_diaph_mm)
        runs.append(Run(kind, variant, _listed(errors["chain"]), off, known, "", _by_depth(scene.tissue, maps)))
        if variant == COMPLETE:
            runs += [Run("", name, _listed(errors[measure])) for name, measure in BEFORE.items()]
    return runs


def settings_for(variant: str, kind: str) -> Settings:
    """Settings of a variant of one kind."""
    return settings_of("balanced", VARIANTS[variant], KINDS[kind])


def _listed(errors: np.ndarray) -> tuple[float | None, ...]:
    return tuple(round(float(e), 4) if np.isfinite(e) else None for e in errors)


def _frozen(value: Any) -> Any:
    """Tuples for what JSON has as lists."""
    return tuple(_frozen(v) for v in value) if isinstance(value, list) else value


def _by_depth(tissue: Tissue, maps: RunMaps) -> tuple[tuple[float | None, ...], ...]:
    """Errors (mean, 95 %) of the whole chain between DENSE_DEPTHS_MM; points outside the lung count as the first."""
    if len(tissue.ct) == 0:
        return ()
    classes = (told["chain"] for told in errors_by_depth({"chain": tissue.errors_mm(maps)}, tissue.depth_mm))
    return tuple((None, None) if s is None else (round(s["mean"], 4), round(s["p95"], 4)) for s in classes)
