"""Copies of the tree in which faults are planted and judged by its tests; the tree itself is never touched."""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.faults.imports import LEFT_OUT
from tests.faults.mutants import Mutant
from tests.faults.warm import Suite

Baseline = dict[str, Any]  # of a test file, as `Reach.entered` says

FAILED = re.compile(r"^(?:FAILED|ERROR|ImportError while loading conftest) (\S+)", re.MULTILINE)
TIMES, COMPILING_S = 2.0, 60.0  # a mutant hangs that computes this many times as long and as many s for kernels
NOT_RUN = (4, 5)  # pytest's exit codes for a wrong command line and for no tests


def copy_tree(root: Path, tree: Path, out: Path) -> None:
    """Copy a tree without its version history and without `out`, with the kernels and byte code compiled in it."""

    def left_out(folder: str, names: list[str]) -> set[str]:
        return {name for name in names if name in LEFT_OUT or Path(folder, name).resolve() == out.resolve()}

    shutil.copytree(root, tree, ignore=left_out)


def baseline(suite: Suite, test: str, *words: str) -> Baseline:
    """Seconds of a test file's tests without a fault and what they enter; kernels are compiled on the way.

    Exits where a test fails.
    """
    told = suite.tree.parent / "reach.json"
    told.unlink(missing_ok=True)
    code, said = suite.run([test, *words], reach=told)
    if code not in (0, 5) or not told.exists():
        raise SystemExit(f"The tests fail without a fault (pytest exits with {code}); mend them first.\n{said}")
    made: Baseline = json.loads(told.read_text("utf-8"))
    return made


def entering(told: Baseline, function: str | None) -> list[tuple[str, float]]:
    """Of a file's tests those that enter a function, each with its seconds; all where it is not known."""
    if function is None or function in told["always"]:
        return [(name, took) for name, took in told["tests"]]
    numbers = sorted({*told["reach"].get(function, ()), *told["outside"]})
    return [(name, took) for name, took in (told["tests"][number] for number in numbers)]


@contextmanager
def planted(tree: Path, mutant: Mutant, stale: Iterable[str]) -> Iterator[None]:
    """A fault in the tree. What is compiled from `stale` files is laid aside and comes back with the file.

    numba looks at the file of a kernel alone, so it would go on with kernels that hold the old code of another file;
    Python looks at seconds and size, and two mutants of a file may share both.
    """
    path = tree / mutant.file
    original, stat = path.read_bytes(), path.stat()
    with tempfile.TemporaryDirectory(dir=tree.parent) as aside:
        kept = {made: Path(aside, str(number)) for number, made in enumerate(_compiled(tree, stale))}
        for made, place in kept.items():
            made.rename(place)
        try:
            path.write_text(mutant.plant(original.decode()), encoding="utf-8")
            yield
        finally:
            path.write_bytes(original)
            os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
            for made in _compiled(tree, stale):
                made.unlink()
            for made, place in kept.items():
                place.rename(made)


def judge(
    suite: Suite, mutant: Mutant, stale: Iterable[str], words: Sequence[str], usual_s: float, only: Sequence[str] = ()
) -> dict[str, Any]:
    """Verdict of pytest's `words`, which take `usual_s` without a fault, on a mutant; by: the test that failed.

    only: names of the tests to run, all where there are none. Verdicts are killed, survived, timeout and "does not
    compile"; a mutant that no test reaches survives.
    """
    if not words:
        return {"verdict": "survived", "by": "", "seconds": 0.0}
    start = time.perf_counter()
    try:
        compile(mutant.plant((suite.tree / mutant.file).read_text(encoding="utf-8")), mutant.file, "exec")
    except SyntaxError as error:
        return {"verdict": "does not compile", "by": str(error), "seconds": 0.0}
    with planted(suite.tree, mutant, stale):
        code, said = suite.run(["-x", *words], TIMES * usual_s + COMPILING_S, only)
    failed = FAILED.search(said)
    if code in NOT_RUN and not failed:
        raise RuntimeError(f"pytest cannot run {' '.join(words)}:\n{said}")
    verdict = "survived" if code == 0 else "timeout" if code is None else "killed"
    by = failed[1] if failed else "" if code in (0, None) else f"pytest's exit code {code}"
    return {"verdict": verdict, "by": by, "seconds": round(time.perf_counter() - start, 1)}


def _compiled(tree: Path, files: Iterable[str]) -> list[Path]:
    """Byte code and kernels compiled from files of a tree."""
    return [made for file in files for made in (tree / file).parent.glob(f"__pycache__/{Path(file).stem}.*")]
