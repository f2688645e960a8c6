"""Whether a point lies in an ellipsoid of confidence."""

from __future__ import annotations

import numpy as np

from registration.volume import Array


def in_ellipsoid(offset: Array, semi_axes: Array, directions: Array | None) -> bool | None:
    """Whether `offset` (3,) from the centre lies in an ellipsoid; None when that cannot be told.

    semi_axes: (3,); directions: (3, 3), row m the unit vector of semi-axis m. Without directions the answer is certain
    only within the smallest and beyond the largest semi-axis.
    """
    axes = np.asarray(semi_axes, dtype=float)
    if directions is not None:
        return bool(np.sum((np.asarray(directions, dtype=float) @ offset / axes) ** 2) <= 1.0)
    r = float(np.linalg.norm(offset))
    if r <= axes.min():
        return True
    return False if r > axes.max() else None
