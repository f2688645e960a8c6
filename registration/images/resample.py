"""Images seen through a map: resampling on another grid, and coarsening."""

from __future__ import annotations

import numpy as np

from registration.images.interpolate import EDGE, interpolate, interpolate_affine, interpolate_moved
from registration.kernels.banded import Banded, along_axes
from registration.maps.field import DisplacementField, PointMap, slabs
from registration.maps.rigid import RigidTransform
from registration.volume import Array, Grid, Mask, Volume


def resample(volume: Volume, grid: Grid, fixed_to_moving: PointMap | None = None, fill: float = -1000.0) -> Volume:
    """`volume` on `grid`: the value at x is volume(fixed_to_moving(x)), trilinear; `fill` outside the volume.

    fixed_to_moving: None (identity) or any map of points (n, 3) in RAS mm.
    """
    return Volume(_sampled(volume.hu, volume.grid, grid, fixed_to_moving, fill), grid.ras_from_ijk)


def resample_mask(mask: Mask, grid: Grid, fixed_to_moving: PointMap | None = None) -> Mask:
    """`mask` on `grid`: inside where the trilinear membership is at least one half."""
    membership = _sampled(mask.inside.astype(np.float32), mask.grid, grid, fixed_to_moving, 0.0)
    return Mask(membership >= 0.5, grid.ras_from_ijk)


def coarsen(volume: Volume, spacing_mm: float) -> Volume:
    """Smoothed copy with voxels of `spacing_mm`; an axis already coarser keeps its own spacing.

    The Gaussian has the variance (h_new^2 - h_old^2) / 6: enough against aliasing without blurring away vessels one new
    voxel wide.
    """
    spacing = volume.grid.spacing
    wanted = np.maximum(spacing_mm, spacing)
    if np.allclose(wanted, spacing):
        return volume
    return _filtered(volume, volume.grid.with_spacing(wanted), np.sqrt((wanted**2 - spacing**2) / 6))


def coarsen_mask(mask: Mask, spacing_mm: float) -> Volume:
    """Share of each coarse voxel's neighbourhood that lies in the mask, in [0, 1]."""
    return coarsen(Volume(mask.inside.astype(np.float32), mask.ras_from_ijk), spacing_mm)


def _filtered(volume: Volume, grid: Grid, sigma_mm: Array) -> Volume:
    """Gaussian-weighted means at the voxels of a parallel grid: one matrix per axis, as in a B-spline lattice."""
    a = volume.grid.ijk_from_ras @ grid.ras_from_ijk
    matrices = []
    for m in range(3):
        distance = a[m, m] * np.arange(grid.shape[m])[:, None] + a[m, 3] - np.arange(volume.hu.shape[m])[None, :]
        sigma = sigma_mm[m] / volume.grid.spacing[m]
        if sigma > 0.25:
            weights = np.exp(-(distance**2) / (2 * sigma**2)) * (np.abs(distance) <= 4 * sigma + 1)
        else:
            weights = np.maximum(1 - np.abs(distance), 0)
        matrices.append(Banded(weights / weights.sum(axis=1, keepdims=True)))
    voxels = np.ascontiguousarray(volume.hu, dtype=np.float32)
    return Volume(along_axes(voxels[None], matrices)[0], grid.ras_from_ijk)


def _sampled(voxels: Array, source: Grid, target: Grid, mapping: PointMap | None, fill: float) -> Array:
    if mapping is None and source.same_as(target):
        return np.array(voxels, dtype=np.float32)
    voxels = np.ascontiguousarray(voxels, dtype=np.float32)
    if mapping is None or isinstance(mapping, RigidTransform):
        moved = target.ras_from_ijk if mapping is None else mapping.matrix @ target.ras_from_ijk
        ijk_from_target = source.ijk_from_ras @ moved
        if _is_diagonal(ijk_from_target[:3, :3], target.shape):
            return _along_axes(voxels, np.diag(ijk_from_target), ijk_from_target[:3, 3], target.shape, fill)
        return interpolate_affine(voxels, ijk_from_target, target.shape, fill)
    if isinstance(mapping, DisplacementField):
        return interpolate_moved(voxels, source, target, (mapping.vectors, mapping.grid), fill)
    out = np.empty(target.shape, dtype=np.float32)
    for i, points in enumerate(slabs(target)):
        out[i] = interpolate(voxels, source, mapping(points), fill).reshape(target.shape[1:])
    return out


def _is_diagonal(linear: Array, shape: tuple[int, int, int]) -> bool:
    """Whether the axes of two grids are parallel: what else a matrix does is below EDGE over a grid of `shape`."""
    across = np.abs(linear - np.diag(np.diag(linear))) * shape
    return bool(across.sum(axis=1).max() < EDGE)


def _along_axes(voxels: Array, scale: Array, shift: Array, shape: tuple[int, int, int], fill: float) -> Array:
    """Trilinear values on a parallel grid, whose voxel i lies at scale i + shift of the image: axis by axis."""
    if 0 in shape:
        return np.zeros(shape, np.float32)
    matrices, beyond = [], []
    for m, n in enumerate(voxels.shape):
        at = scale[m] * np.arange(shape[m]) + shift[m]
        beyond.append((at < -EDGE) | (at > n - 1 + EDGE))
        off = np.abs(np.clip(at, 0, n - 1)[:, None] - np.arange(n))
        matrices.append(Banded(np.maximum(1 - off, 0)))
    out = along_axes(voxels[None], matrices)[0]
    for m, rows in enumerate(beyond):
        out[(slice(None),) * m + (rows,)] = fill
    return out
