"""Benchmark of the chain and its fit: errors, seconds, whether the ellipsoid holds, and what errs without a word."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from vatsloc.formats.folder import RUN_FILE
from vatsloc.study.bench.registration import PHANTOMS, case_folder
from vatsloc.study.cohort.cohort import Outcome, find_cases, run_cohort, summary
from vatsloc.study.cohort.cohort import as_json as cohort_json
from vatsloc.study.tables import markdown
from vatsloc.workflow.stages import Say, quiet

FIT_STAGES = ("model set-up", "fit", "keypoints", "regional fit", "elastic correction")
"""What of a run is the inverse problem, by the names of run.json."""


def bench_fit(
    folders: Sequence[Path],
    out: Path | None = None,
    jobs: int = 1,
    program: tuple[str, ...] | None = None,
    say: Say = quiet,
) -> dict[str, Any]:
    """Localize and score case folders, folders of them, or phantoms "NAME:SEED" (three of them when none is given).

    Results stay in `out`, where a rerun goes on; without it they are thrown away. Returns "cases" with the clock's
    "seconds" of localize and "seconds_fit" of its inverse problem, "chain_mean" over the landmarks and "nodule_mm" in
    mm, "in_ellipsoid95", "exit_code"; and "coverage95", "silent_failure_share", "summary". What a case has no truth for
    is None. Raises CaseError as `find_cases` does.
    """
    with TemporaryDirectory() as temporary:
        results = out or Path(temporary) / "out"
        cases = find_cases([case_folder(given, Path(temporary), say) for given in folders or PHANTOMS])
        outcomes = run_cohort(cases, results, jobs=jobs, program=program, say=say)
        rows = [_row(outcome, results) for outcome in outcomes]
    shares = {key: value for key, value in cohort_json(outcomes).items() if key != "cases"}
    return {"cases": rows, **shares, "summary": summary(outcomes)}


def table(result: dict[str, Any]) -> str:
    """The benchmark as text."""
    return f"{markdown(result['cases'])}\n\n{result['summary']}"


def _row(outcome: Outcome, results: Path) -> dict[str, Any]:
    run = results / outcome.name / "result" / RUN_FILE
    stages = json.loads(run.read_text(encoding="utf-8"))["seconds"] if outcome.scores is not None else None
    return {
        "name": outcome.name,
        "seconds": round(outcome.seconds, 3),
        "seconds_fit": None if stages is None else round(sum(stages.get(name, 0.0) for name in FIT_STAGES), 1),
        "chain_mean": outcome.phase("chain", "mean"),
        "nodule_mm": outcome.nodule_mm,
        "in_ellipsoid95": outcome.nodule_in_ellipsoid,
        "exit_code": outcome.exit_code,
    }
