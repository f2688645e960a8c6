"""Copies of the tree in which faults are planted and judged by its tests; the tree itself is never touched."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from tests.faults.imports import LEFT_OUT
from tests.faults.mutants import Mutant

FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)
FAILED_FILE = re.compile(r"^(?:FAILED|ERROR) ([^\s:]+)", re.MULTILINE)
TIMES, COMPILING_S = 2.0, 60.0  # a mutant hangs that takes this many times as long and as many seconds for kernels
RUN = (0, 1, 5)  # pytest's exit codes for all passed, some failed, and none left after --deselect
NOT_RUN = (4, 5)  # pytest's exit codes for a wrong command line and for no tests


def copy_tree(root: Path, tree: Path, out: Path) -> None:
    """Copy a tree without its version history and without `out`, with the kernels and byte code compiled in it."""

    def left_out(folder: str, names: list[str]) -> set[str]:
        return {name for name in names if name in LEFT_OUT or Path(folder, name).resolve() == out.resolve()}

    shutil.copytree(root, tree, ignore=left_out)


def run_tests(tree: Path, words: Sequence[str], timeout: float | None = None) -> tuple[int | None, str]:
    """Exit code of pytest in a tree, None where it takes longer than `timeout` s, and what it says."""
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    process = subprocess.Popen(
        [sys.executable, "-m", "pytest", "-q", "--tb=no", "-n0", "-p", "no:cacheprovider", *words],
        cwd=tree,
        env=inherited | {"PYTHONPATH": str(tree), "OPENBLAS_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,  # so that whatever a test started ends with it
    )
    try:
        said, _ = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        return None, ""
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
    return process.returncode, said


def baseline(tree: Path, tests: Sequence[str], *words: str, log: Path | None = None) -> dict[str, float]:
    """Seconds of each test file without a fault, kernels being compiled on the way. Exits where a test fails.

    log: JSON file of the seconds of files that passed, which are not run again.
    """
    known: dict[str, float] = json.loads(log.read_text("utf-8")) if log is not None and log.exists() else {}
    waiting = [test for test in tests if test not in known]
    if waiting:
        report = tree.parent / "baseline.xml"
        code, said = run_tests(tree, [*waiting, *words, f"--junitxml={report}"])
        seconds, failed = dict.fromkeys(waiting, 0.0), set(FAILED_FILE.findall(said))
        for case in ElementTree.parse(report).iter("testcase") if code in RUN else ():
            seconds[f"{case.attrib['classname'].replace('.', '/')}.py"] += float(case.attrib["time"])
        known |= {test: took for test, took in seconds.items() if code in RUN and test not in failed}
        if log is not None:
            log.write_text(json.dumps(known, indent=1), encoding="utf-8")
        if code not in (0, 5):
            raise SystemExit(f"The tests fail without a fault (pytest exits with {code}); mend them first.\n{said}")
    return {test: known[test] for test in tests}


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


def judge(tree: Path, mutant: Mutant, stale: Iterable[str], words: Sequence[str], usual_s: float) -> dict[str, Any]:
    """Verdict of pytest's `words`, which take `usual_s` without a fault, on a mutant; by: the test that failed.

    Verdicts are killed, survived, timeout and "does not compile"; a mutant that no test reaches survives.
    """
    if not words:
        return {"verdict": "survived", "by": "", "seconds": 0.0}
    start = time.perf_counter()
    try:
        compile(mutant.plant((tree / mutant.file).read_text(encoding="utf-8")), mutant.file, "exec")
    except SyntaxError as error:
        return {"verdict": "does not compile", "by": str(error), "seconds": 0.0}
    with planted(tree, mutant, stale):
        code, said = run_tests(tree, ["-x", *words], TIMES * usual_s + COMPILING_S)
    failed = FAILED.search(said)
    if code in NOT_RUN and not failed:
        raise RuntimeError(f"pytest cannot run {' '.join(words)}:\n{said}")
    verdict = "survived" if code == 0 else "timeout" if code is None else "killed"
    by = failed[1] if failed else "" if code in (0, None) else f"pytest's exit code {code}"
    return {"verdict": verdict, "by": by, "seconds": round(time.perf_counter() - start, 1)}


def _compiled(tree: Path, files: Iterable[str]) -> list[Path]:
    """Byte code and kernels compiled from files of a tree."""
    return [made for file in files for made in (tree / file).parent.glob(f"__pycache__/{Path(file).stem}.*")]
