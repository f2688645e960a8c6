"""One case of a cohort: localized and scored, each in a process of its own, on whichever machine this runs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from vatsloc.formats.casefile import FILE_NAME
from vatsloc.formats.folder import RUN_FILE, write_whole
from vatsloc.synthetic.case import read_info

OUTCOME_FILE = "outcome.json"
SILENT_MM = 10.0
"""A nodule or a mean landmark error beyond this under exit code 0 is a silent failure."""
RIGHT_MM = 3.0
"""A nodule and tissue that are right to this on average do not deserve a failed gate."""
TRIES = 2
"""How often a case is run that a signal ends, as memory that runs out does."""


class NotSeen(Exception):
    """A case that the machine it is to run on does not see."""


@dataclass(frozen=True)
class Job:
    """One case to run. folder: for its result; settings: TOML file or None; program: how the command line is called,
    None for this one as the machine that runs it has it; threads: of its kernels, None where the machine decides;
    shares: threads by address of a Dask worker."""

    case: Path
    folder: Path
    preset: str
    settings: Path | None
    program: tuple[str, ...] | None
    threads: int | None
    shares: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Outcome:
    """How one case ended. exit_code: of localize, negative where a signal ended it; seconds: wall time of localize;
    peak_mb: as run.json says, else that of its process, no less than this one's; says: the last line of localize or
    evaluate, whichever failed; evaluate_code: exit code of evaluate, None where it had nothing to score; scores:
    tre.json, or None; asked: case, its date, preset, settings; nodule_seen: the images that show a phantom's nodule, as
    its recipe says, None where it does not say."""

    name: str
    exit_code: int
    seconds: float
    peak_mb: float
    says: str
    failed_gates: list[str]
    evaluate_code: int | None
    scores: dict[str, Any] | None
    asked: list[str]
    nodule_seen: str | None = None

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
    def false_alarm(self) -> bool | None:
        """Marked by a gate although nodule and tissue in view are right to `RIGHT_MM` on average; None where there is
        nothing to tell it by."""
        errors = [e for e in (self.tissue_mm, self.nodule_mm) if e is not None]
        return None if len(errors) < 2 else self.exit_code == 5 and max(errors) <= RIGHT_MM

    @property
    def tissue_mm(self) -> float | None:
        """Mean error of the chain at tissue in view of both scans, mm; None without dense truth."""
        dense = None if self.scores is None else self.scores.get("dense")
        return None if dense is None else dense["inside_fov"]["chain"]["mean"]

    def tissue(self, from_mm: float) -> dict[str, Any] | None:
        """Errors of tissue of one class of depth, as in tre.json; None where there is none."""
        dense = (None if self.scores is None else self.scores.get("dense")) or {"by_depth": []}
        return next((d for d in dense["by_depth"] if d["from_mm"] == from_mm and d["n"]), None)

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


def run_one(job: Job) -> Outcome:
    """Localize and score one case, each in a process of its own, and keep the outcome beside its result.

    Raises NotSeen where this machine does not see the case.
    """
    if not (job.case / FILE_NAME).is_file():
        raise NotSeen(f"{job.case} is not there on {os.uname().nodename}")
    job.folder.mkdir(parents=True, exist_ok=True)
    result = job.folder / "result"
    options = ["--preset", job.preset, *([] if job.settings is None else ["--settings", str(job.settings)])]
    for n in range(1, TRIES + 1):
        code, seconds, peak, says = _measured(job, ["localize", str(job.case), "--out", str(result), *options])
        if code >= 0 or n == TRIES:
            break
        (job.folder / "localize.log").replace(job.folder / f"localize-{n}.log")
    says = says if code else ""
    outcome = Outcome(job.folder.name, code, seconds, peak, says, [], None, None, asked_of(job), nodule_seen(job.case))
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


def nodule_seen(case: Path) -> str | None:
    """The images that show the nodule of a phantom, as its recipe says; None where it does not say."""
    seen = ((read_info(case) or {}).get("spec") or {}).get("lesion", {}).get("seen")
    return None if seen is None else str(seen)


def program_of(job: Job) -> tuple[str, ...]:
    """How the command line is called on this machine."""
    return job.program or (sys.executable, "-m", "vatsloc")


def threads_of(job: Job) -> int:
    """Threads of a case's kernels: as asked, else this worker's share of its machine, else all of its cores over the
    cases that it runs at once. NUMBA_NUM_THREADS in a worker's environment goes before its share."""
    if job.threads is not None:
        return job.threads
    stated = os.environ.get("NUMBA_NUM_THREADS", "")
    if stated.isdecimal() and int(stated) > 0:
        return int(stated)
    from distributed import get_worker

    worker = get_worker()
    return job.shares.get(worker.address) or max(1, len(os.sched_getaffinity(0)) // worker.state.nthreads)


def asked_of(job: Job) -> list[str]:
    text = "" if job.settings is None else job.settings.read_text(encoding="utf-8")
    return [str(job.case), str((job.case / FILE_NAME).stat().st_mtime_ns), job.preset, text]


def kept_outcome(job: Job) -> Outcome | None:
    """The outcome of an earlier run that asked the same; None where there is none or it ended without a word."""
    try:
        old = Outcome(**json.loads((job.folder / OUTCOME_FILE).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None
    return old if old.complete and old.asked == asked_of(job) else None


def _measured(job: Job, arguments: list[str]) -> tuple[int, float, float, str]:
    """Exit code, seconds, peak memory in MB and last words of the program called with `arguments`; its talk is kept."""
    limits = {"NUMBA_NUM_THREADS": str(threads_of(job)), "OPENBLAS_NUM_THREADS": "1"}
    log = job.folder / f"{arguments[0]}.log"
    start = time.monotonic()
    with log.open("wb") as talk:
        process = subprocess.Popen([*program_of(job), *arguments], stdout=talk, stderr=talk, env=os.environ | limits)
        try:
            _, status, usage = os.wait4(process.pid, 0)
        except BaseException:
            process.kill()
            process.wait()
            raise
    process.returncode = os.waitstatus_to_exitcode(status)
    words = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return process.returncode, time.monotonic() - start, usage.ru_maxrss / 1024, words[-1] if words else ""
