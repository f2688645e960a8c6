"""A Dask scheduler that is dead, mistaken, empty or dies: one sentence each.

Dask itself is stood in for; a real one runs in `test_cohort_cluster`.
"""

from __future__ import annotations

import sys
from concurrent.futures import CancelledError, ThreadPoolExecutor
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from vatsloc.errors import CaseError
from vatsloc.study.cohort.pool import CONNECT_S, Seen, _shares, pool


class Client:
    """What Dask's client did, tried by hand with distributed 2026.8 against real schedulers."""

    fails: Exception | None = None
    workers = 1

    def __init__(self, address: str, timeout: float) -> None:
        assert (address, timeout) == ("tcp://host:8786", CONNECT_S)
        self.status = "running"
        if self.fails is not None:
            raise self.fails

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_error: object) -> None:
        self.status = "closed"

    def wait_for_workers(self, n: int, timeout: float) -> None:
        if self.workers < n:
            raise TimeoutError(f"Only {self.workers}/{n} workers arrived after {timeout} s")

    def run(self, look: Any, out: str, token: str, cases: list[str]) -> dict[str, Seen]:
        (Path(out) / f"{token}-mark").touch()
        return {"tcp://w1": Seen("host", (0, 1, 2, 3), 1, version("vatsloc"), f"{token}-mark", ())}

    def get_executor(self, pure: bool, retries: int) -> ThreadPoolExecutor:
        assert (pure, retries) == (False, 2)
        return ThreadPoolExecutor(1)


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> type[Client]:
    kind: Any = type("Client", (Client,), {})
    monkeypatch.setitem(sys.modules, "distributed", SimpleNamespace(Client=kind))
    return kind


def test_workers_of_a_scheduler_run_the_cases(client: type[Client], tmp_path: Path) -> None:
    with pool(1, "tcp://host:8786", tmp_path, []) as place:
        assert place.executor.submit(pow, 2, 5).result() == 32


@pytest.mark.parametrize(
    "error", [OSError("Timed out trying to connect after 3 s"), ValueError("missing port number in address")]
)
def test_a_dead_scheduler_is_named_at_once(client: type[Client], tmp_path: Path, error: Exception) -> None:
    client.fails = error
    sentence = rf"no Dask scheduler answers at tcp://host:8786 \({error}\); start it \(dask scheduler\), or correct"
    with pytest.raises(CaseError, match=sentence), pool(1, "tcp://host:8786", tmp_path, []):
        pass


def test_a_scheduler_without_workers_is_named(client: type[Client], tmp_path: Path) -> None:
    client.workers = 0
    with (
        pytest.raises(CaseError, match="has no workers after 10 s; start some"),
        pool(1, "tcp://host:8786", tmp_path, []),
    ):
        pass


def test_a_scheduler_that_dies_is_named(client: type[Client], tmp_path: Path) -> None:
    sentence = "tcp://host:8786 stopped answering; start it and run again, what is done is kept"
    with pytest.raises(CaseError, match=sentence), pool(1, "tcp://host:8786", tmp_path, []):
        raise CancelledError("lost")


def test_errors_of_the_cases_themselves_pass(client: type[Client], tmp_path: Path) -> None:
    with pytest.raises(OSError, match="disk"), pool(1, "tcp://host:8786", tmp_path, []):
        raise OSError("disk")


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"version": "9.9"}, "the Dask worker tcp://w1 has vatsloc 9.9, this is .*; install the same"),
        ({"mark": ""}, "the Dask worker tcp://w1 on host does not share .* with this machine; start workers where"),
        ({"mark": "elsewhere"}, "does not share"),
        ({"missing": ("/cases/a",)}, r"does not see 1 of 2 cases \(/cases/a\); put them where all machines have them"),
    ],
)
def test_workers_of_another_version_or_without_the_same_disk_are_named(
    client: type[Client], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, changes: dict[str, Any], says: str
) -> None:
    whole = Client.run

    def run(self: Client, look: Any, out: str, token: str, cases: list[str]) -> dict[str, Seen]:
        return {name: replace(seen, **changes) for name, seen in whole(self, look, out, token, cases).items()}

    monkeypatch.setattr(client, "run", run, raising=False)
    with (
        pytest.raises(CaseError, match=says),
        pool(1, "tcp://host:8786", tmp_path, [Path("/cases/a"), Path("/cases/b")]),
    ):
        pass
    assert list(tmp_path.iterdir()) == []  # no mark is left


def test_workers_without_this_program_are_named(
    client: type[Client], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def run(self: Client, *_: object) -> None:
        raise ModuleNotFoundError("No module named 'vatsloc'")

    monkeypatch.setattr(client, "run", run, raising=False)
    sentence = r"the Dask workers cannot run vatsloc \(No module named 'vatsloc'\); install it where they run"
    with pytest.raises(CaseError, match=sentence), pool(1, "tcp://host:8786", tmp_path, []):
        pass


def test_cores_are_shared_by_the_cases_that_run_on_them_at_once() -> None:
    def seen(host: str, cores: range, threads: int) -> Seen:
        return Seen(host, tuple(cores), threads, "", "", ())

    told = {
        "a": seen("one", range(8), 1),
        "b": seen("one", range(8), 1),  # beside a, on the same cores
        "c": seen("two", range(4), 1),
        "d": seen("two", range(4, 8), 2),  # on the same machine, but with cores of its own
        "e": seen("three", range(2), 4),
    }
    assert _shares(told) == {"a": 4, "b": 4, "c": 4, "d": 2, "e": 1}
