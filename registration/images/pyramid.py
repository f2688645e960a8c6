"""Images at the voxel size of a registration's level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from registration.images.morphology import bounding_box
from registration.images.resample import coarsen, coarsen_mask
from registration.volume import Array, Grid, Mask, Volume

BLOCK = 2
"""Edge in voxels of the blocks on which the gradient of a map is looked at."""


@dataclass(frozen=True)
class Samples:
    """Voxels of the fixed image where images are compared. index: (n,) flat voxel indices on grid."""

    grid: Grid
    index: Array

    def points(self) -> Array:
        """Their centres, (n, 3), RAS mm."""
        return self.grid.to_ras(np.stack(np.unravel_index(self.index, self.grid.shape), axis=1).astype(float))

    def blocks(self, edge: int = BLOCK) -> tuple[Grid, Array]:
        """Grid of blocks of edge^3 voxels, and the flat index (n,) of each sample's block."""
        size = tuple(-(-n // edge) for n in self.grid.shape)
        affine = self.grid.ras_from_ijk.copy()
        affine[:3, :3] *= edge
        affine[:3, 3] = self.grid.to_ras(np.full(3, (edge - 1) / 2))
        i, j, k = np.unravel_index(self.index, self.grid.shape)
        grid = Grid((size[0], size[1], size[2]), affine)
        return grid, np.ravel_multi_index((i // edge, j // edge, k // edge), grid.shape)


@dataclass(frozen=True)
class PyramidLevel:
    """One level: fixed values (n,) at the samples, the moving image, and where that sees, in [0, 1]."""

    samples: Samples
    fixed: Array
    moving: Volume
    seen: Volume | None


class Pyramid:
    """A pair of images that can be coarsened to any voxel size from `finest_mm` on.

    Every size is made from the finest, whose Gaussians add up; what the moving image does not see never blurs into what
    it sees.
    """

    def __init__(
        self, fixed: Volume, fixed_mask: Mask, moving: Volume, moving_mask: Mask | None, finest_mm: float
    ) -> None:
        self._fixed, self._inside = coarsen(fixed, finest_mm), coarsen_mask(fixed_mask, finest_mm)
        self._level, self._seen = np.float32(0), None
        if moving_mask is not None:
            seen = moving_mask.inside
            self._level = np.float32(moving.hu[seen].mean(dtype=float) if seen.any() else 0)
            self._seen = coarsen_mask(moving_mask, finest_mm)
            moving = Volume(np.where(seen, moving.hu - self._level, np.float32(0)), moving.ras_from_ijk)
        self._moving = coarsen(moving, finest_mm)

    def at(self, voxel_mm: float) -> PyramidLevel:
        """The pair with voxels of `voxel_mm`."""
        fixed, inside, moving = (coarsen(v, voxel_mm) for v in (self._fixed, self._inside, self._moving))
        index = np.flatnonzero(inside.hu >= 0.5)
        seen = None
        if self._seen is not None:
            seen = coarsen(self._seen, voxel_mm)
            hu = moving.hu / np.maximum(seen.hu, np.float32(0.05)) + self._level
            moving = Volume(hu, moving.ras_from_ijk)
        return PyramidLevel(Samples(fixed.grid, index), fixed.hu.reshape(-1)[index], moving, seen)


MARGIN_MM = 8.0
"""What is kept around a mask."""


def cropped(fixed: Volume, mask: Mask) -> tuple[Volume, Mask]:
    """Both restricted to the mask's bounding box and a margin."""
    if not fixed.grid.same_as(mask.grid):
        raise ValueError(f"the fixed mask must lie on the fixed image's grid: {mask!r} against {fixed!r}; resample it")
    cut = bounding_box(mask.inside, np.ceil(MARGIN_MM / fixed.grid.spacing).astype(int))
    return fixed.part(cut), mask.part(cut)
