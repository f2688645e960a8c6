"""Coarse working copies of images, along the patient's axes, and their masks on other grids."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from registration.images.morphology import bounding_box
from registration.volume import Array, Grid, Mask, Volume
from vatsloc.frames import reorient


def working_copy(volume: Volume, spacing_mm: float) -> Volume:
    """Block means with axes turned to R, A, S and voxels about `spacing_mm` wide; a coarser axis stays."""
    hu, affine = reorient(volume.hu, volume.ras_from_ijk, "RAS")
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
