"""Images in space: a grid of voxels with its affine to RAS millimetres."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Array = NDArray[Any]
Cut = tuple[slice, slice, slice]


@dataclass(frozen=True)
class Grid:
    """Voxel lattice in space. shape: (ni, nj, nk); ras_from_ijk: (4, 4), mm, orthogonal axes."""

    shape: tuple[int, int, int]
    ras_from_ijk: Array

    def __post_init__(self) -> None:
        if np.shape(self.ras_from_ijk) != (4, 4):
            raise ValueError(f"ras_from_ijk must be (4, 4), got {np.shape(self.ras_from_ijk)}")

    @cached_property
    def spacing(self) -> Array:
        """Voxel edge lengths in mm, (3,)."""
        return np.linalg.norm(self.ras_from_ijk[:3, :3], axis=0)

    @cached_property
    def ijk_from_ras(self) -> Array:
        """Inverse affine, (4, 4)."""
        return np.linalg.inv(self.ras_from_ijk)

    def points(self) -> Array:
        """Voxel centres in RAS mm, (ni, nj, nk, 3)."""
        axes = [np.arange(n, dtype=float) for n in self.shape]
        a = self.ras_from_ijk
        i, j, k = (np.multiply.outer(axis, a[:3, m]) for m, axis in enumerate(axes))
        return a[:3, 3] + i[:, None, None] + j[None, :, None] + k[None, None, :]

    def to_ijk(self, points_ras: Array) -> Array:
        """Continuous voxel coordinates of points (..., 3) in RAS mm."""
        return points_ras @ self.ijk_from_ras[:3, :3].T + self.ijk_from_ras[:3, 3]

    def to_ras(self, points_ijk: Array) -> Array:
        """RAS mm of continuous voxel coordinates (..., 3)."""
        return points_ijk @ self.ras_from_ijk[:3, :3].T + self.ras_from_ijk[:3, 3]

    def with_spacing(self, spacing_mm: float | Array) -> Grid:
        """Grid over the same box with voxels `spacing_mm` wide (scalar or (3,)), first voxel's outer corner kept."""
        new = np.broadcast_to(np.asarray(spacing_mm, dtype=float), (3,))
        size = np.maximum(np.rint(np.array(self.shape) * self.spacing / new), 1).astype(int)
        ratio = new / self.spacing
        affine = self.ras_from_ijk.copy()
        affine[:3, :3] = self.ras_from_ijk[:3, :3] * ratio
        affine[:3, 3] = self.to_ras((ratio - 1) / 2)
        return Grid((int(size[0]), int(size[1]), int(size[2])), affine)

    def box(self, lower_ijk: Array, upper_ijk: Array) -> Grid:
        """Sub-grid of voxels lower <= ijk < upper, clipped to this grid."""
        return self.part(self.cut(lower_ijk, upper_ijk))

    def part(self, cut: Cut) -> Grid:
        """Sub-grid of the voxels of three slices."""
        spans = [span.indices(n) for span, n in zip(cut, self.shape, strict=True)]
        affine = self.ras_from_ijk.copy()
        affine[:3, 3] = self.to_ras(np.array([float(start) for start, _, _ in spans]))
        i, j, k = (stop - start for start, stop, _ in spans)
        return Grid((i, j, k), affine)

    def cut(self, lower_ijk: Array, upper_ijk: Array) -> Cut:
        """Where `box` lies in this grid's arrays."""
        lo = np.clip(np.floor(lower_ijk), 0, self.shape).astype(int)
        hi = np.clip(np.ceil(upper_ijk), lo, self.shape).astype(int)
        i, j, k = (slice(int(a), int(b)) for a, b in zip(lo, hi, strict=True))
        return i, j, k

    def same_as(self, other: Grid, tolerance_mm: float = 1e-3) -> bool:
        """Whether both grids have equal shapes and corners that agree within `tolerance_mm`."""
        if self.shape != other.shape:
            return False
        corners = np.array([[a, b, c] for a in (0, 1) for b in (0, 1) for c in (0, 1)]) * (np.array(self.shape) - 1.0)
        return bool(np.abs(self.to_ras(corners) - other.to_ras(corners)).max() <= tolerance_mm)


class _OnGrid:
    """What every array on a grid shares."""

    ras_from_ijk: Array

    def _values(self) -> Array:
        raise NotImplementedError

    @cached_property
    def grid(self) -> Grid:
        """The voxel lattice, without the values."""
        s = self._values().shape
        return Grid((s[0], s[1], s[2]), self.ras_from_ijk)

    def __repr__(self) -> str:
        sp = " x ".join(f"{s:.2f}" for s in self.grid.spacing)
        shape = " x ".join(str(n) for n in self.grid.shape)
        return f"{type(self).__name__}({shape} voxels of {sp} mm, axes {axis_codes(self.ras_from_ijk)})"


@dataclass(frozen=True, repr=False)
class Volume(_OnGrid):
    """Scalar image. hu: (ni, nj, nk) float32; ras_from_ijk: (4, 4), mm."""

    hu: Array
    ras_from_ijk: Array

    def __post_init__(self) -> None:
        if self.hu.ndim != 3:
            raise ValueError(f"hu must have three axes, got shape {self.hu.shape}")
        if np.shape(self.ras_from_ijk) != (4, 4):
            raise ValueError(f"ras_from_ijk must be (4, 4), got {np.shape(self.ras_from_ijk)}")

    def _values(self) -> Array:
        return self.hu

    def part(self, cut: Cut) -> Volume:
        """The voxels of three slices."""
        return Volume(self.hu[cut], self.grid.part(cut).ras_from_ijk)


@dataclass(frozen=True, repr=False)
class Mask(_OnGrid):
    """Region of space. inside: (ni, nj, nk) bool; ras_from_ijk: (4, 4), mm."""

    inside: Array
    ras_from_ijk: Array

    def __post_init__(self) -> None:
        if self.inside.ndim != 3 or self.inside.dtype != bool:
            raise ValueError(
                f"inside must be a boolean array of three axes, got {self.inside.dtype} {self.inside.shape}"
            )

    def _values(self) -> Array:
        return self.inside

    def holds(self, points_ras: Array) -> Array:
        """Whether points (n, 3) fall into voxels of the region, (n,) bool."""
        ijk = np.rint(self.grid.to_ijk(points_ras)).astype(int)
        within = np.all((ijk >= 0) & (ijk < self.inside.shape), axis=1)
        result = np.zeros(len(ijk), dtype=bool)
        result[within] = self.inside[tuple(ijk[within].T)]
        return result

    def distance(self, point_ras: Array) -> float:
        """How far in mm a point (3,) lies from the nearest voxel centre of the region; 0 in one of its voxels, infinite
        from an empty region."""
        if self.holds(point_ras[None])[0]:
            return 0.0
        rim = np.argwhere(self.inside & ~ndimage.binary_erosion(self.inside))
        return float(np.linalg.norm(self.grid.to_ras(rim.astype(float)) - point_ras, axis=1).min(initial=np.inf))

    def padded(self) -> Mask:
        """The same region with one more voxel, outside it, on every side of the grid."""
        affine = self.ras_from_ijk.copy()
        affine[:3, 3] = self.grid.to_ras(np.full(3, -1.0))
        return Mask(np.pad(self.inside, 1), affine)

    def part(self, cut: Cut) -> Mask:
        """The voxels of three slices."""
        return Mask(self.inside[cut], self.grid.part(cut).ras_from_ijk)


def axis_codes(ras_from_ijk: Array) -> str:
    """Anatomical letters of the voxel axes, for instance "LPS"."""
    codes = ""
    for axis in ras_from_ijk[:3, :3].T:
        m = int(np.argmax(np.abs(axis)))
        codes += ("RAS" if axis[m] > 0 else "LPI")[m]
    return codes
