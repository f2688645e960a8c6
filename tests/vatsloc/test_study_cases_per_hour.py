"""Cases per hour of a Dask cluster with one and with two workers on this machine; run with -s, it tells both."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
from distributed import LocalCluster

from vatsloc.study.cohort.cohort import run_cohort
from vatsloc.synthetic.case import write_phantom

COPIES = 4


@pytest.mark.study
def test_every_case_of_one_and_of_two_workers_is_answered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The pace is told, never judged: other work on the machine would decide."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)  # a worker shares the cores among its cases
    cases = [tmp_path / "cases" / f"demo-{n}" for n in range(COPIES)]
    write_phantom("demo", cases[0])
    for copy in cases[1:]:
        shutil.copytree(cases[0], copy)
    run_cohort(cases[:1], tmp_path / "warm", "fast")  # kernels are compiled once
    for workers in (1, 2):
        said: list[str] = []
        with LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None, silence_logs=50) as cluster:
            outcomes = run_cohort(
                cases, tmp_path / f"{workers}", "fast", scheduler=cluster.scheduler_address, say=said.append
            )
        assert [outcome.exit_code in (0, 5) for outcome in outcomes] == [True] * COPIES
        assert "cases per hour" in said[-1]
        print(f"\n{workers} workers: {said[-1]} load {os.getloadavg()[0]:.1f}")
