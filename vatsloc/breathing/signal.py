"""Breathing signals: volume between expiration (0) and inspiration (1) over time."""

from __future__ import annotations

import numpy as np

from poro.arrays import Array

PERIOD_S = 4.0


def quiet_breath(count: int, from_inspiration: bool) -> Array:
    """Volumes (count,) of one quiet breath that begins and ends at the scan. Ref: Lujan 1999, eq. 1, with power 2."""
    t = np.linspace(0.0, 1.0, count)
    moved = np.sin(np.pi * t) ** 2
    return np.asarray(1 - moved if from_inspiration else moved)


def sampled(signal: Array, count: int) -> tuple[Array, Array]:
    """Times (count,) s evenly over a signal (k, 2), and its volumes there."""
    t = np.linspace(signal[0, 0], signal[-1, 0], count)
    return t, np.interp(t, signal[:, 0], signal[:, 1])
