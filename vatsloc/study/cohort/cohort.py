"""localize and evaluate over many cases at once, each in processes of its own; goes on where it was stopped."""

from __future__ import annotations

import csv
import io
import math
import os
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import Future, as_completed
from itertools import pairwise
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from vatsloc.errors import CaseError
from vatsloc.evaluation.evaluate import DENSE_DEPTHS_MM
from vatsloc.formats.casefile import FILE_NAME
from vatsloc.formats.folder import write_whole
from vatsloc.results import REPORT
from vatsloc.study.cohort.job import RIGHT_MM, SILENT_MM, Job, NotSeen, Outcome, asked_of, kept_outcome, run_one
from vatsloc.study.cohort.pool import pool
from vatsloc.workflow.stages import Say, quiet

BAR = 20
LOST = -9
"""Exit code of a case whose Dask workers died, as if it had been killed."""

_PHASES = {"phase1": "phase 1", "phase2": "phase 2", "chain": "chain"}
_STATISTICS = ("mean", "p95", "max")


def find_cases(folders: Sequence[Path]) -> list[Path]:
    """Case folders among `folders` and right inside them, each once. Raises CaseError for a folder without any, and
    where two cases share a name."""
    if not folders:
        raise CaseError("no case is given; give case folders, folders of them, or --suite DIR.")
    found: list[Path] = []
    for folder in folders:
        inside = [folder] if (folder / FILE_NAME).is_file() else sorted(p.parent for p in folder.glob(f"*/{FILE_NAME}"))
        if not inside:
            raise CaseError(f"{folder} holds no case; give case folders, or folders of them.")
        found += [case for case in inside if case.resolve() not in {f.resolve() for f in found}]
    names = [case.resolve().name for case in found]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise CaseError(f"two cases are called {', '.join(twice)}; rename one, the name is its place in --out.")
    return found


def run_cohort(
    cases: Sequence[Path],
    out: Path,
    preset: str = "balanced",
    settings: Path | None = None,
    jobs: int = 1,
    scheduler: str | None = None,
    program: tuple[str, ...] | None = None,
    say: Say = quiet,
) -> list[Outcome]:
    """Localize and score every case, `jobs` at once or on the workers of a Dask `scheduler` that see the same files.

    A crash of one stops no other. Cases whose outcome is in `out` already are not run again. Writes cohort.csv,
    cohort.md and cohort.html after every case. Raises CaseError where the scheduler or its workers cannot do it.
    """
    out.mkdir(parents=True, exist_ok=True)
    threads = max(1, (os.cpu_count() or 1) // jobs) if scheduler is None else None
    folders = [(out / case.resolve().name).resolve() for case in cases]
    with pool(jobs, scheduler, out.resolve(), [case.resolve() for case in cases]) as place:
        todo = [
            Job(case.resolve(), folder, preset, settings and settings.resolve(), program, threads, place.shares)
            for case, folder in zip(cases, folders, strict=True)
        ]
        done = {job.folder.name: old for job in todo if (old := kept_outcome(job)) is not None}
        missing = [job for job in todo if job.folder.name not in done]
        say(f"{len(done)} of {len(todo)} cases are done, {len(missing)} to run")
        start = time.monotonic()
        running = {place.executor.submit(run_one, job): job for job in missing}
        for n, finished in enumerate(as_completed(running), 1):
            outcome = _outcome(finished, running[finished])
            done[outcome.name] = outcome
            bar = progress(len(done), len(todo), n, time.monotonic() - start)
            say(f"{bar} {outcome.name}: exit {outcome.exit_code}, {outcome.seconds:.0f} s {outcome.says}".rstrip())
            write_tables(out, _in_order(todo, done))
    outcomes = _in_order(todo, done)
    write_tables(out, outcomes)
    return outcomes


def progress(done: int, total: int, ran: int, seconds: float) -> str:
    """A bar of what is done, and the time that the rest takes at the pace of the `ran` cases of this run; at the end
    that pace."""
    filled = BAR * done // max(total, 1)
    left, pace = seconds / max(ran, 1) * (total - done) / 60, 3600 * ran / max(seconds, 1e-3)
    tells = f"{left:.0f} min left" if total > done else f"{pace:.0f} cases per hour"
    return f"[{'#' * filled}{'.' * (BAR - filled)}] {done}/{total}, {tells};"


def _outcome(finished: Future[Outcome], job: Job) -> Outcome:
    """What became of a case; one that its workers lost again and again is noted, and taken up by the next run."""
    try:
        return finished.result()
    except Exception as error:
        if not (isinstance(error, NotSeen) or type(error).__name__ == "KilledWorker"):
            raise
        says = str(error) if isinstance(error, NotSeen) else "every worker that took it died; look at the workers' logs"
        return Outcome(job.folder.name, LOST, 0.0, 0.0, says, [], None, None, asked_of(job))


def write_tables(out: Path, outcomes: Sequence[Outcome]) -> None:
    """cohort.csv, cohort.md and cohort.html in `out`."""
    text = io.StringIO()
    rows = csv.DictWriter(text, list(_record(outcomes[0])) if outcomes else [], lineterminator="\n")
    rows.writeheader()
    rows.writerows(_record(outcome) for outcome in outcomes)
    write_whole(out / "cohort.csv", text.getvalue())
    write_whole(out / "cohort.md", table(outcomes))
    pages = jinja2.Environment(loader=jinja2.PackageLoader("vatsloc.study.cohort", "."), autoescape=True)
    page = pages.get_template("cohort.html").render(
        heads=_HEADS, rows=[(o, _cells(o)) for o in outcomes], summary=summary(outcomes), report=REPORT
    )
    write_whole(out / "cohort.html", page)


def table(outcomes: Sequence[Outcome]) -> str:
    """Markdown: a line a case, errors as mean / 95 % / max in mm, and a last line about them all."""
    lines = [f"| {' | '.join(_HEADS)} |", "|---" * len(_HEADS) + "|"]
    lines += [f"| {' | '.join(_cells(outcome))} |" for outcome in outcomes]
    return "\n".join([*lines, "", summary(outcomes), ""])


def summary(outcomes: Sequence[Outcome]) -> str:
    """Coverage of the ellipsoid and share of silent failures, with the numbers of cases they are shares of."""
    held = [o.nodule_in_ellipsoid for o in outcomes if o.nodule_in_ellipsoid is not None]
    trusted = [o.nodule_in_ellipsoid for o in outcomes if o.exit_code == 0 and o.nodule_in_ellipsoid is not None]
    silent = [o.silent_failure for o in outcomes if o.silent_failure is not None]
    alarms = [o.false_alarm for o in outcomes if o.false_alarm is not None]
    return (
        f"{len(outcomes)} cases, {_exit_codes(outcomes)}. "
        f"The 95 % ellipsoid holds the nodule in {_of(held)} cases ({_of(trusted)} under exit code 0). "
        f"{_nodules(outcomes)}"
        f"Their own 95 % radius holds {_sum(outcomes)} landmarks. "
        f"{_tissue_errors(outcomes)}{_tissue_in_radius(outcomes)}"
        f"False alarms (a gate failed, yet nodule and tissue are right to {RIGHT_MM:g} mm on average): {_of(alarms)}. "
        f"Silent failures (nodule or mean landmark error over {SILENT_MM:g} mm under exit code 0): {_of(silent)}."
    )


def as_json(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """All outcomes, the coverage and the share of silent failures."""
    held = [o.nodule_in_ellipsoid for o in outcomes if o.nodule_in_ellipsoid is not None]
    silent = [o.silent_failure for o in outcomes if o.silent_failure is not None]
    return {
        "cases": [_record(o) for o in outcomes],
        "coverage95": sum(held) / len(held) if held else None,
        "silent_failure_share": sum(silent) / len(silent) if silent else None,
    }


DEPTHS_MM = tuple(pairwise(DENSE_DEPTHS_MM))
SHALLOW_MM = DEPTHS_MM[:2]
"""Classes of depth that have columns of their own: where nodules lie that nobody can feel."""
_SEEN = {
    "all": "all images show them",
    "ct and inflated": "the deflated image does not",
    "ct": "neither cone-beam image does",
}
"""Where a phantom's nodule is to be seen, in words."""
_HEADS = (
    "case",
    "exit",
    *_PHASES.values(),
    *(f"tissue {from_mm:g}-{to_mm:g} mm" for from_mm, to_mm in SHALLOW_MM),
    "nodule",
    "seen in",
    "ellipsoid holds it",
    "landmarks in their 95 % radius",
    "failed gates",
    "s",
    "MB",
    "says",
)


def _record(o: Outcome) -> dict[str, Any]:
    errors = {f"{phase}_{s}_mm": o.phase(phase, s) for phase in _PHASES for s in _STATISTICS}
    return {
        "case": o.name,
        "exit_code": o.exit_code,
        **errors,
        **{
            f"tissue_{from_mm:g}_{to_mm:g}_{s}_mm": (o.tissue(from_mm) or {"chain": {s: None}})["chain"][s]
            for from_mm, to_mm in SHALLOW_MM
            for s in ("mean", "p95")
        },
        "tissue_in_view_mm": o.tissue_mm,
        "nodule_mm": o.nodule_mm,
        "nodule_seen": o.nodule_seen,
        "nodule_in_ellipsoid95": o.nodule_in_ellipsoid,
        "landmarks_in_radius95": _share(o.landmarks_in_radius),
        "silent_failure": o.silent_failure,
        "false_alarm": o.false_alarm,
        "failed_gates": " ".join(o.failed_gates),
        "seconds": round(o.seconds, 1),
        "peak_mb": round(o.peak_mb),
        "says": o.says,
    }


def _cells(o: Outcome) -> list[str]:
    phases = [" / ".join(_number(o.phase(phase, s)) for s in _STATISTICS) if o.scores else "" for phase in _PHASES]
    held = {None: "", True: "yes", False: "no"}[o.nodule_in_ellipsoid]
    says = "" if o.failed_gates else o.says.replace("|", "/")
    radius = "{} of {}".format(*o.landmarks_in_radius) if o.landmarks_in_radius[1] else ""
    tail = [radius, ", ".join(o.failed_gates), f"{o.seconds:.0f}", f"{o.peak_mb:.0f}", says]
    classes = [o.tissue(from_mm) for from_mm, _ in SHALLOW_MM]
    tissue = [" / ".join(_number(d["chain"][s]) for s in ("mean", "p95")) if d else "" for d in classes]
    return [o.name, str(o.exit_code), *phases, *tissue, _number(o.nodule_mm), o.nodule_seen or "", held, *tail]


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _of(flags: Sequence[bool]) -> str:
    return f"{sum(flags)} of {len(flags)}"


def _share(counts: tuple[int, int]) -> float | None:
    return counts[0] / counts[1] if counts[1] else None


def _sum(outcomes: Sequence[Outcome]) -> str:
    counts = [o.landmarks_in_radius for o in outcomes]
    return f"{sum(held for held, _ in counts)} of {sum(known for _, known in counts)}"


def _tissue_in_radius(outcomes: Sequence[Outcome]) -> str:
    """Sentence about the share of tissue within its 95 % radius, class of depth by class; empty without dense truth."""
    parts = []
    for from_mm, to_mm in DEPTHS_MM:
        known = [d for d in (o.tissue(from_mm) for o in outcomes) if d and d["share_in_radius95"] is not None]
        if known:
            share = sum(d["share_in_radius95"] * d["n"] for d in known) / sum(d["n"] for d in known)
            parts.append(f"{100 * share:.1f} % at {_depth(from_mm, to_mm)}")
    return (
        f"Their own 95 % radius holds tissue in view by depth below the pleura: {', '.join(parts)}. " if parts else ""
    )


def _tissue_errors(outcomes: Sequence[Outcome]) -> str:
    """Sentence about the chain's error at tissue, class of depth by class: mean of the cases, and their median of the
    95 %; empty without dense truth."""
    parts = []
    for from_mm, to_mm in DEPTHS_MM:
        known = [d["chain"] for d in (o.tissue(from_mm) for o in outcomes) if d]
        if known:
            mean, p95 = np.mean([d["mean"] for d in known]), np.median([d["p95"] for d in known])
            parts.append(f"{mean:.1f} / {p95:.1f} at {_depth(from_mm, to_mm)}")
    return (
        f"Tissue in view by depth, mean of the cases / median of their 95 %, mm: {', '.join(parts)}. " if parts else ""
    )


def _nodules(outcomes: Sequence[Outcome]) -> str:
    """Sentence about the nodules by the images that show them; empty where that is not known."""
    parts = []
    for seen, words in _SEEN.items():
        known = [o for o in outcomes if o.nodule_seen == seen and o.nodule_mm is not None]
        if known:
            mm = [o.nodule_mm for o in known if o.nodule_mm is not None]
            held = [bool(o.nodule_in_ellipsoid) for o in known]
            parts.append(
                f"{np.mean(mm):.1f} / {np.percentile(mm, 95):.1f}, {_of(held)} in their ellipsoid, where {words}"
            )
    return f"Nodules, mean / 95 % mm: {'; '.join(parts)}. " if parts else ""


def _exit_codes(outcomes: Sequence[Outcome]) -> str:
    counts = Counter(o.exit_code for o in outcomes)
    more = ", ".join(f"{counts[code]} with {code}" for code in sorted(counts) if code != 0)
    return f"{counts[0]} with exit code 0" + (f", {more}" if more else "")


def _depth(from_mm: float, to_mm: float) -> str:
    return f"{from_mm:g} {f'to {to_mm:g} mm' if to_mm < math.inf else 'mm and deeper'}"


def _in_order(jobs: Sequence[Job], done: dict[str, Outcome]) -> list[Outcome]:
    return [done[job.folder.name] for job in jobs if job.folder.name in done]
