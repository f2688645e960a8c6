"""The images' term: dissimilarity of the fixed image and the moving image seen through T(x) = P(x) + u(x)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from registration.bspline import Lattice
from registration.field import PointMap
from registration.interpolate import interpolate, warp_samples
from registration.metric import Similarity
from registration.objective import Model
from registration.stretch import Stretch, cofactor, determinant
from registration.volume import Array, Grid, Volume

BLOCK = 2


class Metric(Protocol):
    """A dissimilarity of the samples; see `registration.metric`."""

    def evaluate(self, m: Array, w: Array, with_slope: bool = True) -> Similarity: ...


@dataclass(frozen=True)
class Samples:
    """Voxels of the fixed image where images are compared. index: (n,) flat voxel indices on grid."""

    grid: Grid
    index: Array

    def points(self) -> Array:
        """Their centres, (n, 3), RAS mm."""
        return self.grid.to_ras(np.stack(np.unravel_index(self.index, self.grid.shape), axis=1).astype(float))

    def blocks(self) -> tuple[Grid, Array]:
        """Grid of blocks of 2^3 voxels, and the flat index (n,) of each sample's block."""
        size = tuple(-(-n // BLOCK) for n in self.grid.shape)
        affine = self.grid.ras_from_ijk.copy()
        affine[:3, :3] *= BLOCK
        affine[:3, 3] = self.grid.to_ras(np.full(3, (BLOCK - 1) / 2))
        i, j, k = np.unravel_index(self.index, self.grid.shape)
        grid = Grid((size[0], size[1], size[2]), affine)
        return grid, np.ravel_multi_index((i // BLOCK, j // BLOCK, k // BLOCK), grid.shape)


class ImageTerm:
    """D(f, m o T) over the samples.

    seen: where the moving image shows anything, in [0, 1]: samples that leave it lose their weight, which `refresh`
    resets and every evaluation keeps. mass_preserving: compare with (m + 1000) det(dT/dx) - 1000, the HU of the same
    mass in the fixed image's volume.
    """

    def __init__(
        self,
        samples: Samples,
        metric: Metric,
        moving: Volume,
        prior: PointMap,
        control: Grid,
        seen: Volume | None = None,
        mass_preserving: bool = False,
    ) -> None:
        self.samples, self._metric, self._moving, self._seen = samples, metric, moving, seen
        self._lattice = Lattice(control, samples.grid)
        self._points = prior(samples.points())
        self._base = np.ascontiguousarray(moving.grid.to_ijk(self._points))
        self._a = np.ascontiguousarray(moving.grid.ijk_from_ras[:3, :3])
        self.share = np.ones(len(samples.index), dtype=np.float32)
        blocks, self._block = samples.blocks()
        self._coarse = Lattice(control, blocks)
        self._stretch = Stretch(control, blocks, prior) if mass_preserving else None

    def refresh(self, c: Array) -> None:
        """Reset each sample's weight to how well the moving image sees it at c (soft rejection)."""
        if self._seen is not None:
            moved = self._points + self._displacement(c)[:, self.samples.index].T
            share = 4 * interpolate(self._seen.hu, self._seen.grid, moved, 0.0) - 3
            self.share = np.clip(share, 0, 1).astype(np.float32)

    def value(self, c: Array) -> float:
        """D at c."""
        m, _ = self._warped(self._displacement(c))
        if self._stretch is not None:
            m = (m + 1000) * self._det(c)[0] - 1000
        return self._metric.evaluate(m, self.share, with_slope=False).value

    def model(self, c: Array) -> Model:
        """D, its exact gradient, and a Gauss-Newton Hessian that leaves out how det(dT/dx) changes.

        The samples' tensors h g g^T are summed over blocks of 2^3 voxels: splines several blocks wide hardly tell.
        """
        u = self._displacement(c)
        m, g = self._warped(u)
        through_det = None
        if self._stretch is None:
            here = self._metric.evaluate(m, self.share)
        else:
            det, f = self._det(c)
            here = self._metric.evaluate((m + 1000) * det - 1000, self.share)
            slope = self._sum(here.slope * (m + 1000))
            through_det = self._stretch.adjoint(slope * cofactor(f))
            g = g * det.astype(g.dtype)
        force = np.zeros_like(u)
        force[:, self.samples.index] = here.slope * g
        gradient = self._lattice.adjoint(force.reshape(3, *self.samples.grid.shape)).astype(float)
        if through_det is not None:
            gradient += through_det
        pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
        tensor = np.stack([self._sum(here.curvature * g[a] * g[b]) for a, b in pairs]).astype(np.float32)
        diagonal = self._coarse.adjoint_squared(tensor[[0, 3, 5]])
        return Model(here.value, gradient, _tensor_product(self._coarse, tensor), diagonal)

    def _displacement(self, c: Array) -> Array:
        return np.ascontiguousarray(self._lattice.forward(c).reshape(3, -1))

    def _warped(self, u: Array) -> tuple[Array, Array]:
        return warp_samples(self._moving.hu, self._base, u, self.samples.index, self._a)

    def _det(self, c: Array) -> tuple[Array, Array]:
        """det(dT/dx) of each sample's block, (n,), and the blocks' gradients."""
        assert self._stretch is not None
        f = self._stretch.gradient(c)
        return determinant(f).reshape(-1)[self._block], f

    def _sum(self, values: Array) -> Array:
        """Sums of the samples' values (n,) over the blocks, (bi, bj, bk)."""
        shape = self._coarse.grid.shape
        return np.bincount(self._block, values, int(np.prod(shape))).reshape(shape)


def _tensor_product(lattice: Lattice, t: Array) -> Callable[[Array], Array]:
    """d -> B^T t B d, t (6, bi, bj, bk): aa, ab, ac, bb, bc, cc."""

    def apply(d: Array) -> Array:
        x, y, z = lattice.forward(d)
        force = np.empty((3, *t.shape[1:]), dtype=np.float32)
        force[0] = t[0] * x + t[1] * y + t[2] * z
        force[1] = t[1] * x + t[3] * y + t[4] * z
        force[2] = t[2] * x + t[4] * y + t[5] * z
        return lattice.adjoint(force)

    return apply
