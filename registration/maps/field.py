"""Dense displacement fields: where each voxel centre of a grid is mapped to."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numba import njit

from registration.kernels.threads import MANY_POINTS, in_parts
from registration.kernels.trilinear import lower, value
from registration.volume import Array, Grid

PointMap = Callable[[Array], Array]


@dataclass(frozen=True, repr=False)
class DisplacementField:
    """Map x -> x + u(x), u trilinear. vectors: (ni, nj, nk, 3), mm, RAS; ras_from_ijk: (4, 4), mm.

    Beyond the grid the displacement of the nearest point of the grid's box holds.
    """

    vectors: Array
    ras_from_ijk: Array

    def __post_init__(self) -> None:
        if self.vectors.ndim != 4 or self.vectors.shape[3] != 3:
            raise ValueError(f"vectors must be (ni, nj, nk, 3), got {self.vectors.shape}")
        if np.shape(self.ras_from_ijk) != (4, 4):
            raise ValueError(f"ras_from_ijk must be (4, 4), got {np.shape(self.ras_from_ijk)}")

    @cached_property
    def grid(self) -> Grid:
        """The voxel lattice, without the vectors."""
        s = self.vectors.shape
        return Grid((s[0], s[1], s[2]), self.ras_from_ijk)

    def __repr__(self) -> str:
        largest = float(np.linalg.norm(self.vectors, axis=3).max())
        return f"DisplacementField({' x '.join(map(str, self.grid.shape))} voxels, at most {largest:.1f} mm)"

    def displacement(self, points_ras: Array) -> Array:
        """u (n, 3) in mm at points (n, 3) in RAS mm."""
        points = np.ascontiguousarray(self.grid.to_ijk(np.asarray(points_ras, dtype=float)))
        out = np.empty((len(points), 3))
        vectors = self.vectors
        if 1 in self.grid.shape:  # a cell has two voxels along every axis
            vectors = np.pad(vectors, [(0, int(n == 1)) for n in vectors.shape], mode="edge")
        in_parts(partial(_vectors, np.ascontiguousarray(vectors), points, out), len(points), MANY_POINTS)
        return out

    def __call__(self, points_ras: Array) -> Array:
        """x + u(x), (n, 3), of points (n, 3) in RAS mm."""
        return np.asarray(points_ras, dtype=float) + self.displacement(points_ras)

    def jacobian_determinant(self) -> Array:
        """det(I + du/dx) on the voxels, (ni, nj, nk) float32, by central differences (one-sided at the border)."""
        out = np.empty(self.grid.shape, dtype=np.float32)
        kernel = partial(_determinant, np.ascontiguousarray(self.vectors), self.grid.ijk_from_ras[:3, :3], out)
        in_parts(kernel, len(out))
        return out


def sample_map(mapping: PointMap, grid: Grid) -> DisplacementField:
    """Any map of points (n, 3) -> (n, 3) as a displacement field (float32) on the voxels of `grid`."""
    vectors = np.empty((*grid.shape, 3), dtype=np.float32)
    for i, points in enumerate(slabs(grid)):
        vectors[i] = (mapping(points) - points).reshape(*grid.shape[1:], 3)
    return DisplacementField(vectors, grid.ras_from_ijk)


def compose(outer: PointMap, inner: DisplacementField) -> DisplacementField:
    """x -> outer(inner(x)) on the grid of `inner`."""
    vectors = np.empty_like(inner.vectors)
    for i, points in enumerate(slabs(inner.grid)):
        moved = points + inner.vectors[i].reshape(-1, 3)
        vectors[i] = (outer(moved) - points).reshape(vectors.shape[1:])
    return DisplacementField(vectors, inner.ras_from_ijk)


def slabs(grid: Grid) -> Iterator[Array]:
    """Voxel centres of each i-slab, (nj * nk, 3), RAS mm: all at once would take 24 bytes per voxel."""
    a = grid.ras_from_ijk
    j, k = (np.multiply.outer(np.arange(grid.shape[m], dtype=float), a[:3, m]) for m in (1, 2))
    plane = (a[:3, 3] + j[:, None] + k[None, :]).reshape(-1, 3)
    for i in range(grid.shape[0]):
        yield plane + i * a[:3, 0]


@njit(cache=True, nogil=True)
def _vectors(vectors, points, out, first, end):
    ni, nj, nk, _ = vectors.shape
    for n in range(first, end):
        x = min(max(points[n, 0], 0.0), ni - 1.0)
        y = min(max(points[n, 1], 0.0), nj - 1.0)
        z = min(max(points[n, 2], 0.0), nk - 1.0)
        i, j, k = lower(x, ni), lower(y, nj), lower(z, nk)
        for m in range(3):
            out[n, m] = value(vectors[:, :, :, m], i, j, k, x - i, y - j, z - k)


@njit(cache=True, nogil=True)
def _determinant(vectors, ijk_from_ras, out, first, end):
    ni, nj, nk, _ = vectors.shape
    for i in range(first, end):
        du, f = np.zeros((3, 3)), np.zeros((3, 3))
        i0, i1 = max(i - 1, 0), min(i + 1, ni - 1)
        for j in range(nj):
            j0, j1 = max(j - 1, 0), min(j + 1, nj - 1)
            for k in range(nk):
                k0, k1 = max(k - 1, 0), min(k + 1, nk - 1)
                for m in range(3):
                    du[m, 0] = (vectors[i1, j, k, m] - vectors[i0, j, k, m]) / max(i1 - i0, 1)
                    du[m, 1] = (vectors[i, j1, k, m] - vectors[i, j0, k, m]) / max(j1 - j0, 1)
                    du[m, 2] = (vectors[i, j, k1, m] - vectors[i, j, k0, m]) / max(k1 - k0, 1)
                for r in range(3):
                    for s in range(3):
                        f[r, s] = 1.0 if r == s else 0.0
                        for m in range(3):
                            f[r, s] += du[r, m] * ijk_from_ras[m, s]
                out[i, j, k] = (
                    f[0, 0] * (f[1, 1] * f[2, 2] - f[1, 2] * f[2, 1])
                    - f[0, 1] * (f[1, 0] * f[2, 2] - f[1, 2] * f[2, 0])
                    + f[0, 2] * (f[1, 0] * f[2, 1] - f[1, 1] * f[2, 0])
                )
