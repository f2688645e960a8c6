"""Images at the voxel size of a registration's level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from registration.resample import coarsen, coarsen_mask
from registration.similarity import Samples
from registration.volume import Array, Mask, Volume


@dataclass(frozen=True)
class Images:
    """One level: fixed values (n,) at the samples, the moving image, and where that sees, in [0, 1]."""

    samples: Samples
    fixed: Array
    moving: Volume
    seen: Volume | None


class Pyramid:
    """A pair of images that can be coarsened to any voxel size."""

    def __init__(self, fixed: Volume, fixed_mask: Mask, moving: Volume, moving_mask: Mask | None) -> None:
        self._fixed, self._fixed_mask, self._moving, self._moving_mask = fixed, fixed_mask, moving, moving_mask

    def at(self, voxel_mm: float) -> Images:
        """The pair with voxels of `voxel_mm`; what the moving image does not see never blurs into what it sees."""
        fixed = coarsen(self._fixed, voxel_mm)
        index = np.flatnonzero(coarsen_mask(self._fixed_mask, voxel_mm).hu >= 0.5)
        if self._moving_mask is None:
            moving, seen = coarsen(self._moving, voxel_mm), None
        else:
            seen = coarsen_mask(self._moving_mask, voxel_mm)
            inside = self._moving_mask.inside
            level = self._moving.hu[inside].mean(dtype=float) if inside.any() else 0.0
            hu = np.where(inside, self._moving.hu - np.float32(level), np.float32(0))
            moving = coarsen(Volume(hu, self._moving.ras_from_ijk), voxel_mm)
            hu = moving.hu / np.maximum(seen.hu, 0.05) + np.float32(level)
            moving = Volume(hu.astype(np.float32), moving.ras_from_ijk)
        return Images(Samples(fixed.grid, index), fixed.hu.reshape(-1)[index], moving, seen)


def cropped(fixed: Volume, mask: Mask, margin_mm: float = 8.0) -> tuple[Volume, Mask]:
    """Both restricted to the mask's bounding box and a margin."""
    if not fixed.grid.same_as(mask.grid):
        raise ValueError(f"the fixed mask must lie on the fixed image's grid: {mask!r} against {fixed!r}; resample it")
    where = np.argwhere(mask.inside)
    if len(where) == 0:
        raise ValueError("the fixed mask is empty; nothing to register, check the segmentation")
    margin = margin_mm / fixed.grid.spacing
    box = fixed.grid.box(where.min(axis=0) - margin, where.max(axis=0) + 1 + margin)
    lo = np.rint(fixed.grid.to_ijk(box.ras_from_ijk[:3, 3])).astype(int)
    cut = tuple(slice(a, a + n) for a, n in zip(lo, box.shape, strict=True))
    return Volume(fixed.hu[cut], box.ras_from_ijk), Mask(mask.inside[cut], box.ras_from_ijk)
