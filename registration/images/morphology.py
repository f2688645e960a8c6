"""Voxels within a distance of a region: an exact Euclidean distance transform that stops looking beyond it."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from registration.volume import Array, Cut, Mask


def grown(mask: Mask, distance_mm: float) -> Mask:
    """Every voxel whose centre lies within `distance_mm` of that of a voxel in the mask."""
    cut = bounding_box(mask.inside, np.ceil(distance_mm / mask.grid.spacing).astype(int))
    inside = mask.inside.copy()
    inside[cut] = near(mask.inside[cut], distance_mm, mask.grid.spacing)
    return Mask(inside, mask.ras_from_ijk)


def bounding_box(inside: Array, margin: Array) -> Cut:
    """Slices about the true voxels of (ni, nj, nk), `margin` (3,) voxels wider, clipped to the array.

    Raises ValueError where none is true.
    """
    if not inside.any():
        raise ValueError("the mask is empty; check the segmentation")
    where = [np.flatnonzero(inside.any(axis=tuple({0, 1, 2} - {m}))) for m in range(3)]
    i, j, k = (slice(max(int(w[0]) - int(g), 0), int(w[-1]) + int(g) + 1) for w, g in zip(where, margin, strict=True))
    return i, j, k


def near(inside: Array, distance_mm: float, spacing: Array) -> Array:
    """Which voxels of (ni, nj, nk) lie within `distance_mm` of a true one; spacing: (3,) mm.

    Squared distances axis by axis, each the least of its neighbours' plus a parabola. Ref: Felzenszwalb 2012.
    """
    reach = np.minimum(np.floor(distance_mm / np.asarray(spacing) + 1e-6), np.array(inside.shape) - 1).astype(int)
    far = np.float32(4 * distance_mm**2 + 1)
    squared = np.where(inside, np.float32(0), far)
    for axis in range(3):
        out = np.empty_like(squared)
        step = float(spacing[axis])
        if axis == 0:
            _along_first(squared, int(reach[0]), step, out)
        else:
            _along_others(squared, axis, int(reach[axis]), step, out)
        squared = out
    return np.asarray(squared <= np.float32((distance_mm + 1e-4) ** 2))


@njit(cache=True, parallel=True)
def _along_first(squared, reach, step, out):
    n = squared.shape[0]
    for i in prange(n):
        out[i] = squared[i]
        for o in range(-reach, reach + 1):
            if o != 0 and 0 <= i + o < n:
                _lower(out[i], squared[i + o], np.float32((o * step) ** 2))


@njit(cache=True, parallel=True)
def _along_others(squared, axis, reach, step, out):
    ni, nj, nk = squared.shape
    for i in prange(ni):
        out[i] = squared[i]
        for o in range(1, reach + 1):
            rise = np.float32((o * step) ** 2)
            if axis == 1:
                _lower(out[i, : nj - o], squared[i, o:], rise)
                _lower(out[i, o:], squared[i, : nj - o], rise)
            else:
                _lower(out[i, :, : nk - o], squared[i, :, o:], rise)
                _lower(out[i, :, o:], squared[i, :, : nk - o], rise)


@njit(cache=True, fastmath=True)
def _lower(values, others, rise):
    for j in range(values.shape[0]):
        for k in range(values.shape[1]):
            values[j, k] = min(values[j, k], others[j, k] + rise)
