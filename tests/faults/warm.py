"""Runs pytest in forks of a process that has imported what takes long, and notes which functions each test enters.

`Suite` talks to this file, which runs as a script in a process of its own: a line of JSON per run on stdin, the fork's
number and its exit status on stdout.
"""

from __future__ import annotations

import gc
import importlib
import json
import os
import re
import resource
import select
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, TextIO

import pytest

ALIVE = 10.0  # a run that waits is ended after this many times the seconds that it may compute
CACHED = re.compile(r"@\S*cache\S*.*\n(?:\s*@.*\n)*\s*def (\w+)")
ONCE = "made_once"  # ours that keeps what it made
STARTS = ("subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn")
FOREIGN, OURS, KEPT = range(3)


class Reach:
    """Plugin of pytest: which functions of a tree each test enters, by `file:line` of their first lines.

    What a fixture of wider scope enters counts for all tests that ask for it; what is entered while the tests are
    collected, or by a function whose result is kept, for all tests. So does every function for a test that starts
    another process, since nobody sees what that one enters.
    """

    def __init__(self, root: Path) -> None:
        self.root = f"{root}{os.sep}"
        self.kinds: dict[CodeType, int] = {}
        self.kept: dict[str, set[str]] = {}
        self.always: set[CodeType] = set()
        self.here: set[CodeType] = set()
        self.depth = 0
        self.outside = False
        self.fixtures: dict[int, set[CodeType]] = defaultdict(set)
        self.tests: dict[str, tuple[float, bool, list[set[CodeType]]]] = {}
        sys.addaudithook(self._note)

    def _note(self, event: str, _: object) -> None:
        self.outside |= event in STARTS

    def _kind(self, code: CodeType) -> int:
        file = code.co_filename
        if not file.startswith(self.root):
            return FOREIGN
        if file not in self.kept:
            self.kept[file] = {ONCE, *CACHED.findall(Path(file).read_text(encoding="utf-8"))}
        return KEPT if code.co_name in self.kept[file] else OURS

    def _enter(self, frame: FrameType, event: str, _: object) -> Any:
        code = frame.f_code
        kind = self.kinds.get(code)
        if kind is None:
            kind = self.kinds[code] = self._kind(code)
        if kind == FOREIGN:
            return None
        self.here.add(code)
        if kind == KEPT:
            self.depth += 1
            frame.f_trace_lines = False
        if self.depth:
            self.always.add(code)
        return self._leave if kind == KEPT else None

    def _leave(self, _: FrameType, event: str, __: object) -> Any:
        self.depth -= event == "return"
        return self._leave

    @pytest.hookimpl(wrapper=True)
    def pytest_collection(self) -> Iterator[None]:
        if "numba" in sys.modules:
            _while_compiling(lambda: sys.settrace(None), lambda: sys.settrace(self._enter))
        threading.settrace(self._enter)
        sys.settrace(self._enter)
        said = yield
        self.always |= self.here
        return said

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        self.here, self.outside, start = set(), False, time.process_time()
        said = yield
        info = getattr(item, "_fixtureinfo", None)
        asked = [made for several in info.name2fixturedefs.values() for made in several] if info else []
        shared = [self.fixtures[id(made)] for made in asked]
        self.tests[item.nodeid] = (time.process_time() - start, self.outside, [self.here, *shared])
        return said

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef[Any]) -> Iterator[None]:
        before, self.here = self.here, set()
        try:
            return (yield)
        finally:
            if fixturedef.scope != "function":
                self.fixtures[id(fixturedef)] |= self.here
            self.here |= before

    def entered(self) -> dict[str, Any]:
        """tests: [name, seconds] each; outside: numbers of those that start a process; always: functions; reach: the
        tests' numbers by function.
        """

        def name(code: CodeType) -> str:
            return f"{code.co_filename.removeprefix(self.root)}:{code.co_firstlineno}"

        reach: dict[str, list[int]] = defaultdict(list)
        for number, (_, _, parts) in enumerate(self.tests.values()):
            for key in sorted({name(code) for part in parts for code in part}):
                reach[key].append(number)
        return {
            "tests": [[test, round(took, 3)] for test, (took, _, _) in self.tests.items()],
            "outside": [number for number, (_, outside, _) in enumerate(self.tests.values()) if outside],
            "always": sorted(map(name, self.always)),
            "reach": reach,
        }


def _while_compiling(begin: Callable[[], None], end: Callable[[], None]) -> None:
    """Calls when numba begins and ends to compile: watched, it would take five times as long."""
    from numba.core import event

    class Listener(event.Listener):  # type: ignore[misc]
        depth = 0

        def on_start(self, _: object) -> None:
            self.depth += 1
            begin()

        def on_end(self, _: object) -> None:
            self.depth -= 1
            if not self.depth:
                end()

    event.register("numba:compile", Listener())


class Only:
    """Plugin of pytest: of the tests collected those of these names."""

    def __init__(self, names: Collection[str]) -> None:
        self.names = set(names)

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """All where none has such a name, since a fault may change the names of tests."""
        items[:] = [item for item in items if item.nodeid in self.names] or items


class Suite:
    """pytest in a tree. warm: modules to import before, as far as they are there."""

    def __init__(self, tree: Path, warm: Sequence[str] = ()) -> None:
        self.tree = tree
        inherited = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
        threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
        self._server = subprocess.Popen(
            [sys.executable, "-P", __file__, *warm],
            cwd=tree,
            env=inherited | threads | {"PYTHONPATH": str(tree)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            start_new_session=True,
        )

    def __enter__(self) -> Suite:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.communicate()

    def run(
        self, words: Sequence[str], limit_s: float | None = None, only: Collection[str] = (), reach: Path | None = None
    ) -> tuple[int | None, str]:
        """Exit code of pytest, None where it computes for longer than `limit_s`, and what it says.

        only: names of the tests to run, all where there are none; reach: file for what `Reach.entered` says.
        """
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        with tempfile.NamedTemporaryFile("r", encoding="utf-8", errors="replace", dir=self.tree.parent) as said:
            asked = {"tree": str(self.tree), "words": [*words], "limit_s": limit_s, "said": said.name}
            asked |= {"only": sorted(only), "reach": reach and str(reach)}
            self._server.stdin.write(f"{json.dumps(asked)}\n".encode())
            fork, code = int(self._server.stdout.readline()), None
            try:
                patience = None if limit_s is None else ALIVE * limit_s
                if select.select([self._server.stdout], [], [], patience)[0]:
                    code = int(self._server.stdout.readline())
            finally:
                if code is None:
                    os.killpg(fork, signal.SIGKILL)
                    self._server.stdout.readline()
            return (None if code in (None, -signal.SIGXCPU, -signal.SIGKILL) else code), said.read()


def _pytest(asked: dict[str, Any]) -> int:
    """One run, in the fork: what it starts ends with it, and what it says goes to a file."""
    os.setsid()
    if asked["limit_s"] is not None:
        limit = int(asked["limit_s"]) + 1
        resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5))
    with open(asked["said"], "w") as said, open(os.devnull) as nothing:
        os.dup2(nothing.fileno(), 0)
        os.dup2(said.fileno(), 1)
        os.dup2(said.fileno(), 2)
    os.chdir(asked["tree"])
    sys.path.insert(0, asked["tree"])
    importlib.invalidate_caches()
    plugins: list[Any] = [Only(asked["only"])] if asked["only"] else []
    reach = Reach(Path(asked["tree"])) if asked["reach"] else None
    plugins += [reach] if reach else []
    warm = ["-W", "ignore::pytest.PytestAssertRewriteWarning"]  # plugins that are warm
    code = pytest.main(["-q", "--tb=no", "-n0", "-p", "no:cacheprovider", *warm, *asked["words"]], plugins)
    sys.settrace(None)
    if reach:
        Path(asked["reach"]).write_text(json.dumps(reach.entered()), encoding="utf-8")
    return int(code)


def serve(asks: TextIO, answer: Any) -> None:
    """A fork for every line."""
    for line in asks:
        fork = os.fork()
        if not fork:
            code = 1
            try:
                code = _pytest(json.loads(line))
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(code)
        answer(fork)
        answer(os.waitstatus_to_exitcode(os.waitpid(fork, 0)[1]))


if __name__ == "__main__":
    for module in sys.argv[1:]:
        try:
            importlib.import_module(module)
        except ImportError:
            continue
    gc.freeze()  # so that forks leave alone what they share
    serve(sys.stdin, partial(print, flush=True))
