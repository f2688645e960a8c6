"""Ways a run can end before its result, each with the exit code of the command line.

Every message is one sentence that says what was found, where, and what to do.
"""

from __future__ import annotations

import errno
import linecache
from types import TracebackType

NUMERICS = ("registration", "poro")
"""Packages that refuse what they cannot work with by a ValueError; any other ValueError is a fault of the program."""
NO_SOLUTION = ("SolverError", "LinAlgError")
"""Errors of `poro` and numpy for a system without a solution, by name, since this module imports neither."""
FULL_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class VatslocError(Exception):
    """Something the user can act on; the command line prints the message and exits with `exit_code`."""

    exit_code: int = 1


class CaseError(VatslocError):
    """Wrong usage, a wrong case file, or a folder that cannot be read or written."""

    exit_code = 2


class InputRefused(VatslocError):
    """An input that is there but cannot be trusted: unreadable, not finite, no stated frame, no overlap."""

    exit_code = 3


class NoAnswer(VatslocError):
    """A stage that ended without an answer: its solver stopped, memory ran out, or an error was not foreseen."""

    exit_code = 4


class NotConverged(NoAnswer):
    """A solver stopped without an answer."""


class GateFailed(VatslocError):
    """The run finished and its result is written, but a quality gate failed."""

    exit_code = 5


def as_ours(error: Exception, where: str = "The command", image: str = "") -> VatslocError:
    """The error that `error` is to the user, with a sentence that begins with `where` and names `image` if it is known.

    Ours stay what they are, an image put in front where its sentence names none. Raise the answer `from error`.
    """
    if isinstance(error, VatslocError):
        return error if image.lower() in str(error).lower() else type(error)(f"{image}: {error}")
    where = f"{where} ({image})" if image else where
    said = " ".join(str(error).split()).rstrip(".") or "no message"
    if isinstance(error, MemoryError):
        return NoAnswer(f"{where} ran out of memory ({said}); close other programs, or take --preset fast.")
    if isinstance(error, OSError) and error.errno is not None:
        return CaseError(_of_the_system(where, error))
    if type(error) is RuntimeError or type(error).__name__ in NO_SOLUTION:
        return NotConverged(f"{where} has no answer: {said}; try another --preset, or another [mesh] edge_mm.")
    if isinstance(error, ValueError) and _stated(error.__traceback__):
        return InputRefused(f"{where} cannot work with these images: {said}.")
    return NoAnswer(
        f"{where} ended in an error that was not foreseen ({type(error).__name__}: {said}); look whether "
        f"{image or 'every image'} shows what it should, and report the fault with what --debug prints."
    )


def _of_the_system(where: str, error: OSError) -> str:
    """What the operating system refused: a full disk, or a file."""
    file = f" ({error.filename})" if error.filename else ""
    if error.errno in FULL_DISK:
        return f"{where} found no space left on the disk{file}; free some and run again, nothing half is left."
    return f"{where} met the error: {error.strerror}{file}; check path, permissions and free space."


def _stated(trace: TracebackType | None) -> bool:
    """Whether an error was raised by the numerics' own `raise`, which names what they cannot work with."""
    if trace is None:
        return False
    while trace.tb_next is not None:
        trace = trace.tb_next
    module = str(trace.tb_frame.f_globals.get("__name__", "")).partition(".")[0]
    line = linecache.getline(trace.tb_frame.f_code.co_filename, trace.tb_lineno)
    return module in NUMERICS and line.lstrip().startswith("raise ")
