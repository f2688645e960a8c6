"""Morphology of masks measured in millimetres: dilation, erosion, closing, connected parts.

Arrays (ni, nj, nk) of bool in and out; spacing: (3,) mm.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numba import njit
from scipy import ndimage
from scipy.spatial import cKDTree

from registration.kernels.threads import in_parts
from registration.volume import Array, Cut


def bounding_box(inside: Array, margin: Array) -> Cut:
    """Slices about the true voxels, `margin` (3,) voxels wider, clipped to the array.

    Raises ValueError where none is true.
    """
    if not inside.any():
        raise ValueError("the mask is empty; check the segmentation")
    where = [np.flatnonzero(inside.any(axis=tuple({0, 1, 2} - {m}))) for m in range(3)]
    i, j, k = (slice(max(int(w[0]) - int(g), 0), int(w[-1]) + int(g) + 1) for w, g in zip(where, margin, strict=True))
    return i, j, k


def distances_to(inside: Array, voxels: Array, spacing: Array) -> Array:
    """Distances (n,) mm of voxels (n, 3) from the centre of the nearest true one, 0 where they are true themselves.

    Raises ValueError where none is true. For some voxels far cheaper than a distance transform of all.
    """
    if not inside.any():
        raise ValueError("the mask is empty; check the segmentation")
    rim = inside & ~ndimage.binary_erosion(inside)
    off = cKDTree(np.argwhere(rim) * spacing).query(voxels * spacing)[0]
    return np.where(inside[tuple(np.transpose(voxels))], 0.0, off)


def dilate(inside: Array, radius_mm: float, spacing: Array) -> Array:
    """Voxels whose centre lies within `radius_mm` of that of a true one."""
    if not inside.any():
        return inside.copy()
    box = bounding_box(inside, np.ceil(radius_mm / np.asarray(spacing)) + 1)
    out = np.zeros_like(inside)
    out[box] = _within(inside[box], radius_mm, spacing)
    return out


def erode(inside: Array, radius_mm: float, spacing: Array) -> Array:
    """Voxels farther than `radius_mm` from everything outside; the image's border does not erode."""
    if not inside.any() or inside.all():
        return inside.copy()
    box = bounding_box(inside, np.ceil(radius_mm / np.asarray(spacing)) + 1)
    out = np.zeros_like(inside)
    out[box] = inside[box] & ~_within(~inside[box], radius_mm, spacing)
    return out


def close(inside: Array, radius_mm: float, spacing: Array) -> Array:
    """Closing by a ball of `radius_mm`: dents and holes that the ball cannot enter are filled."""
    return erode(dilate(inside, radius_mm, spacing), radius_mm, spacing) | inside


def largest(inside: Array) -> Array:
    """The largest connected part (empty when `inside` is)."""
    labels, count = ndimage.label(inside)
    if count == 0:
        return inside.copy()
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels == int(sizes.argmax())


def touching(inside: Array, seed: Array) -> Array:
    """The connected parts of `inside` that share a voxel with `seed`."""
    labels, count = ndimage.label(inside)
    chosen = np.zeros(count + 1, dtype=bool)
    chosen[np.unique(labels[seed & inside])] = True
    chosen[0] = False
    return chosen[labels]


def _within(inside: Array, distance_mm: float, spacing: Array) -> Array:
    """Which voxels lie within `distance_mm` of a true one: a Euclidean distance transform that looks no further.

    Squared distances axis by axis, each the least of its neighbours' plus a parabola. Ref: Felzenszwalb 2012.
    """
    reach = np.minimum(np.floor(distance_mm / np.asarray(spacing) + 1e-6), np.array(inside.shape) - 1).astype(int)
    far = np.float32(4 * distance_mm**2 + 1)
    squared = np.where(inside, np.float32(0), far)
    for axis in range(3):
        out = np.full_like(squared, np.inf)
        step = float(spacing[axis])
        if axis == 0:
            work = partial(_along_first, squared, int(reach[0]), step, out)
        else:
            work = partial(_along_others, squared, axis, int(reach[axis]), step, out)
        in_parts(work, len(squared))
        squared = out
    return np.asarray(squared <= np.float32((distance_mm + 1e-4) ** 2))


# Planes are named by number, not by slices: half the time that the kernels take to compile.
@njit(cache=True, nogil=True)
def _along_first(squared, reach, step, out, first, end):
    n, nj, nk = squared.shape
    for i in range(first, end):
        _lower(out, squared, (i, 0, 0), (i, 0, 0), (nj, nk), np.float32(0))
        for o in range(-reach, reach + 1):
            if o != 0 and 0 <= i + o < n:
                _lower(out, squared, (i, 0, 0), (i + o, 0, 0), (nj, nk), np.float32((o * step) ** 2))


@njit(cache=True, nogil=True)
def _along_others(squared, axis, reach, step, out, first, end):
    _, nj, nk = squared.shape
    for i in range(first, end):
        _lower(out, squared, (i, 0, 0), (i, 0, 0), (nj, nk), np.float32(0))
        for o in range(1, reach + 1):
            rise = np.float32((o * step) ** 2)
            oj, ok = (o, 0) if axis == 1 else (0, o)
            _lower(out, squared, (i, 0, 0), (i, oj, ok), (nj - oj, nk - ok), rise)
            _lower(out, squared, (i, oj, ok), (i, 0, 0), (nj - oj, nk - ok), rise)


@njit(cache=True)
def _lower(values, others, at, other, size, rise):
    """Values, which start at infinity, from voxel `at` on, not above `others` plus a rise from voxel `other` on."""
    for j in range(size[0]):
        for k in range(size[1]):
            raised = others[other[0], other[1] + j, other[2] + k] + rise
            value = values[at[0], at[1] + j, at[2] + k]
            values[at[0], at[1] + j, at[2] + k] = raised if raised < value else value  # one instruction for many
