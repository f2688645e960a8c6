"""A cohort on a real Dask cluster: other workers than the client, a worker and a scheduler that die in mid-run."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import sysconfig
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from distributed import Client, LocalCluster

from tests.vatsloc.dcmtk import free_port
from vatsloc.errors import CaseError
from vatsloc.study.cohort.cohort import LOST, progress, run_cohort
from vatsloc.study.cohort.job import Job, NotSeen, program_of, run_one, threads_of

PROGRAM = """
import json, os, sys, time
from pathlib import Path
command, case, *rest = sys.argv[1:]
here = Path(__file__).parent
if command == "evaluate":
    sys.exit(2)
with (here / "calls").open("a") as calls:
    calls.write(f"{Path(case).name}\\n")
print("words of", Path(case).name, flush=True)
while Path(case).name.startswith("slow") and not (here / "go").exists():
    time.sleep(0.05)
out = Path(rest[1])
out.mkdir(exist_ok=True)
(out / "run.json").write_text(json.dumps({"gates": {}, "peak_mb": int(os.environ["NUMBA_NUM_THREADS"]), "seconds": {}}))
"""


@pytest.fixture
def program(tmp_path: Path) -> tuple[str, ...]:
    (tmp_path / "program.py").write_text(PROGRAM)
    return (sys.executable, str(tmp_path / "program.py"))


def make(tmp_path: Path, *names: str) -> list[Path]:
    for name in names:
        (tmp_path / "cases" / name).mkdir(parents=True)
        (tmp_path / "cases" / name / "case.toml").write_text("")
    return [tmp_path / "cases" / name for name in names]


@pytest.fixture(scope="module")
def cluster() -> Iterator[LocalCluster]:
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50) as made:
        yield made


def until(what: Callable[[], bool], seconds: float = 240.0) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end
        time.sleep(0.05)


def calls(tmp_path: Path) -> list[str]:
    file = tmp_path / "calls"
    return file.read_text().split() if file.exists() else []


def test_a_worker_killed_in_mid_run_costs_no_case(
    cluster: LocalCluster, program: tuple[str, ...], tmp_path: Path
) -> None:
    cases = make(tmp_path, "slow-1", "slow-2", "three", "four")
    said: list[str] = []
    with Client(cluster) as client:
        pids = client.run(os.getpid)
    outcomes = []
    thread = threading.Thread(
        target=lambda: outcomes.extend(
            run_cohort(cases, tmp_path / "out", scheduler=cluster.scheduler_address, program=program, say=said.append)
        )
    )
    thread.start()
    try:
        until(lambda: {"slow-1", "slow-2"} <= set(calls(tmp_path)))
        os.kill(next(iter(pids.values())), signal.SIGKILL)
        until(lambda: len([name for name in calls(tmp_path) if name.startswith("slow")]) >= 3)  # given out again
    finally:
        (tmp_path / "go").touch()
        thread.join(240)
    assert [(o.name, o.exit_code) for o in outcomes] == [(case.name, 0) for case in cases]
    assert "4/4" in said[-1]
    for case in cases:
        assert (tmp_path / "out" / case.name / "localize.log").read_text() == f"words of {case.name}\n"
    assert (tmp_path / "out" / "cohort.md").read_text().count("\n| ") == 4 + 0
    assert list((tmp_path / "out").glob(".shared-*")) == []


def test_threads_are_those_of_the_worker(
    cluster: LocalCluster, program: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The client's own setting does not count: peak_mb of the stand-in tells the threads it was given."""
    with Client(cluster) as client:
        client.run(os.putenv, "UNUSED", "")
        client.run(set_threads, "3")
        cases = make(tmp_path, "one")
        monkeypatch.setenv("NUMBA_NUM_THREADS", "7")
        (outcome,) = run_cohort(cases, tmp_path / "out", scheduler=cluster.scheduler_address, program=program)
        assert outcome.peak_mb == 3
        client.run(set_threads, "")
        share = dict.fromkeys(client.run(os.getpid), 5)
        job = Job(cases[0], tmp_path, "fast", None, None, None, share)
        assert client.submit(threads_of, job, pure=False).result() == 5


def set_threads(n: str) -> None:
    os.environ["NUMBA_NUM_THREADS"] = n


class Cluster:
    """A scheduler and a worker in processes of their own; the worker's Python is another program file."""

    def __init__(self, folder: Path) -> None:
        self.python = folder / "python-of-the-worker"
        self.python.symlink_to(os.path.realpath(sys.executable))
        root, site = Path(__file__).parents[2], sysconfig.get_paths()["purelib"]
        path = os.environ | {"PYTHONPATH": f"{root}:{site}"}
        self.address = f"tcp://127.0.0.1:{free_port()}"
        port = self.address.rpartition(":")[2]
        scheduler = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", port]
        worker = [str(self.python), "-m", "distributed.cli.dask_worker", self.address, "--nthreads", "1", "--no-nanny"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self.scheduler = subprocess.Popen([*scheduler, "--no-dashboard"], env=path, **quiet)  # type: ignore[call-overload]
        until(lambda: self._answers(int(port)))
        self.worker = subprocess.Popen([*worker, "--no-dashboard"], env=path, cwd=folder, **quiet)  # type: ignore[call-overload]

    @staticmethod
    def _answers(port: int) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    def close(self) -> None:
        for process in (self.worker, self.scheduler):
            process.kill()
            process.wait()


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Cluster]:
    made = Cluster(tmp_path)
    try:
        yield made
    finally:
        made.close()


def test_the_program_is_the_worker_s_and_a_scheduler_that_dies_in_mid_run_is_named(
    processes: Cluster, program: tuple[str, ...], tmp_path: Path
) -> None:
    job = Job(tmp_path, tmp_path, "fast", None, None, None)
    assert program_of(job)[0] == sys.executable
    with Client(processes.address) as client:
        client.wait_for_workers(1, timeout=240)
        assert client.submit(program_of, job).result(60) == (str(processes.python), "-m", "vatsloc")
    cases = make(tmp_path, "first", "slow-2")
    (outcome,) = run_cohort(cases[:1], tmp_path / "out", scheduler=processes.address, program=program)
    assert outcome.exit_code == 0
    failed: list[BaseException] = []

    def run() -> None:
        try:
            run_cohort(cases, tmp_path / "out", scheduler=processes.address, program=program)
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        until(lambda: "slow-2" in calls(tmp_path))
        processes.scheduler.send_signal(signal.SIGKILL)
        thread.join(240)
    finally:
        (tmp_path / "go").touch()
    assert isinstance(failed[0], CaseError)
    assert "stopped answering; start it and run again, what is done is kept" in str(failed[0])
    assert json.loads((tmp_path / "out" / "first" / "outcome.json").read_text())["exit_code"] == 0
    with pytest.raises(CaseError, match="no Dask scheduler answers at"):
        run_cohort(cases, tmp_path / "out", scheduler=processes.address, program=program)


def test_a_case_that_a_signal_ends_is_run_once_more_and_both_logs_are_kept(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(
        PROGRAM + 'if len((here / "calls").read_text().split()) == 1:\n    os.kill(os.getpid(), 9)\n'
    )
    (case,) = make(tmp_path, "one")
    job = Job(case, tmp_path / "out" / "one", "fast", None, (sys.executable, str(tmp_path / "program.py")), 1)
    assert run_one(job).exit_code == 0
    assert calls(tmp_path) == ["one", "one"]
    assert sorted(p.name for p in (tmp_path / "out" / "one").glob("localize*.log")) == [
        "localize-1.log",
        "localize.log",
    ]


def test_a_case_that_is_not_there_is_told_and_run_again_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case = tmp_path / "gone"
    with pytest.raises(NotSeen, match="is not there on"):
        run_one(Job(case, tmp_path / "out", "fast", None, None, 1))
    (there,) = make(tmp_path, "there")
    monkeypatch.setattr("vatsloc.study.cohort.cohort.run_one", lost)
    said: list[str] = []
    (outcome,) = run_cohort([there], tmp_path / "out", say=said.append)
    assert (outcome.exit_code, outcome.complete) == (LOST, False)
    assert "every worker that took it died" in said[-1]


class KilledWorker(Exception):
    """As Dask calls it."""


def lost(job: Job) -> None:
    raise KilledWorker(job.case.name)


def test_progress_tells_what_is_done_and_what_is_left_and_at_the_end_the_pace() -> None:
    assert progress(5, 20, 4, 480.0) == "[#####...............] 5/20, 30 min left;"
    assert progress(20, 20, 4, 480.0) == "[####################] 20/20, 30 cases per hour;"
