"""The first run on a machine: what it compiles, and how long it takes alone, with kernels compiled beside it, and once
they are on disk.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numba import types
from numba.core import event

from vatsloc.precompile import Kernel, compile_beside
from vatsloc.study.bench.isolated import isolated
from vatsloc.workflow.run import run_case
from vatsloc.workflow.settings import load_settings
from vatsloc.workflow.stages import Say

CACHE = "NUMBA_CACHE_DIR"


def bench_cold(cases: list[Path], preset: str, say: Say) -> tuple[list[Kernel], dict[str, Any]]:
    """What runs of all cases compile, the longest first; seconds of the first case's run in three ways."""
    with _empty_cache():
        say("what has to be compiled ...")
        kernels = isolated(_compiled_by_runs, cases, preset)
    seconds = {}
    with _empty_cache():
        say("a first run, alone ...")
        seconds["alone"] = isolated(_run, cases[0], preset, False)
        say("a second run ...")
        seconds["compiled"] = isolated(_run, cases[0], preset, False)
    with _empty_cache():
        say("a first run, kernels compiled beside it ...")
        seconds["beside"] = isolated(_run, cases[0], preset, True)
    return kernels, {"case": cases[0].name, "preset": preset, "kernels": len(kernels), "seconds": seconds}


def table(result: dict[str, Any]) -> str:
    """The seconds as a text table."""
    s = result["seconds"]
    return "\n".join(
        (
            f"{result['case']}, preset {result['preset']}: {result['kernels']} kernels, seconds by the clock",
            f"first run, alone                   {s['alone']:6.1f}",
            f"first run, kernels compiled beside {s['beside']:6.1f}",
            f"kernels on disk                    {s['compiled']:6.1f}",
        )
    )


def as_json(kernels: list[Kernel]) -> str:
    """The text of the list of kernels, a line each."""
    lines = (json.dumps({"module": k.module, "name": k.name, "types": k.types}) for k in kernels)
    return "[\n" + ",\n".join(lines) + "\n]\n"


def compiled_by(call: Callable[[], object]) -> list[Kernel]:
    """What a call has to compile before it can go on, the longest first."""
    listener = _Listener()
    event.register("numba:compile", listener)
    try:
        call()
    finally:
        event.unregister("numba:compile", listener)
    return [kernel for _, kernel in sorted(listener.seen, key=lambda entry: -entry[0])]


class _Listener(event.Listener):
    """Notes every kernel that is compiled while no other is: those that kernels call are part of theirs."""

    def __init__(self) -> None:
        self.seen: list[tuple[float, Kernel]] = []
        self._depth, self._start = 0, 0.0

    def on_start(self, _told: Any) -> None:
        self._depth += 1
        if self._depth == 1:
            self._start = time.perf_counter()

    def on_end(self, told: Any) -> None:
        self._depth -= 1
        function = told.data["dispatcher"].py_func
        if self._depth == 0:
            written = tuple(_written(type_) for type_ in told.data["args"])
            kernel = Kernel(function.__module__, function.__name__, written)
            self.seen.append((time.perf_counter() - self._start, kernel))


def _written(type_: Any) -> Any:
    """A numba type as `Kernel` has it."""
    if isinstance(type_, types.Array):
        return ["array", str(type_.dtype), type_.ndim, type_.layout, type_.mutable]
    parts = getattr(type_, "types", None)
    if parts is not None:
        made = getattr(type_, "instance_class", tuple)  # of named tuples alone
        name = "tuple" if made is tuple else f"{made.__module__}:{made.__name__}"
        return [name, *(_written(part) for part in parts)]
    return str(type_)


@contextmanager
def _empty_cache() -> Iterator[None]:
    """A folder without kernels, for this process and those it starts."""
    before = os.environ.get(CACHE)
    with tempfile.TemporaryDirectory() as folder:
        os.environ[CACHE] = folder
        try:
            yield
        finally:
            os.environ.pop(CACHE)
            if before is not None:
                os.environ[CACHE] = before


def _compiled_by_runs(cases: list[Path], preset: str) -> list[Kernel]:
    return compiled_by(lambda: [_run(case, preset, False) for case in cases])


def _run(case: Path, preset: str, beside: bool) -> float:
    """Seconds of a run whose result is thrown away."""
    start = time.perf_counter()
    if beside:
        compile_beside()
    with tempfile.TemporaryDirectory() as folder:
        run_case(case, Path(folder) / "result", load_settings(preset, None))
    return time.perf_counter() - start
