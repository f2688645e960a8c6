"""Errors of a motion at landmarks. The only module that reads them: no driver is given any."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from poro.arrays import Array
from vatsloc.breathing.case import read_rows
from vatsloc.breathing.motion import OUT, Motion

HEAD = "insp_x,insp_y,insp_z,exp_x,exp_y,exp_z"


def read_landmarks(path: Path) -> tuple[Array, Array]:
    """Inspired and expired points (k, 3) RAS mm, row by row the same. Raises CaseError, InputRefused."""
    rows = read_rows(path, 6, HEAD)
    return rows[:, :3], rows[:, 3:]


def score(motion: Motion, path: Path | None) -> dict[str, Any] | None:
    """Errors in mm at the state that stands for the other scan; None without landmarks or without such a state."""
    if path is None or motion.end is None:
        return None
    inspired, expired = read_landmarks(path)
    start, goal = (inspired, expired) if motion.direction == OUT else (expired, inspired)
    error = np.linalg.norm(motion.moved(start, motion.end) - goal, axis=1)
    before = np.linalg.norm(start - goal, axis=1)
    return {
        "initial_mean": float(before.mean()),
        "mean": float(error.mean()),
        "p95": float(np.percentile(error, 95)),
        "max": float(error.max()),
        "n": len(error),
    }
