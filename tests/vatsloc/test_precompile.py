"""Kernels compiled beside the first run on a machine."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import njit

from vatsloc import precompile
from vatsloc.cli import main
from vatsloc.errors import InputRefused
from vatsloc.precompile import LIST, Kernel, compile_beside, listed
from vatsloc.study.bench.cold import as_json, compiled_by

TOY = """
from typing import NamedTuple

import numpy as np
from numba import njit


class Pair(NamedTuple):
    first: np.ndarray
    second: np.ndarray


@njit(cache=True)
def inner(values):
    return values.sum()


@njit(cache=True)
def outer(pair, count, both):
    return inner(pair.first) + inner(pair.second) + count + both[0]
"""


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A module of two kernels, one of which calls the other, never compiled before."""
    (tmp_path / "toy_kernels.py").write_text(TOY, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "toy_kernels", raising=False)
    import toy_kernels  # type: ignore[import-not-found]

    return toy_kernels


def _call(toy: Any) -> float:
    numbers = np.arange(3.0)
    return float(toy.outer(toy.Pair(numbers, numbers), 1, (2, 3)))


def test_every_kernel_of_the_list_is_there_and_takes_such_types() -> None:
    kernels = listed()
    for kernel in kernels:
        taken = kernel.dispatcher.py_func.__code__.co_argcount
        assert len(kernel.signature) == taken, kernel.name
        assert kernel.dispatcher.stats.cache_path, f"{kernel.name} is not kept on disk"
    assert len({repr(kernel) for kernel in kernels}) == len(kernels) > 20
    assert as_json(kernels) == LIST.read_text(encoding="utf-8")


def test_a_kernel_that_another_calls_is_part_of_it(toy: Any) -> None:
    found: list[float] = []
    kernels = compiled_by(lambda: found.append(_call(toy)))
    assert found == [3.0 + 3.0 + 1 + 2]
    array = ["array", "float64", 1, "C", True]
    pair, both = ["toy_kernels:Pair", array, array], ["tuple", "int64", "int64"]
    assert kernels == [Kernel("toy_kernels", "outer", (pair, "int64", both))]
    assert compiled_by(lambda: _call(toy)) == []


def test_what_was_compiled_from_the_list_serves_the_call(toy: Any, tmp_path: Path) -> None:
    kernel = compiled_by(lambda: _call(toy))[0]
    del sys.modules["toy_kernels"]
    assert kernel.is_compiled
    os.utime(tmp_path / "toy_kernels.py", (2e9, 2e9))
    assert not kernel.is_compiled, "the source is newer"
    kernel.dispatcher.compile(kernel.signature)
    again = sys.modules["toy_kernels"]
    assert compiled_by(lambda: _call(again)) == []


def test_nothing_is_started_where_kernels_lie_on_disk_or_on_one_processor(
    toy: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel = compiled_by(lambda: _call(toy))[0]
    started: list[Path] = []
    monkeypatch.setattr(subprocess, "Popen", lambda *_, cwd, **__: started.append(cwd))
    monkeypatch.setattr(precompile.atexit, "register", lambda *_: None)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.setattr(precompile, "listed", lambda: [kernel])
    compile_beside()
    assert not started
    monkeypatch.setattr(Kernel, "is_compiled", False)
    compile_beside()
    assert started == [Path(precompile.__file__).parents[1]], "this copy of the program, wherever the command was given"
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    compile_beside()
    assert len(started) == 1


def test_a_run_goes_on_where_no_process_can_be_started(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[object] = []

    def refused(*args: object, **_: object) -> None:
        tried.append(args)
        raise OSError("no more processes")

    monkeypatch.setattr(subprocess, "Popen", refused)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.setattr(Kernel, "is_compiled", False)
    compile_beside()
    assert len(tried) == 1


def test_the_process_ends_with_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    ends: list[tuple[Callable[..., None], subprocess.Popen[bytes]]] = []
    monkeypatch.setattr(precompile.atexit, "register", lambda end, process: ends.append((end, process)))
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.setattr(Kernel, "is_compiled", False)
    compile_beside()
    [(end, process)] = ends
    assert process.poll() is None, "it should still be compiling"
    end(process)
    assert process.poll() is not None


@pytest.mark.parametrize("command", ["localize", "prepare"])
def test_commands_that_run_a_case_start_it(command: str, started: list[str], tmp_path: Path) -> None:
    started.clear()
    with pytest.raises(SystemExit):
        main([command, str(tmp_path / "no case"), "--out", str(tmp_path / "out")])
    assert started == ["compile"]


def test_the_demo_starts_it(started: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def refused(*_: object) -> None:
        raise InputRefused("no phantom")

    monkeypatch.setattr("vatsloc.synthetic.case.write_phantom", refused)
    started.clear()
    with pytest.raises(SystemExit):
        main(["demo", "--out", str(tmp_path / "demo")])
    assert started == ["compile"]


def test_the_dicom_node_starts_it(started: list[str], tmp_path: Path) -> None:
    pytest.importorskip("pynetdicom")
    started.clear()
    with pytest.raises(SystemExit):
        main(["listen", "--port", "0", "--cases", str(tmp_path), "--send", "no port"])
    assert started == ["compile"]


@njit
def _twice(x: float) -> float:
    return 2 * x


def test_a_type_that_the_list_cannot_hold_is_an_error_when_it_is_read() -> None:
    odd = compiled_by(lambda: _twice(1.0))[0]
    with pytest.raises(AttributeError):
        _ = Kernel(odd.module, odd.name, ("no such type",)).signature
