"""One guard at every reader's door: whatever a malformed file makes a library raise becomes one of our refusals.

Readers check by name what files often have wrong. This is for all the rest, so that no reader has to foresee every way
in which a header can be broken, and no caller ever sees a bare ValueError, TypeError or KeyError.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Concatenate, ParamSpec, TypeVar

import numpy as np

from vatsloc.errors import InputRefused, VatslocError

P = ParamSpec("P")
R = TypeVar("R")
_MAX_REASON = 160


@contextmanager
def reading(
    path: Path, what: str, do: str = "export it again", error: type[VatslocError] = InputRefused
) -> Iterator[None]:
    """Turn what the block raises into `error`: "PATH is not a readable WHAT (REASON); DO."

    Our own errors pass, and MemoryError, which is not the file's fault.
    """
    try:
        with np.errstate(all="ignore"):  # absurd numbers in a header are judged by the checks, not by warnings
            yield
    except (VatslocError, MemoryError):
        raise
    except Exception as caught:
        raise error(f"{path} is not a readable {what} ({_reason(caught)}); {do}.") from caught


def guarded(
    what: str, do: str = "export it again"
) -> Callable[[Callable[Concatenate[Path, P], R]], Callable[Concatenate[Path, P], R]]:
    """Decorate a reader whose first argument is a path with `reading`."""

    def decorate(reader: Callable[Concatenate[Path, P], R]) -> Callable[Concatenate[Path, P], R]:
        @functools.wraps(reader)
        def read(path: Path, *args: P.args, **kwargs: P.kwargs) -> R:
            with reading(path, what, do):
                return reader(path, *args, **kwargs)

        return read

    return decorate


def _reason(error: Exception) -> str:
    if isinstance(error, KeyError):
        return f"no {error}"
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    first = (text.strip().splitlines() or [type(error).__name__])[0].rstrip(".")
    return first if len(first) <= _MAX_REASON else first[:_MAX_REASON] + " ..."
