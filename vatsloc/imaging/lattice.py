"""Coarse working copies of images, along the patient's axes, and their masks on other grids."""

from __future__ import annotations

import numpy as np

from registration.images.filters import gaussian
from registration.images.morphology import bounding_box
from registration.images.resample import resample
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
    out = np.zeros(target.shape, dtype=bool)
    if inside.any():
        box = bounding_box(inside, np.ceil(4 * smooth_mm / source.spacing) + 2)
        membership, near = inside[box].astype(np.float32), source.part(box)
        if smooth_mm > 0:
            membership = gaussian(membership, smooth_mm / source.spacing, mode="nearest")
        corners = np.array([[a, b, c] for a in (0, 1) for b in (0, 1) for c in (0, 1)]) * (np.array(near.shape) - 1)
        ijk = target.to_ijk(near.to_ras(corners.astype(float)))
        lower, upper = np.floor(ijk.min(axis=0)), ijk.max(axis=0) + 1
        on_part = resample(Volume(membership, near.ras_from_ijk), target.box(lower, upper), fill=0.0)
        out[target.cut(lower, upper)] = on_part.hu >= 0.5
    return Mask(out, target.ras_from_ijk)
