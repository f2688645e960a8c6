"""Correspondences of two images that a map already aligns to a few millimetres, right up to an organ's border.

A block is cut off where either image's region ends, so the wall that the organ slides along has no say in it, and it is
warped by the map's gradient, so that it may be small where tissue is stretched.
Ref: Ourselin 2001 (block matching, there and back); Heinrich 2015 (lungs).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from registration.correspondences import Correspondences
from registration.images.filters import gaussian
from registration.keypoints.affine_matching import MaskedImage, match_affine_blocks
from registration.keypoints.matching import moves_with_neighbours
from registration.volume import Array, Grid, Mask, Volume

BLUR_VOXELS = 0.5
CONTINUED_VOXELS = 1.0
"""Standard deviation of the means of what lies inside, which stand in for what lies just outside."""


class Linearized(NamedTuple):
    """A map of points at some of them. values: (n, 3) mm; gradients: (n, 3, 3), no unit."""

    values: Array
    gradients: Array


LinearizedMap = Callable[[Array], Linearized]
"""From points (n, 3) RAS mm to where a map takes them, and its gradients there."""


@dataclass(frozen=True)
class AlignedSettings:
    """reach_mm: how far along each axis of the fixed image the map may be off; least_ncc: of two blocks; round_trip_mm:
    how far from its start the way there and back may end; neighbours, outlier_mm: how far a match may depart from the
    median correction of those about it.
    """

    reach_mm: float
    least_ncc: float = 0.6
    round_trip_mm: float = 1.5
    neighbours: int = 8
    outlier_mm: float = 4.0


class Organ(NamedTuple):
    """An organ in an image, made ready for matching by `organ_of`."""

    grid: Grid
    image: MaskedImage


def organ_of(image: Volume, region: Mask) -> Organ:
    """The image blurred as all blocks are, by what lies in the region alone, which a border of two voxels continues: no
    grey value from beyond the region enters a block, whether by blurring or between voxels.

    Raises ValueError where image and region lie on different grids.
    """
    if not image.grid.same_as(region.grid):
        raise ValueError(f"the region must lie on the image's grid: {region!r} against {image!r}; resample it first")
    inside = region.inside.astype(np.float32)
    known = image.hu * inside
    fine, wide = (
        gaussian(known, sigma, truncate=3.0) / np.maximum(gaussian(inside, sigma, truncate=3.0), 1e-6)
        for sigma in (BLUR_VOXELS, CONTINUED_VOXELS)
    )
    return Organ(image.grid, MaskedImage(np.where(region.inside, fine, wide).astype(np.float32), region.inside))


def match_aligned(
    fixed: Organ, moving: Organ, points: Array, moving_from_fixed: LinearizedMap, settings: AlignedSettings
) -> Correspondences:
    """Where the moving image shows the tissue about points (n, 3) RAS mm of the fixed one, for those that are found.

    fixed: with cubic voxels; points are moved to the nearest voxel. moving_from_fixed: what aligns the images.
    """
    starts = np.unique(np.rint(fixed.grid.to_ijk(points)).astype(np.int64), axis=0)
    at = fixed.grid.to_ras(starts.astype(float))
    expected = moving_from_fixed(at)
    per_voxel = expected.gradients @ fixed.grid.ras_from_ijk[:3, :3]
    affines = np.concatenate(
        [moving.grid.ijk_from_ras[:3, :3] @ per_voxel, moving.grid.to_ijk(expected.values)[:, :, None]], axis=2
    )
    voxel = float(fixed.grid.spacing.mean())
    found = match_affine_blocks(
        fixed.image,
        moving.image,
        starts,
        affines,
        round(settings.reach_mm / voxel),
        settings.least_ncc,
    )
    holds = (found.ncc >= settings.least_ncc) & (found.round_trip * voxel <= settings.round_trip_mm)
    moved = expected.values + np.einsum("nij,nj->ni", per_voxel, found.shift)
    matches = Correspondences.of(at[holds], moved[holds], found.ncc[holds])
    off = found.shift[holds] @ fixed.grid.ras_from_ijk[:3, :3].T
    return matches.only(moves_with_neighbours(matches.fixed, off, settings.neighbours, settings.outlier_mm))
