"""Trilinear interpolation at scattered points, thread-parallel, with its exact gradient."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from numba import njit

from registration.kernels.threads import MANY_POINTS, in_parts
from registration.kernels.trilinear import lower, value, value_and_slope
from registration.volume import Array, Grid

EDGE = 1e-4
"""Voxels: as far outside an image a point still counts as on its edge, where the rounding of headers can put it."""


class _Samples(NamedTuple):
    """What `_warp` fills: values (n,) and gradients (3, n)."""

    values: Array
    gradient: Array


@njit(cache=True, nogil=True)
def _values(voxels, points, fill, out, start, stop):
    ni, nj, nk = voxels.shape
    for n in range(start, stop):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        if not (-EDGE <= x <= ni - 1 + EDGE and -EDGE <= y <= nj - 1 + EDGE and -EDGE <= z <= nk - 1 + EDGE):
            out[n] = fill
            continue
        x, y, z = min(max(x, 0.0), ni - 1.0), min(max(y, 0.0), nj - 1.0), min(max(z, 0.0), nk - 1.0)
        i, j, k = lower(x, ni), lower(y, nj), lower(z, nk)
        out[n] = value(voxels, i, j, k, x - i, y - j, z - k)


@njit(cache=True, nogil=True)
def _affine_values(voxels, affine, fill, out, start, stop):
    points = np.empty((out.shape[2], 3))
    for p in range(start, stop):
        for q in range(out.shape[1]):
            for m in range(3):
                first = affine[m, 0] * p + affine[m, 1] * q + affine[m, 3]
                for r in range(out.shape[2]):
                    points[r, m] = first + affine[m, 2] * r
            _values(voxels, points, fill, out[p, q], 0, out.shape[2])


class _Moved(NamedTuple):
    """Where a voxel of a grid lies once a field (mi, mj, mk, 3) mm has moved it. at_field, at_image: (3, 4) from the
    grid's voxels to the field's and to an image's; per_mm: (3, 3) voxels of the image per mm.
    """

    vectors: Array
    at_field: Array
    at_image: Array
    per_mm: Array


@njit(cache=True, nogil=True)
def _moved_values(voxels, moved, fill, out, start, stop):
    vectors, at_field, at_image, per_mm = moved
    mi, mj, mk, _ = vectors.shape
    points = np.empty((out.shape[2], 3))
    for p in range(start, stop):
        for q in range(out.shape[1]):
            for r in range(out.shape[2]):
                x = at_field[0, 0] * p + at_field[0, 1] * q + at_field[0, 2] * r + at_field[0, 3]
                y = at_field[1, 0] * p + at_field[1, 1] * q + at_field[1, 2] * r + at_field[1, 3]
                z = at_field[2, 0] * p + at_field[2, 1] * q + at_field[2, 2] * r + at_field[2, 3]
                x, y, z = min(max(x, 0.0), mi - 1.0), min(max(y, 0.0), mj - 1.0), min(max(z, 0.0), mk - 1.0)
                i, j, k = lower(x, mi), lower(y, mj), lower(z, mk)
                u0 = value(vectors[:, :, :, 0], i, j, k, x - i, y - j, z - k)
                u1 = value(vectors[:, :, :, 1], i, j, k, x - i, y - j, z - k)
                u2 = value(vectors[:, :, :, 2], i, j, k, x - i, y - j, z - k)
                for m in range(3):
                    first = at_image[m, 0] * p + at_image[m, 1] * q + at_image[m, 2] * r + at_image[m, 3]
                    points[r, m] = first + per_mm[m, 0] * u0 + per_mm[m, 1] * u1 + per_mm[m, 2] * u2
            _values(voxels, points, fill, out[p, q], 0, out.shape[2])


@njit(cache=True, nogil=True)
def _warp(voxels, base, displacement, index, ijk_from_ras, out, start, stop):
    ni, nj, nk = voxels.shape
    for n in range(start, stop):
        u0, u1, u2 = displacement[0, index[n]], displacement[1, index[n]], displacement[2, index[n]]
        x = base[n, 0] + ijk_from_ras[0, 0] * u0 + ijk_from_ras[0, 1] * u1 + ijk_from_ras[0, 2] * u2
        y = base[n, 1] + ijk_from_ras[1, 0] * u0 + ijk_from_ras[1, 1] * u1 + ijk_from_ras[1, 2] * u2
        z = base[n, 2] + ijk_from_ras[2, 0] * u0 + ijk_from_ras[2, 1] * u1 + ijk_from_ras[2, 2] * u2
        sx = 1.0 if 0.0 <= x <= ni - 1 else 0.0
        sy = 1.0 if 0.0 <= y <= nj - 1 else 0.0
        sz = 1.0 if 0.0 <= z <= nk - 1 else 0.0
        x, y, z = min(max(x, 0.0), ni - 1.0), min(max(y, 0.0), nj - 1.0), min(max(z, 0.0), nk - 1.0)
        i, j, k = lower(x, ni), lower(y, nj), lower(z, nk)
        out.values[n], dx, dy, dz = value_and_slope(voxels, i, j, k, x - i, y - j, z - k)
        dx, dy, dz = sx * dx, sy * dy, sz * dz
        for m in range(3):
            out.gradient[m, n] = ijk_from_ras[0, m] * dx + ijk_from_ras[1, m] * dy + ijk_from_ras[2, m] * dz


def warp_samples(
    voxels: Array, base: Array, displacement: Array, index: Array, ijk_from_ras: Array
) -> tuple[Array, Array]:
    """Values (n,) and gradients (3, n) per mm of voxels (ni, nj, nk) at base + A u, in the precision of u.

    base: (n, 3) voxel coordinates; displacement: u (3, m) mm, read at index (n,); ijk_from_ras: A, (3, 3), 1/mm.
    Beyond the image its nearest value holds, so its gradient is zero there.
    """
    n = len(base)
    out = _Samples(np.empty(n, dtype=displacement.dtype), np.empty((3, n), dtype=displacement.dtype))
    in_parts(partial(_warp, voxels, base, displacement, index, ijk_from_ras, out), n, MANY_POINTS)
    return out.values, out.gradient


def _checked(voxels: Array) -> Array:
    if voxels.ndim != 3 or min(voxels.shape) < 2:
        raise ValueError(f"an image needs three axes of at least 2 voxels to be interpolated, got shape {voxels.shape}")
    return np.ascontiguousarray(voxels, dtype=np.float32)


def interpolate(voxels: Array, grid: Grid, points_ras: Array, fill: float) -> Array:
    """Trilinear values (n,) float32 at points (n, 3) in RAS mm; `fill` outside the hull of the voxel centres."""
    points = np.ascontiguousarray(grid.to_ijk(np.asarray(points_ras, dtype=float)))
    out = np.empty(len(points), dtype=np.float32)
    in_parts(partial(_values, _checked(voxels), points, np.float32(fill), out), len(points), MANY_POINTS)
    return out


def interpolate_affine(voxels: Array, ijk_from_voxel: Array, shape: tuple[int, int, int], fill: float) -> Array:
    """As `interpolate`, at all voxels of a grid of `shape`, float32. ijk_from_voxel: (4, 4), from its indices to those
    of the image.
    """
    out = np.empty(shape, dtype=np.float32)
    in_parts(
        partial(_affine_values, _checked(voxels), np.ascontiguousarray(ijk_from_voxel), np.float32(fill), out), shape[0]
    )
    return out


def interpolate_moved(voxels: Array, grid: Grid, target: Grid, field: tuple[Array, Grid], fill: float) -> Array:
    """Values of voxels (ni, nj, nk) of a grid at those of another one, each moved by the vectors (mi, mj, mk, 3) mm of
    a field on a third one, trilinear; beyond the field its nearest vector holds, beyond the image `fill`.
    """
    vectors, lattice = field
    if 1 in lattice.shape:  # a cell has two voxels along every axis
        vectors = np.pad(vectors, [(0, int(n == 1)) for n in vectors.shape], mode="edge")
    moved = _Moved(
        np.ascontiguousarray(vectors),
        lattice.ijk_from_ras[:3] @ target.ras_from_ijk,
        grid.ijk_from_ras[:3] @ target.ras_from_ijk,
        np.ascontiguousarray(grid.ijk_from_ras[:3, :3]),
    )
    out = np.empty(target.shape, dtype=np.float32)
    in_parts(partial(_moved_values, _checked(voxels), moved, np.float32(fill), out), target.shape[0])
    return out
