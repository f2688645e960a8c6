"""Work shared among threads by kernels that are told which part of it is theirs.

numba's own parallel loops take twice to four times as long to compile, and their threads serve one caller at a time;
these serve any number of stages that run side by side. Kernels have to be compiled with `nogil`.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

from numba import get_num_threads

Done = TypeVar("Done")
PARTS_A_THREAD = 8
"""A thread that is done early takes part of what is left."""
MANY_POINTS = 30_000
"""For fewer points waking threads takes longer than what a kernel does at each."""


def in_parts(work: Callable[[int, int], object], n: int, least: int = 1) -> None:
    """Call work(first, end) until 0..n is done, in parts on all threads; at once where n is below `least`.

    Every index has to be independent of all others, so that parts and threads do not show in the result. Raises what
    `work` raises.
    """
    threads = 1 if n < max(least, 2) else get_num_threads()  # which takes as long as a small kernel
    if threads == 1:
        work(0, n)
        return
    parts = min(n, threads * PARTS_A_THREAD)
    list(_pool(os.getpid(), threads).map(lambda c: work(n * c // parts, n * (c + 1) // parts), range(parts)))


def ahead(work: Callable[[], Done]) -> Callable[[], Done]:
    """Begin on another thread what will probably be asked for, with one thread nothing; what is returned gives the
    result, or raises what the work raises.
    """
    if get_num_threads() == 1:
        return work
    other = ThreadPoolExecutor(1, thread_name_prefix="ahead")
    begun = other.submit(work)
    other.shutdown(wait=False)
    return begun.result


@cache
def _pool(_process: int, threads: int) -> ThreadPoolExecutor:
    """The threads of a process; a forked one needs its own."""
    return ThreadPoolExecutor(threads, thread_name_prefix="kernel")
