"""A Dask scheduler that is dead, mistaken, empty or dies: one sentence each. Dask itself is stood in for."""

from __future__ import annotations

import sys
from concurrent.futures import CancelledError, ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import pytest

from vatsloc.errors import CaseError
from vatsloc.study.cohort.pool import CONNECT_S, pool


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

    def get_executor(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(1)


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> type[Client]:
    kind: Any = type("Client", (Client,), {})
    monkeypatch.setitem(sys.modules, "distributed", SimpleNamespace(Client=kind))
    return kind


def test_workers_of_a_scheduler_run_the_cases(client: type[Client]) -> None:
    with pool(1, "tcp://host:8786") as executor:
        assert executor.submit(pow, 2, 5).result() == 32


@pytest.mark.parametrize(
    "error", [OSError("Timed out trying to connect after 3 s"), ValueError("missing port number in address")]
)
def test_a_dead_scheduler_is_named_at_once(client: type[Client], error: Exception) -> None:
    client.fails = error
    sentence = rf"no Dask scheduler answers at tcp://host:8786 \({error}\); start it \(dask scheduler\), or correct"
    with pytest.raises(CaseError, match=sentence), pool(1, "tcp://host:8786"):
        pass


def test_a_scheduler_without_workers_is_named(client: type[Client]) -> None:
    client.workers = 0
    with pytest.raises(CaseError, match="has no workers after 10 s; start some"), pool(1, "tcp://host:8786"):
        pass


def test_a_scheduler_that_dies_is_named(client: type[Client]) -> None:
    sentence = "tcp://host:8786 stopped answering; start it and run again, what is done is kept"
    with pytest.raises(CaseError, match=sentence), pool(1, "tcp://host:8786"):
        raise CancelledError("lost")


def test_errors_of_the_cases_themselves_pass(client: type[Client]) -> None:
    with pytest.raises(OSError, match="disk"), pool(1, "tcp://host:8786"):
        raise OSError("disk")
