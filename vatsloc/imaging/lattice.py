"""Coarse working copies of images, along the patient's axes, and morphology measured in millimetres."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from registration.volume import Array, Grid, Mask, Volume

TIE_MM = 1e-6
"""Spacings of a turned grid are rounded; a distance equal to the radius has to stay equal."""


def working_copy(volume: Volume, spacing_mm: float) -> Volume:
    """Block means with axes turned to R, A, S and voxels about `spacing_mm` wide; a coarser axis stays."""
    hu, affine = _turned(volume.hu, volume.ras_from_ijk)
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    block = np.clip(np.rint(spacing_mm / spacing).astype(int), 1, hu.shape)
    size = np.array(hu.shape) // block
    affine = affine.copy()
    affine[:3, 3] += affine[:3, :3] @ ((block - 1) / 2)
    affine[:3, :3] = affine[:3, :3] * block
    total = np.zeros(tuple(size), dtype=np.float32)
    ni, nj, nk = size * block
    for a in range(block[0]):
        for b in range(block[1]):
            for c in range(block[2]):
                total += hu[a : ni : block[0], b : nj : block[1], c : nk : block[2]]
    return Volume(total / np.float32(block.prod()), affine)


def _turned(values: Array, ras_from_ijk: Array) -> tuple[Array, Array]:
    """The same voxels with the axis nearest to R first, then A, then S, each pointing that way."""
    order, direction = [], ras_from_ijk[:3, :3] / np.linalg.norm(ras_from_ijk[:3, :3], axis=0)
    left = [0, 1, 2]
    for patient_axis in range(3):
        best = max(left, key=lambda m: abs(direction[patient_axis, m]))
        order.append(best)
        left.remove(best)
    affine = ras_from_ijk.copy()
    affine[:3, :3] = ras_from_ijk[:3, order]
    values = values.transpose(order)
    for m in range(3):
        if affine[m, m] < 0:
            values = np.flip(values, m)
            affine[:3, 3] += affine[:3, m] * (values.shape[m] - 1)
            affine[:3, m] = -affine[:3, m]
    return values, affine


def on_grid(inside: Array, source: Grid, target: Grid, smooth_mm: float = 0.0) -> Mask:
    """A working mask on `target`: trilinear membership of at least one half, first smoothed by `smooth_mm`."""
    membership = inside.astype(np.float32)
    if smooth_mm > 0:
        membership = ndimage.gaussian_filter(membership, smooth_mm / source.spacing, mode="nearest")
    out = np.zeros(target.shape, dtype=bool)
    if inside.any():
        box = bounding_box(inside, np.full(3, 2))
        lower, upper = np.array([[b.start - 2.0, b.stop + 1.0] for b in box]).T
        corners = lower + np.array([[a, b, c] for a in (0, 1) for b in (0, 1) for c in (0, 1)]) * (upper - lower)
        ijk = target.to_ijk(source.to_ras(corners))
        lo = np.clip(np.floor(ijk.min(axis=0)), 0, target.shape).astype(int)
        part = target.box(lo, np.maximum(ijk.max(axis=0) + 1, lo))
        step = source.ijk_from_ras @ part.ras_from_ijk
        linear = step[:3, :3]
        aligned = np.allclose(linear, np.diag(np.diag(linear)))
        value = ndimage.affine_transform(
            membership,
            np.diag(linear) if aligned else linear,
            step[:3, 3],
            part.shape,
            order=1,
            mode="constant",
            prefilter=False,
        )
        out[tuple(slice(a, a + n) for a, n in zip(lo, part.shape, strict=True))] = value >= 0.5
    return Mask(out, target.ras_from_ijk)


def bounding_box(inside: Array, margin: Array) -> tuple[slice, slice, slice]:
    """Slices around the true voxels, `margin` voxels wider, clipped to the array."""
    found = [np.flatnonzero(inside.any(axis=tuple(m for m in range(3) if m != axis))) for axis in range(3)]
    lo = [max(int(f[0]) - int(g), 0) for f, g in zip(found, margin, strict=True)]
    hi = [int(f[-1]) + int(g) + 1 for f, g in zip(found, margin, strict=True)]
    return slice(lo[0], hi[0]), slice(lo[1], hi[1]), slice(lo[2], hi[2])


def dilate(inside: Array, radius_mm: float, spacing: Array) -> Array:
    """Voxels within `radius_mm` of `inside` (a ball, voxels `spacing` mm wide)."""
    if not inside.any():
        return inside.copy()
    box = bounding_box(inside, np.ceil(radius_mm / spacing) + 1)
    out = np.zeros_like(inside)
    out[box] = ndimage.distance_transform_edt(~inside[box], sampling=spacing) <= radius_mm + TIE_MM
    return out


def erode(inside: Array, radius_mm: float, spacing: Array) -> Array:
    """Voxels farther than `radius_mm` from everything outside; the image's border does not erode."""
    if not inside.any() or inside.all():
        return inside.copy()
    box = bounding_box(inside, np.ceil(radius_mm / spacing) + 1)
    out = np.zeros_like(inside)
    out[box] = ndimage.distance_transform_edt(inside[box], sampling=spacing) > radius_mm + TIE_MM
    return out


def close(inside: Array, radius_mm: float, spacing: Array) -> Array:
    """Closing by a ball of `radius_mm`: dents and holes that the ball cannot enter are filled."""
    return erode(dilate(inside, radius_mm, spacing), radius_mm, spacing) | inside


def largest(inside: Array, structure: Array | None = None) -> Array:
    """The largest connected part (empty when `inside` is)."""
    labels, count = ndimage.label(inside, structure)
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
