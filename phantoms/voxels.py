"""Pictures in space, as phantoms give them: voxels with the affine that takes them to RAS millimetres."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True)
class Grid:
    """Where the voxels are. shape: (ni, nj, nk); ras_from_ijk: (4, 4), mm, orthogonal axes."""

    shape: tuple[int, int, int]
    ras_from_ijk: Array

    @cached_property
    def spacing(self) -> Array:
        """Edges of a voxel in mm, (3,)."""
        return np.linalg.norm(self.ras_from_ijk[:3, :3], axis=0)

    @cached_property
    def _back(self) -> Array:
        return np.linalg.inv(self.ras_from_ijk)

    def points(self) -> Array:
        """Centres of the voxels in RAS mm, (ni, nj, nk, 3)."""
        a = self.ras_from_ijk
        i, j, k = (np.multiply.outer(np.arange(n, dtype=float), a[:3, m]) for m, n in enumerate(self.shape))
        return a[:3, 3] + i[:, None, None] + j[None, :, None] + k[None, None, :]

    def to_ijk(self, points: Array) -> Array:
        """Voxel coordinates, in fractions, of points (..., 3) in RAS mm."""
        return points @ self._back[:3, :3].T + self._back[:3, 3]

    def to_ras(self, index: Array) -> Array:
        """RAS mm of voxel coordinates (..., 3), in fractions."""
        return index @ self.ras_from_ijk[:3, :3].T + self.ras_from_ijk[:3, 3]

    def box(self, lower: Array, upper: Array) -> Grid:
        """The voxels lower <= ijk < upper (3,) of this grid, those beyond it left out."""
        lo = np.clip(np.floor(lower), 0, self.shape).astype(int)
        hi = np.clip(np.ceil(upper), lo, self.shape).astype(int)
        affine = self.ras_from_ijk.copy()
        affine[:3, 3] = self.to_ras(lo.astype(float))
        i, j, k = (int(n) for n in hi - lo)
        return Grid((i, j, k), affine)


@dataclass(frozen=True)
class Image:
    """Densities in space. hu: (ni, nj, nk) float32; ras_from_ijk: (4, 4), mm."""

    hu: Array
    ras_from_ijk: Array

    @cached_property
    def grid(self) -> Grid:
        """Where its voxels are."""
        return _grid(self.hu, self.ras_from_ijk)


@dataclass(frozen=True)
class Region:
    """Part of space. inside: (ni, nj, nk) bool; ras_from_ijk: (4, 4), mm."""

    inside: Array
    ras_from_ijk: Array

    @cached_property
    def grid(self) -> Grid:
        """Where its voxels are."""
        return _grid(self.inside, self.ras_from_ijk)


def _grid(values: Array, ras_from_ijk: Array) -> Grid:
    ni, nj, nk = values.shape
    return Grid((ni, nj, nk), ras_from_ijk)
