"""Kernels compiled beside the first run on a machine.

numba compiles a kernel when it is first called, one after the other, and keeps the result on disk: on two cores that
doubles the first run. So a second process compiles those that take longest while the run reads and segments; the run
takes from disk what is ready by then. The kernels are the same either way, and so is the result.
"""

from __future__ import annotations

import atexit
import json
import os
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

LIST = Path(__file__).with_name("kernels.json")
"""What a run compiles, the longest first; `vatsloc bench cold` writes it."""


@dataclass(frozen=True)
class Kernel:
    """A kernel that Python calls. module, name: where it is; types: of its arguments, each its numba name, or ["array",
    type, dimensions, layout, whether it may be written to], or "tuple" or a named tuple's module:name and their types.
    """

    module: str
    name: str
    types: tuple[Any, ...]

    @property
    def dispatcher(self) -> Any:
        """The function, still to be compiled for any types. Raises AttributeError where there is none."""
        return getattr(import_module(self.module), self.name)

    @property
    def signature(self) -> tuple[Any, ...]:
        """The numba types of its arguments."""
        return tuple(_read(type_) for type_ in self.types)

    @property
    def is_compiled(self) -> bool:
        """Whether an index of what was compiled lies on disk, no older than the source."""
        source = Path(self.dispatcher.py_func.__code__.co_filename).stat().st_mtime
        found = Path(self.dispatcher.stats.cache_path).glob(f"*.{self.name}-*.nbi")
        return any(index.stat().st_mtime >= source for index in found)


def listed() -> list[Kernel]:
    """The kernels of the list, in its order."""
    return [Kernel(**{**entry, "types": tuple(entry["types"])}) for entry in json.loads(LIST.read_text("utf-8"))]


def compile_beside() -> None:
    """Start to compile in a process of its own, which ends with this one; nothing where the kernel that takes longest
    is compiled already, where there is one processor, or where no process can be started.
    """
    if (os.cpu_count() or 1) < 2 or listed()[0].is_compiled:
        return
    silent = subprocess.DEVNULL
    here = LIST.parents[1]  # another copy of the program in the folder of the command would compile for itself
    with suppress(OSError):
        process = subprocess.Popen(
            [sys.executable, "-m", __name__], stdin=silent, stdout=silent, stderr=silent, cwd=here
        )
        atexit.register(_end, process)


def compile_all() -> None:
    """Compile the kernels of the list, or read from disk what is there."""
    for kernel in listed():
        kernel.dispatcher.compile(kernel.signature)


def _read(written: Any) -> Any:
    """The numba type of an argument."""
    from numba import types

    if isinstance(written, str):
        return getattr(types, written)
    if written[0] == "array":
        _, dtype, dimensions, layout, mutable = written
        return types.Array(getattr(types, dtype), dimensions, layout, readonly=not mutable)
    module, _, name = written[0].rpartition(":")
    parts = [_read(part) for part in written[1:]]
    return types.BaseTuple.from_types(parts, getattr(import_module(module), name) if module else None)


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    process.wait()


if __name__ == "__main__":
    compile_all()
