"""Points of the same tissue in two images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from registration.volume import Array


@dataclass(frozen=True)
class Correspondences:
    """fixed, moving: (n, 3) RAS mm, where the fixed and the moving image show the same tissue; ncc: (n,) correlation of
    the blocks about them, NaN where none were compared; weights: (n,) >= 0, how much each counts.
    """

    fixed: Array
    moving: Array
    ncc: Array
    weights: Array

    def __post_init__(self) -> None:
        n = len(self.fixed)
        got = tuple(np.shape(a) for a in (self.fixed, self.moving, self.ncc, self.weights))
        if got != ((n, 3), (n, 3), (n,), (n,)):
            raise ValueError(f"correspondences must be (n, 3), (n, 3), (n,) and (n,), got {got}")
        if not (np.asarray(self.weights) >= 0).all():
            raise ValueError("weights of correspondences must not be negative")

    @classmethod
    def of(cls, fixed: Array, moving: Array, ncc: Array | None = None, weights: Array | None = None) -> Correspondences:
        """Correspondences of weight one, and not compared, unless said otherwise."""
        n = len(fixed)
        return cls(
            fixed, moving, np.full(n, np.nan) if ncc is None else ncc, np.ones(n) if weights is None else weights
        )

    @classmethod
    def none(cls) -> Correspondences:
        """Not a single one."""
        return cls.of(np.zeros((0, 3)), np.zeros((0, 3)))

    def __len__(self) -> int:
        return len(self.fixed)

    def only(self, keep: Array) -> Correspondences:
        """Those that `keep` (n,), bool or indices, chooses."""
        return Correspondences(self.fixed[keep], self.moving[keep], self.ncc[keep], self.weights[keep])

    def mapped(
        self, *, fixed: Callable[[Array], Array] | None = None, moving: Callable[[Array], Array] | None = None
    ) -> Correspondences:
        """The same with the points of one image, or of both, carried to another frame by maps of points (n, 3)."""
        return replace(
            self,
            fixed=self.fixed if fixed is None else fixed(self.fixed),
            moving=self.moving if moving is None else moving(self.moving),
        )

    def swapped(self) -> Correspondences:
        """The same with fixed and moving image exchanged."""
        return replace(self, fixed=self.moving, moving=self.fixed)

    def joined(self, other: Correspondences) -> Correspondences:
        """These, then the other ones."""
        return Correspondences(
            np.concatenate([self.fixed, other.fixed]),
            np.concatenate([self.moving, other.moving]),
            np.concatenate([self.ncc, other.ncc]),
            np.concatenate([self.weights, other.weights]),
        )
