"""Which correspondences judge a model instead of telling it."""

from __future__ import annotations

import numpy as np

from registration.correspondences import Correspondences
from registration.volume import Array

BLOCK_MM = 40.0
"""Keypoints are held out by blocks this wide, because neighbours move nearly alike."""
LEAST_CORRESPONDENCES = 40


def held_out(points: Array, block_mm: float = BLOCK_MM) -> Array:
    """A quarter of points (n, 3), by cubes of `block_mm`, the same ones in every run, (n,) bool."""
    block = np.floor(points / block_mm).astype(int)
    return np.asarray((block @ np.array([1, 2, 3])) % 4 == 0)


def too_few(found: Correspondences) -> str | None:
    """Why correspondences cannot judge a refinement; None when they can."""
    hidden = held_out(found.fixed)
    if len(found) < LEAST_CORRESPONDENCES:
        return f"only {len(found)} keypoints were matched inside the lung"
    if min(hidden.sum(), (~hidden).sum()) < LEAST_CORRESPONDENCES // 4:
        return "the matched keypoints lie too close together to hold some out"
    return None
