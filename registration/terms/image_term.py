"""The images' term: dissimilarity of the fixed image and the moving image seen through T(x) = P(x) + u(x)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import prod

import numpy as np

from registration.images.interpolate import interpolate, warp_samples
from registration.images.pyramid import Samples
from registration.maps.bspline import Lattice
from registration.maps.composite import is_separable
from registration.maps.field import PointMap
from registration.terms.metrics import Dissimilarity, Metric
from registration.terms.objective import QuadraticModel
from registration.volume import Array, Grid, Volume

HESSIAN_BLOCK = 4


class ImageTerm:
    """D(f, m o T) over the samples.

    seen: where the moving image shows anything, in [0, 1]: samples that leave it lose their weight, which `refresh`
    resets and every evaluation keeps. What the line search saw last is kept, for the model is asked for there next.
    """

    def __init__(
        self,
        samples: Samples,
        metric: Metric,
        moving: Volume,
        prior: PointMap,
        control: Grid,
        seen: Volume | None = None,
    ) -> None:
        self.samples, self._metric, self._moving, self._seen = samples, metric, moving, seen
        self._lattice = Lattice(control, samples.grid)
        self._points = _mapped(prior, samples)
        self._base = np.ascontiguousarray(moving.grid.to_ijk(self._points))
        self._a = np.ascontiguousarray(moving.grid.ijk_from_ras[:3, :3])
        self.share = np.ones(len(samples.index), dtype=np.float32)
        blocks, self._block = samples.blocks(HESSIAN_BLOCK)
        self._coarse = Lattice(control, blocks)
        self._last: tuple[Array, _Warped] | None = None

    def refresh(self, c: Array) -> None:
        """Reset each sample's weight to how well the moving image sees it at c (soft rejection).

        Raises ValueError when it sees none.
        """
        if self._seen is not None:
            moved = self._points + self._lattice.forward(c).reshape(3, -1)[:, self.samples.index].T
            share = 4 * interpolate(self._seen.hu, self._seen.grid, moved, 0.0) - 3
            self.share, self._last = np.clip(share, 0, 1).astype(np.float32), None
        if not self.share.any():
            raise ValueError(
                f"the moving image sees none of the {len(self.share)} samples of the fixed mask at this voxel size; "
                "check both masks and the prior map"
            )

    def value(self, c: Array) -> float:
        """D at c."""
        return self._at(c).dissimilarity.value

    def model(self, c: Array) -> QuadraticModel:
        """D, its exact gradient, and a Gauss-Newton Hessian.

        The samples' tensors h g g^T are summed over blocks of 4^3 voxels: splines eight voxels per cell hardly tell.
        """
        warped = self._at(c)
        here, g = warped.dissimilarity, warped.gradient
        force = np.zeros((3, prod(self.samples.grid.shape)), dtype=g.dtype)
        force[:, self.samples.index] = here.slope * g
        gradient = self._lattice.adjoint(force.reshape(3, *self.samples.grid.shape)).astype(float)
        pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
        shape = self._coarse.grid.shape
        sums = [np.bincount(self._block, here.curvature * g[a] * g[b], prod(shape)) for a, b in pairs]
        tensor = np.stack(sums).reshape(6, *shape).astype(np.float32)
        diagonal = self._coarse.adjoint_squared(tensor[[0, 3, 5]])
        return QuadraticModel(here.value, gradient, _tensor_product(self._coarse, tensor), diagonal)

    def _at(self, c: Array) -> _Warped:
        """The moving image seen through T at c."""
        if self._last is None or not np.array_equal(self._last[0], c):
            u = np.ascontiguousarray(self._lattice.forward(c).reshape(3, -1))
            m, g = warp_samples(self._moving.hu, self._base, u, self.samples.index, self._a)
            self._last = c.copy(), _Warped(g, self._metric.evaluate(m, self.share))
        return self._last[1]


@dataclass(frozen=True)
class _Warped:
    """gradient: (3, n) of the moving values by u; dissimilarity: of these values to the fixed ones."""

    gradient: Array
    dissimilarity: Dissimilarity


def _mapped(prior: PointMap, samples: Samples) -> Array:
    """P (n, 3) at the samples."""
    points = samples.points()
    if is_separable(prior, samples.grid):
        return points + prior.dense(samples.grid).vectors.reshape(-1, 3)[samples.index]
    return prior(points)


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
