"""Work shared among threads: every index once, whatever the number of threads, and errors come through."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from registration.kernels import threads
from registration.kernels.threads import ahead, in_parts


@pytest.fixture
def two_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two, also where the machine has one."""
    monkeypatch.setattr(threads, "get_num_threads", lambda: 2)


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize("n", [0, 1, 2, 7, 16, 17, 1000])
def test_every_index_is_done_once(n: int) -> None:
    done, lock = np.zeros(n, dtype=int), threading.Lock()

    def work(first: int, end: int) -> None:
        with lock:
            done[first:end] += 1

    in_parts(work, n)
    assert (done == 1).all()


@pytest.mark.usefixtures("two_threads")
def test_little_work_is_done_at_once_by_the_caller() -> None:
    calls: list[tuple[int, int, bool]] = []

    def work(first: int, end: int) -> None:
        calls.append((first, end, threading.current_thread() is threading.main_thread()))

    in_parts(work, 99, least=100)
    assert calls == [(0, 99, True)]
    in_parts(work, 100, least=100)
    parts = sorted(calls[1:])
    assert len(parts) > 1
    assert not any(main for _, _, main in parts)
    assert [first for first, _, _ in parts] == [0, *(end for _, end, _ in parts[:-1])]


def test_one_thread_needs_no_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "get_num_threads", lambda: 1)
    calls: list[tuple[int, int]] = []
    in_parts(lambda first, end: calls.append((first, end)), 1000)
    assert calls == [(0, 1000)]


@pytest.mark.usefixtures("two_threads")
def test_what_a_part_raises_reaches_the_caller() -> None:

    def work(first: int, end: int) -> None:
        if first <= 500 < end:
            raise ValueError("index 500")

    with pytest.raises(ValueError, match="index 500"):
        in_parts(work, 1000)


@pytest.mark.usefixtures("two_threads")
def test_what_will_be_asked_for_is_begun_on_another_thread() -> None:
    begun, go = threading.Event(), threading.Event()

    def work() -> threading.Thread:
        begun.set()
        assert go.wait(10)
        return threading.current_thread()

    result = ahead(work)
    assert begun.wait(10)
    go.set()
    assert result() is not threading.main_thread()


@pytest.mark.usefixtures("two_threads")
def test_what_work_ahead_raises_is_raised_where_it_is_asked_for() -> None:
    result = ahead(lambda: [][1])
    with pytest.raises(IndexError):
        result()


def test_with_one_thread_work_is_done_when_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "get_num_threads", lambda: 1)
    calls: list[int] = []
    result = ahead(lambda: calls.append(1))
    assert calls == []
    result()
    assert calls == [1]
