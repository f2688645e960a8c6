"""Cone beams: line integrals through a volume, and Feldkamp's reconstruction from them, on all threads of numba.

Source and flat detector turn about the third axis of the volume through its middle. At angle b the source is at
source_axis * (cos b, sin b, 0); columns of the detector run along (-sin b, cos b, 0), rows along (0, 0, 1).
Ref: Joseph 1982 (line integrals); Feldkamp, Davis and Kress 1984; Parker 1982 (weights of a short scan).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True)
class Circle:
    """Where views are taken. source_axis, source_detector, pixel: mm; arc: degrees; shape: rows and columns."""

    source_axis: float
    source_detector: float
    arc: float
    views: int
    pixel: float
    shape: tuple[int, int]

    @property
    def angles(self) -> Array:
        """Angles of the views (views,), radians."""
        return np.deg2rad(np.linspace(0.0, self.arc, self.views))

    @property
    def columns_mm(self) -> Array:
        """Places of the columns on the detector, (columns,) mm from its middle."""
        return np.asarray((np.arange(self.shape[1]) - (self.shape[1] - 1) / 2) * self.pixel)

    @property
    def rows_mm(self) -> Array:
        """Places of the rows on the detector, (rows,) mm from its middle."""
        return np.asarray((np.arange(self.shape[0]) - (self.shape[0] - 1) / 2) * self.pixel)


def project(volume: Array, spacing: Array, circle: Circle, levels: Array, middle_mm: Array | None = None) -> Array:
    """Line integrals (m, views, columns, rows) of by how much `volume` [i, j, k] per mm exceeds each of m `levels`, the
    lowest first.

    middle_mm: (3,) middle of the volume from the axis and the plane of the circle, default none.
    """
    off = np.zeros(3) if middle_mm is None else np.asarray(middle_mm, dtype=float)
    out = np.zeros((len(levels), circle.views, circle.shape[1], circle.shape[0]), dtype=np.float32)
    _project(
        np.ascontiguousarray(volume, dtype=np.float32),
        off - (np.array(volume.shape) - 1) / 2 * spacing,
        np.asarray(spacing, dtype=float),
        (circle.source_axis, circle.source_detector),
        circle.angles,
        (circle.columns_mm, circle.rows_mm),
        np.asarray(levels, dtype=np.float32),
        out,
    )
    return out


def feldkamp(views: Array, circle: Circle, shape: tuple[int, int, int], spacing: Array, cut: float) -> Array:
    """Volume [i, j, k] per mm of a `shape` about the circle's middle from line integrals (views, columns, rows).

    circle: its columns may be fewer than those of `views`, which are then continued by as many on either side; cut: end
    of the filter's window (Hann) over the highest frequency.
    """
    wide = Circle(
        circle.source_axis,
        circle.source_detector,
        circle.arc,
        circle.views,
        circle.pixel,
        (views.shape[2], views.shape[1]),
    )
    u, v = wide.columns_mm, wide.rows_mm
    cosine = circle.source_detector / np.sqrt(circle.source_detector**2 + u[:, None] ** 2 + v**2)
    extra = (views.shape[1] - circle.shape[1]) // 2
    weights = np.pad(parker_weights(circle), ((0, 0), (extra, extra)), mode="edge")
    step = circle.pixel * circle.source_axis / circle.source_detector
    filtered = _ramp(views, (weights[:, :, None] * cosine).astype(np.float32), step, cut)
    out = np.zeros(shape, dtype=np.float32)
    beta = float(np.deg2rad(circle.arc)) / (circle.views - 1)
    _backproject(
        filtered,
        -(np.array(shape) - 1) / 2 * spacing,
        np.asarray(spacing, dtype=float),
        (circle.source_axis, circle.source_detector),
        circle.angles,
        (float(u[0]), float(v[0]), circle.pixel, beta),
        out,
    )
    return out


def parker_weights(circle: Circle) -> Array:
    """Weights (views, columns) of a short scan: those of a ray and of the same one from the other end add up to one."""
    over = (np.deg2rad(circle.arc) - np.pi) / 2
    beta = circle.angles[:, None]
    gamma = -np.arctan(circle.columns_mm / circle.source_detector)[None, :]
    if np.abs(gamma).max() > over:
        raise ValueError(f"an arc of {circle.arc:g} degrees is too short for the detector's width, widen the arc")
    start = np.sin(np.pi / 4 * np.clip(beta / (over - gamma + 1e-9), 0, 2)) ** 2
    end = np.sin(np.pi / 4 * np.clip((np.pi + 2 * over - beta) / (over + gamma + 1e-9), 0, 2)) ** 2
    return np.asarray(np.where(beta < 2 * (over - gamma), start, np.where(beta > np.pi - 2 * gamma, end, 1.0)))


def _ramp(views: Array, weights: Array, step: float, cut: float) -> Array:
    """Weighted views (n, columns, rows), filtered along the columns. Ref: Kak and Slaney 1988, eq. 3.61."""
    columns = views.shape[1]
    size = 1 << int(np.ceil(np.log2(2 * columns)))
    at = np.minimum(np.arange(size), size - np.arange(size))
    odd = at % 2 == 1
    kernel = np.zeros(size)
    kernel[0], kernel[odd] = 0.25, -1 / (np.pi * at[odd]) ** 2
    frequency = np.arange(size // 2 + 1) / (size // 2)
    window = np.where(frequency < cut, 0.5 * (1 + np.cos(np.pi * frequency / cut)), 0.0)
    response = (np.fft.rfft(kernel).real * window / step).astype(np.float32)
    out = np.empty(views.shape, dtype=np.float32)
    for n, view in enumerate(views):
        rows = np.fft.rfft((view * weights[n]).T, size, axis=1) * response
        out[n] = np.fft.irfft(rows, size, axis=1)[:, :columns].T
    return out


@numba.njit(cache=True, parallel=True)
def _project(volume, origin, h, reach, angles, detector, levels, out):
    for view in numba.prange(len(angles)):
        _view(volume, origin, h, reach, angles[view], detector, levels, out[:, view])


@numba.njit(cache=True, fastmath=True)
def _view(volume, origin, h, reach, angle, detector, levels, out):
    columns, rows = detector
    c, s = np.cos(angle), np.sin(angle)
    source = (reach[0] * c, reach[0] * s)
    line, values = np.zeros(volume.shape[2], dtype=np.float32), np.zeros(len(rows), dtype=np.float32)
    # Plane by plane, so that what is read of the volume lies together.
    for axis in (0, 1):
        for n in range(volume.shape[axis]):
            for column in range(len(columns)):
                ray = (-reach[1] * c - columns[column] * s, -reach[1] * s + columns[column] * c)
                if (abs(ray[0]) >= abs(ray[1])) != (axis == 0):
                    continue
                t = (origin[axis] + h[axis] * n - source[axis]) / ray[axis]
                at = (source[1 - axis] + t * ray[1 - axis] - origin[1 - axis]) / h[1 - axis]
                if at < 0 or at >= volume.shape[1 - axis] - 1 or t <= 0:
                    continue
                m = int(at)
                f = np.float32(at - m)
                if axis == 0:
                    most = _blend(line, volume[n, m], volume[n, m + 1], np.float32(1) - f, f)
                else:
                    most = _blend(line, volume[m, n], volume[m + 1, n], np.float32(1) - f, f)
                if most <= levels[0]:
                    continue
                start = (t * rows[0] - origin[2]) / h[2]
                rise = t * (rows[1] - rows[0]) / h[2]
                first = max(int(np.ceil(-start / rise)), 0)
                end = min(int(np.ceil((len(line) - 1 - start) / rise)), len(rows))
                _gather(line, np.float32(start), np.float32(rise), first, end, values)
                for level in range(len(levels)):
                    if most > levels[level]:
                        _exceeding(values, first, end, levels[level], out[level, column])
    for column in range(len(columns)):
        dx, dy = -reach[1] * c - columns[column] * s, -reach[1] * s + columns[column] * c
        along = h[0] / abs(dx) if abs(dx) >= abs(dy) else h[1] / abs(dy)
        for row in range(len(rows)):
            out[:, column, row] *= np.float32(np.sqrt(dx * dx + dy * dy + rows[row] ** 2) * along)


@numba.njit(cache=True, fastmath=True)
def _blend(line, a, b, f, g):
    """A line that is `f` times one and `g` times another, and its greatest value."""
    most = np.float32(-np.inf)
    for k in range(len(line)):
        value = a[k] * f + b[k] * g
        line[k] = value
        most = max(most, value)
    return most


@numba.njit(cache=True, fastmath=True)
def _gather(line, start, rise, first, end, values):
    """Values of a line at start + rise * n for every n from `first` to `end`, all of which lie on it."""
    last = np.uint64(len(line) - 2)
    for n in range(first, end):
        at = max(start + rise * np.float32(n), np.float32(0))
        # An unsigned index spares the test for one that counts from the end.
        k = min(np.uint64(np.int32(at)), last)
        share = at - np.float32(k)
        values[n] = line[k] * (np.float32(1) - share) + line[k + np.uint64(1)] * share


@numba.njit(cache=True, fastmath=True)
def _exceeding(values, first, end, level, sums):
    """Add to sums by how much values from `first` to `end` exceed a level."""
    for n in range(first, end):
        sums[n] += max(values[n] - level, np.float32(0))


@numba.njit(cache=True, parallel=True)
def _backproject(filtered, origin, h, reach, angles, detector, out):
    cosines, sines = np.cos(angles), np.sin(angles)
    for i in numba.prange(len(out)):
        _slab(filtered, origin[0] + h[0] * i, origin, h, reach, (cosines, sines), detector, out[i])


@numba.njit(cache=True, fastmath=True)
def _slab(filtered, x, origin, h, reach, turns, detector, out):
    views, columns, rows = filtered.shape
    u0, v0, pixel, beta = detector
    line, values = np.zeros(rows, dtype=np.float32), np.zeros(out.shape[1], dtype=np.float32)
    for view in range(views):
        c, s = turns[0][view], turns[1][view]
        for j in range(len(out)):
            y = origin[1] + h[1] * j
            away = reach[0] - x * c - y * s
            scale = reach[1] / away
            u = (scale * (y * c - x * s) - u0) / pixel
            if u < 0 or u >= columns - 1:
                continue
            m = int(u)
            near = (reach[0] / away) ** 2 * beta
            f = np.float32((u - m) * near)
            _blend(line, filtered[view, m], filtered[view, m + 1], np.float32(near) - f, f)
            start = (scale * origin[2] - v0) / pixel
            rise = scale * h[2] / pixel
            first = max(int(np.ceil(-start / rise)), 0)
            end = min(int(np.ceil((rows - 1 - start) / rise)), out.shape[1])
            _gather(line, np.float32(start), np.float32(rise), first, end, values)
            for k in range(first, end):
                out[j, k] += values[k]
