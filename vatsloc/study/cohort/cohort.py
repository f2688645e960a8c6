"""localize and evaluate over many cases at once, each in processes of its own; goes on where it was stopped."""

from __future__ import annotations

import csv
import io
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jinja2

from vatsloc.errors import CaseError
from vatsloc.formats.casefile import FILE_NAME
from vatsloc.formats.folder import RUN_FILE, write_whole
from vatsloc.results import REPORT
from vatsloc.study.cohort.pool import pool
from vatsloc.workflow.stages import Say, quiet

OUTCOME_FILE = "outcome.json"
SILENT_MM = 10.0
"""A nodule or a mean landmark error beyond this under exit code 0 is a silent failure."""
THIS_PROGRAM = (sys.executable, "-m", "vatsloc")

_PHASES = {"phase1": "phase 1", "phase2": "phase 2", "chain": "chain"}
_STATISTICS = ("mean", "p95", "max")


@dataclass(frozen=True)
class Job:
    """One case to run. folder: for its result; settings: TOML file or None; program: how the command line is called;
    threads: of its kernels."""

    case: Path
    folder: Path
    preset: str
    settings: Path | None
    program: tuple[str, ...]
    threads: int


@dataclass(frozen=True)
class Outcome:
    """How one case ended. exit_code: of localize, negative where a signal ended it; seconds: wall time of localize;
    peak_mb: as run.json says, else that of its process, no less than this one's; says: the last line of localize or
    evaluate, whichever failed; evaluate_code: exit code of evaluate, None where it had nothing to score; scores:
    tre.json, or None; asked: case, its date, preset, settings."""

    name: str
    exit_code: int
    seconds: float
    peak_mb: float
    says: str
    failed_gates: list[str]
    evaluate_code: int | None
    scores: dict[str, Any] | None
    asked: list[str]

    @property
    def complete(self) -> bool:
        """Whether nothing is gained by running it again: it has its scores, or the program said why not."""
        return self.exit_code in (2, 3, 4) or self.evaluate_code in (0, 2, 3)

    @property
    def silent_failure(self) -> bool | None:
        """Wrong by more than `SILENT_MM` without a word; None where there is nothing to tell it by."""
        errors = [e for e in (self.phase("chain", "mean"), self.nodule_mm) if e is not None]
        return None if not errors else self.exit_code == 0 and max(errors) > SILENT_MM

    @property
    def nodule_mm(self) -> float | None:
        """Error of the nodule in the deflated image, mm."""
        return None if self.scores is None else self.scores["nodule_deflated_mm"]

    @property
    def nodule_in_ellipsoid(self) -> bool | None:
        """Whether the 95 % ellipsoid holds the true nodule."""
        return None if self.scores is None else self.scores["nodule_in_ellipsoid95"]

    @property
    def landmarks_in_radius(self) -> tuple[int, int]:
        """How many landmarks lie within the 95 % radius that the run gave them, and of how many that is known."""
        held = (self.scores or {}).get("in_radius95", {}).get("landmarks", {})
        return (round(held["share"] * held["n"]), held["n"]) if held.get("n") else (0, 0)

    def phase(self, name: str, statistic: str) -> float | None:
        """A statistic of the landmark errors of "phase1", "phase2" or "chain", mm."""
        return None if self.scores is None else self.scores[name][statistic]


def find_cases(folders: Sequence[Path]) -> list[Path]:
    """Case folders among `folders` and right inside them, each once. Raises CaseError for a folder without any, and
    where two cases share a name."""
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
    program: tuple[str, ...] = THIS_PROGRAM,
    say: Say = quiet,
) -> list[Outcome]:
    """Localize and score every case, `jobs` at once or on the workers of a Dask `scheduler` that see the same files.

    A crash of one stops no other. Cases whose outcome is in `out` already are not run again. Writes cohort.csv,
    cohort.md and cohort.html after every case.
    """
    out.mkdir(parents=True, exist_ok=True)
    threads = max(1, (os.cpu_count() or 1) // jobs) if scheduler is None else 1
    todo = [
        Job(case.resolve(), (out / case.resolve().name).resolve(), preset, settings, program, threads) for case in cases
    ]
    done = {job.folder.name: old for job in todo if (old := _kept(job)) is not None}
    missing = [job for job in todo if job.folder.name not in done]
    say(f"{len(done)} of {len(todo)} cases are done, {len(missing)} to run")
    with pool(jobs, scheduler) as executor:
        running = [executor.submit(run_one, job) for job in missing]
        for finished in as_completed(running):
            outcome = finished.result()
            done[outcome.name] = outcome
            say(f"{outcome.name}: exit {outcome.exit_code}, {outcome.seconds:.0f} s {outcome.says}".rstrip())
            write_tables(out, _in_order(todo, done))
    outcomes = _in_order(todo, done)
    write_tables(out, outcomes)
    return outcomes


def run_one(job: Job) -> Outcome:
    """Localize and score one case, each in a process of its own, and keep the outcome beside its result."""
    job.folder.mkdir(parents=True, exist_ok=True)
    result = job.folder / "result"
    options = ["--preset", job.preset, *([] if job.settings is None else ["--settings", str(job.settings)])]
    code, seconds, peak, says = _measured(job, ["localize", str(job.case), "--out", str(result), *options])
    outcome = Outcome(job.folder.name, code, seconds, peak, says if code else "", [], None, None, _asked(job))
    if code in (0, 5):
        run = json.loads((result / RUN_FILE).read_text(encoding="utf-8"))
        gates = [name for name, gate in run["gates"].items() if not gate["ok"]]
        evaluated, _, _, said = _measured(job, ["evaluate", str(job.case), str(result)])
        scores = json.loads((result / "tre.json").read_text(encoding="utf-8")) if evaluated == 0 else None
        said = said if evaluated else outcome.says
        outcome = replace(outcome, failed_gates=gates, evaluate_code=evaluated, scores=scores, says=said)
        outcome = replace(outcome, peak_mb=run["peak_mb"])
    write_whole(job.folder / OUTCOME_FILE, json.dumps(asdict(outcome), indent=1) + "\n")
    return outcome


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
    return (
        f"{len(outcomes)} cases, {sum(o.exit_code == 0 for o in outcomes)} with exit code 0. "
        f"The 95 % ellipsoid holds the nodule in {_of(held)} cases ({_of(trusted)} under exit code 0). "
        f"Their own 95 % radius holds {_sum(outcomes)} landmarks. "
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


_HEADS = (
    "case", "exit", *_PHASES.values(), "nodule", "ellipsoid holds it", "landmarks in their 95 % radius",
    "failed gates", "s", "MB", "says"
)  # fmt: skip


def _record(o: Outcome) -> dict[str, Any]:
    errors = {f"{phase}_{s}_mm": o.phase(phase, s) for phase in _PHASES for s in _STATISTICS}
    return {
        "case": o.name,
        "exit_code": o.exit_code,
        **errors,
        "nodule_mm": o.nodule_mm,
        "nodule_in_ellipsoid95": o.nodule_in_ellipsoid,
        "landmarks_in_radius95": _share(o.landmarks_in_radius),
        "silent_failure": o.silent_failure,
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
    return [o.name, str(o.exit_code), *phases, _number(o.nodule_mm), held, *tail]


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _of(flags: Sequence[bool]) -> str:
    return f"{sum(flags)} of {len(flags)}"


def _share(counts: tuple[int, int]) -> float | None:
    return counts[0] / counts[1] if counts[1] else None


def _sum(outcomes: Sequence[Outcome]) -> str:
    counts = [o.landmarks_in_radius for o in outcomes]
    return f"{sum(held for held, _ in counts)} of {sum(known for _, known in counts)}"


def _in_order(jobs: Sequence[Job], done: dict[str, Outcome]) -> list[Outcome]:
    return [done[job.folder.name] for job in jobs if job.folder.name in done]


def _asked(job: Job) -> list[str]:
    text = "" if job.settings is None else job.settings.read_text(encoding="utf-8")
    return [str(job.case), str((job.case / FILE_NAME).stat().st_mtime_ns), job.preset, text]


def _kept(job: Job) -> Outcome | None:
    """The outcome of an earlier run that asked the same; None where there is none or it ended without a word."""
    try:
        old = Outcome(**json.loads((job.folder / OUTCOME_FILE).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None
    return old if old.complete and old.asked == _asked(job) else None


def _measured(job: Job, arguments: list[str]) -> tuple[int, float, float, str]:
    """Exit code, seconds, peak memory in MB and last words of the program called with `arguments`; its talk is kept."""
    limits = {"NUMBA_NUM_THREADS": str(job.threads), "OPENBLAS_NUM_THREADS": "1"}
    log = job.folder / f"{arguments[0]}.log"
    start = time.monotonic()
    with log.open("wb") as talk:
        process = subprocess.Popen([*job.program, *arguments], stdout=talk, stderr=talk, env=os.environ | limits)
        try:
            _, status, usage = os.wait4(process.pid, 0)
        except BaseException:
            process.kill()
            process.wait()
            raise
    process.returncode = os.waitstatus_to_exitcode(status)
    words = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return process.returncode, time.monotonic() - start, usage.ru_maxrss / 1024, words[-1] if words else ""
