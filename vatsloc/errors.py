"""Ways a run can end before its result, each with the exit code of the command line.

Every message is one sentence that says what was found, where, and what to do.
"""

from __future__ import annotations


class VatslocError(Exception):
    """Something the user can act on; the command line prints the message and exits with `exit_code`."""

    exit_code: int = 1


class CaseError(VatslocError):
    """Wrong usage or a wrong case file."""

    exit_code = 2


class InputRefused(VatslocError):
    """An input that is there but cannot be trusted: unreadable, not finite, no stated frame, no overlap."""

    exit_code = 3


class NotConverged(VatslocError):
    """A solver stopped without an answer."""

    exit_code = 4


class GateFailed(VatslocError):
    """The run finished and its result is written, but a quality gate failed."""

    exit_code = 5
