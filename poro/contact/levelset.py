"""Smooth signed distance to a rigid surface, twice differentiable: the gap function of contact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy import ndimage

from poro.arrays import Array
from poro.mesh.closest import depth_below
from poro.mesh.trisurface import TriSurface


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


MARGIN_MM = 30.0
"""How far beyond a surface its distance is known."""


def level_set(surface: TriSurface, step_mm: float, smooth_mm: float) -> LevelSet:
    """Signed distance to a closed surface, sampled every `step_mm` and smoothed by a Gaussian of `smooth_mm`."""
    origin = surface.points.min(axis=0) - MARGIN_MM
    shape = np.ceil((surface.points.max(axis=0) + MARGIN_MM - origin) / step_mm).astype(int) + 1
    axes = [origin[d] + step_mm * np.arange(shape[d]) for d in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    distance = depth_below(surface, points).reshape(shape)
    smooth = ndimage.gaussian_filter(distance, smooth_mm / step_mm, mode="nearest") if smooth_mm else distance
    return LevelSet(ndimage.spline_filter(smooth, order=3, mode="mirror"), origin, step_mm)


@njit(cache=True)
def _weights(t: float, step: float, into: Array) -> None:
    """Cubic B-spline weights of four neighbours and their first two derivatives, written to (3, 4)."""
    r = 1 - t
    w, d, s = into[0], into[1], into[2]
    w[0], w[1], w[2], w[3] = r**3 / 6, (4 - 6 * t * t + 3 * t**3) / 6, (4 - 6 * r * r + 3 * r**3) / 6, t**3 / 6
    d[0], d[1] = -r * r / 2 / step, (3 * t * t - 4 * t) / 2 / step
    d[2], d[3] = -(3 * r * r - 4 * r) / 2 / step, t * t / 2 / step
    s[0], s[1], s[2], s[3] = r / step**2, (3 * t - 2) / step**2, (3 * r - 2) / step**2, t / step**2


@njit(cache=True)
def _evaluate(c: Array, ijk: Array, step: float) -> tuple[Array, Array, Array]:
    value, gradient, hessian = np.empty(len(ijk)), np.empty((len(ijk), 3)), np.empty((len(ijk), 3, 3))
    wx, wy, wz = np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 4))
    for q in range(len(ijk)):
        # Beyond the grid the surface is far away: the border's distance is all that contact needs.
        x = min(max(ijk[q, 0], 1.0), c.shape[0] - 2.001)
        y = min(max(ijk[q, 1], 1.0), c.shape[1] - 2.001)
        z = min(max(ijk[q, 2], 1.0), c.shape[2] - 2.001)
        i, j, k = int(x), int(y), int(z)
        _weights(x - i, step, wx)
        _weights(y - j, step, wy)
        _weights(z - k, step, wz)
        v = gx = gy = gz = hxx = hyy = hzz = hxy = hxz = hyz = 0.0
        for a in range(4):
            f = fy = fz = fyy = fzz = fyz = 0.0
            for b in range(4):
                line = c[i - 1 + a, j - 1 + b]
                along = slope = bend = 0.0
                for e in range(4):
                    along += line[k - 1 + e] * wz[0, e]
                    slope += line[k - 1 + e] * wz[1, e]
                    bend += line[k - 1 + e] * wz[2, e]
                f += wy[0, b] * along
                fy += wy[1, b] * along
                fz += wy[0, b] * slope
                fyy += wy[2, b] * along
                fyz += wy[1, b] * slope
                fzz += wy[0, b] * bend
            v += wx[0, a] * f
            gx += wx[1, a] * f
            gy += wx[0, a] * fy
            gz += wx[0, a] * fz
            hxx += wx[2, a] * f
            hyy += wx[0, a] * fyy
            hzz += wx[0, a] * fzz
            hxy += wx[1, a] * fy
            hxz += wx[1, a] * fz
            hyz += wx[0, a] * fyz
        value[q] = v
        gradient[q, 0], gradient[q, 1], gradient[q, 2] = gx, gy, gz
        hessian[q, 0, 0], hessian[q, 1, 1], hessian[q, 2, 2] = hxx, hyy, hzz
        hessian[q, 0, 1] = hessian[q, 1, 0] = hxy
        hessian[q, 0, 2] = hessian[q, 2, 0] = hxz
        hessian[q, 1, 2] = hessian[q, 2, 1] = hyz
    return value, gradient, hessian
