"""Smooth signed distance to a rigid surface, twice differentiable: the gap function of contact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy import ndimage

from poro.mesh.closest import closest_points
from poro.mesh.tetmesh import Array, TriSurface


@dataclass(frozen=True)
class LevelSet:
    """Cubic B-spline of a signed distance, positive inside. coefficients: (ni, nj, nk); origin: (3,) mm; step_mm."""

    coefficients: Array
    origin: Array
    step_mm: float

    def evaluate(self, points: Array) -> tuple[Array, Array, Array]:
        """Value (q,) mm, gradient (q, 3) and Hessian (q, 3, 3) 1/mm at points (q, 3) mm."""
        ijk = (np.ascontiguousarray(points, float) - self.origin) / self.step_mm
        return _evaluate(self.coefficients, ijk, self.step_mm)


def level_set(surface: TriSurface, step_mm: float, smooth_mm: float, margin_mm: float = 30.0) -> LevelSet:
    """Signed distance to a closed surface, sampled every `step_mm` and smoothed by a Gaussian of `smooth_mm`."""
    origin = surface.points.min(axis=0) - margin_mm
    shape = np.ceil((surface.points.max(axis=0) + margin_mm - origin) / step_mm).astype(int) + 1
    axes = [origin[d] + step_mm * np.arange(shape[d]) for d in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    distance = -closest_points(surface, points).distance.reshape(shape)
    smooth = ndimage.gaussian_filter(distance, smooth_mm / step_mm, mode="nearest") if smooth_mm else distance
    return LevelSet(ndimage.spline_filter(smooth, order=3, mode="mirror"), origin, step_mm)


@njit(cache=True)
def _weights(t: float, step: float) -> tuple[Array, Array, Array]:
    """Cubic B-spline weights of four neighbours and their first two derivatives."""
    w, d, s = np.empty(4), np.empty(4), np.empty(4)
    r = 1 - t
    w[0], w[1], w[2], w[3] = r**3 / 6, (4 - 6 * t * t + 3 * t**3) / 6, (4 - 6 * r * r + 3 * r**3) / 6, t**3 / 6
    d[0], d[1], d[2], d[3] = -r * r / 2, (3 * t * t - 4 * t) / 2, -(3 * r * r - 4 * r) / 2, t * t / 2
    s[0], s[1], s[2], s[3] = r, 3 * t - 2, 3 * r - 2, t
    return w, d / step, s / step**2


@njit(cache=True)
def _evaluate(c: Array, ijk: Array, step: float) -> tuple[Array, Array, Array]:
    value, gradient, hessian = np.zeros(len(ijk)), np.zeros((len(ijk), 3)), np.zeros((len(ijk), 3, 3))
    for q in range(len(ijk)):
        # Beyond the grid the surface is far away: the border's distance is all that contact needs.
        x = min(max(ijk[q, 0], 1.0), c.shape[0] - 2.001)
        y = min(max(ijk[q, 1], 1.0), c.shape[1] - 2.001)
        z = min(max(ijk[q, 2], 1.0), c.shape[2] - 2.001)
        i, j, k = int(x), int(y), int(z)
        wx, dx, sx = _weights(x - i, step)
        wy, dy, sy = _weights(y - j, step)
        wz, dz, sz = _weights(z - k, step)
        for a in range(4):
            for b in range(4):
                along, slope, bend = 0.0, 0.0, 0.0
                for e in range(4):
                    f = c[i - 1 + a, j - 1 + b, k - 1 + e]
                    along += f * wz[e]
                    slope += f * dz[e]
                    bend += f * sz[e]
                value[q] += wx[a] * wy[b] * along
                gradient[q, 0] += dx[a] * wy[b] * along
                gradient[q, 1] += wx[a] * dy[b] * along
                gradient[q, 2] += wx[a] * wy[b] * slope
                hessian[q, 0, 0] += sx[a] * wy[b] * along
                hessian[q, 1, 1] += wx[a] * sy[b] * along
                hessian[q, 2, 2] += wx[a] * wy[b] * bend
                hessian[q, 0, 1] += dx[a] * dy[b] * along
                hessian[q, 0, 2] += dx[a] * wy[b] * slope
                hessian[q, 1, 2] += wx[a] * dy[b] * slope
        hessian[q, 1, 0], hessian[q, 2, 0], hessian[q, 2, 1] = hessian[q, 0, 1], hessian[q, 0, 2], hessian[q, 1, 2]
    return value, gradient, hessian
