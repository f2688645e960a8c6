"""The breathing lung: a case in, states of a breath out, one driver per paper.

`read_breath` reads a case, `breathe_case` runs a driver on it and writes the results. A driver is a function of a case
and a number of states that returns a `Motion`; `score` alone sees landmarks.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vatsloc.lazy import on_first_use

if TYPE_CHECKING:
    from vatsloc.breathing.case import BreathCase, read_breath
    from vatsloc.breathing.motion import Motion
    from vatsloc.breathing.run import breathe_case
    from vatsloc.breathing.score import score

__all__ = ["BreathCase", "Motion", "breathe_case", "read_breath", "score"]

__getattr__ = on_first_use(
    {
        "vatsloc.breathing.case": ("BreathCase", "read_breath"),
        "vatsloc.breathing.motion": ("Motion",),
        "vatsloc.breathing.run": ("breathe_case",),
        "vatsloc.breathing.score": ("score",),
    }
)
