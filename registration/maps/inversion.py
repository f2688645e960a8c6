"""Inverse of a map by fixed-point iteration, with Newton steps where that stalls, and the residual it leaves.

Ref: Crum 2007, eq. 3 (fixed point).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from registration.maps.field import PointMap
from registration.volume import Array


@dataclass(frozen=True)
class Inversion:
    """points_fixed: (n, 3), RAS mm, that map to the points asked for; residual_mm: (n,) distance still between them;
    iterations: steps of the slowest point."""

    points_fixed: Array
    residual_mm: Array
    iterations: int


ITERATIONS = 50
"""At most; the last two thirds are Newton steps."""


def invert_at(
    moving_from_fixed: PointMap,
    points_moving: Array,
    start: Array | None = None,
    tolerance_mm: float = 0.01,
) -> Inversion:
    """Solve moving_from_fixed(x) = y for x (n, 3) at points y (n, 3), RAS mm.

    start: first guess (n, 3), default y itself; a good one is the inverse of the map's rigid part. Fixed-point steps
    x += y - T(x) contract where |grad u| < 1; from a third of the steps on, points not there yet take damped Newton
    steps.
    Points that never arrive keep their best position and say so in `residual_mm`.
    """
    y = np.asarray(points_moving, dtype=float)
    x = np.array(y if start is None else start, dtype=float)
    gap = y - moving_from_fixed(x)
    residual = np.linalg.norm(gap, axis=1)
    step, count = np.ones(len(x)), 0
    for count in range(1, ITERATIONS + 1):
        active = np.flatnonzero(residual > tolerance_mm)
        if len(active) == 0:
            return Inversion(x, residual, count - 1)
        newton = count > ITERATIONS // 3
        direction = _newton(moving_from_fixed, x[active], gap[active]) if newton else gap[active]
        trial = x[active] + step[active, None] * direction
        new_gap = y[active] - moving_from_fixed(trial)
        new = np.linalg.norm(new_gap, axis=1)
        better = new < residual[active]
        kept = active[better]
        x[kept], gap[kept], residual[kept] = trial[better], new_gap[better], new[better]
        step[kept] = 1.0
        step[active[~better]] /= 2
    return Inversion(x, residual, count)


def _newton(mapping: PointMap, x: Array, gap: Array, h: float = 0.5) -> Array:
    """Newton direction with the map's gradient by central differences over h mm; the plain gap where it is singular."""
    gradient = np.stack([(mapping(x + h * e) - mapping(x - h * e)) / (2 * h) for e in np.eye(3)], axis=2)
    safe = np.linalg.det(gradient) > 0.05
    gradient[~safe] = np.eye(3)
    return np.linalg.solve(gradient, gap[..., None])[..., 0]
