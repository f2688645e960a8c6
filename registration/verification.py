"""Verify that two images are aligned, by keypoints that no registration of ours uses: blobs, compared by their
self-similarity.

Registrations and keypoint matching here are driven by normalized correlation at distinctive corners; this detector and
this descriptor share nothing with them, so what they find left over is an independent opinion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from registration.keypoints.blobs import blobs
from registration.keypoints.matching import moves_with_neighbours
from registration.keypoints.self_similarity import BLOCK_RADIUS, describe, find_similar
from registration.maps.rigid import RigidTransform
from registration.volume import Array, Grid, Mask, Volume


@dataclass(frozen=True)
class VerifySettings:
    """sigma_mm: of blobs; cell_mm: at most one blob per cell; reach_mm: how far along each axis a blob is looked for;
    most_ratio: of the best block's cost to the next one's elsewhere; round_trip_mm: how far from its start the way
    there and back may end; neighbours, stray_mm: how far a blob may depart from the median motion of those about it.
    """

    sigma_mm: float = 2.5
    cell_mm: float = 10.0
    reach_mm: float = 16.0
    most_ratio: float = 0.9
    round_trip_mm: float = 2.0
    neighbours: int = 8
    stray_mm: float = 6.0


@dataclass(frozen=True)
class LeftOver:
    """What is left of a motion between two images that should be aligned.

    points: (n, 3) RAS mm, blobs of the fixed image that were recognized in the moving one; vectors: (n, 3) mm from
    there to where the moving image shows them; looked_for: how many blobs there were.
    """

    points: Array
    vectors: Array
    looked_for: int

    @property
    def recognized_share(self) -> float:
        """Share of the blobs that were recognized; 0 where there were none."""
        return len(self.points) / max(self.looked_for, 1)

    @property
    def shift(self) -> Array:
        """Median left-over vector (3,) mm; NaN where nothing was recognized."""
        return np.median(self.vectors, axis=0) if len(self.vectors) else np.full(3, np.nan)

    @property
    def turn_degrees(self) -> float:
        """Angle of the rotation that is left over as a whole, by least squares; NaN for fewer than three points."""
        if len(self.points) < 3:
            return float("nan")
        return rigid_between(self.points, self.points + self.vectors).angle_degrees

    def near(self, points_ras: Array, reach_mm: float, least: int = 4) -> Array:
        """Median left-over vector (q, 3) mm of the `least` nearest recognized blobs of points (q, 3); NaN where fewer
        lie within `reach_mm`.
        """
        points_ras = np.reshape(points_ras, (-1, 3))
        around = np.full((len(points_ras), 3), np.nan)
        if len(self.points) < least:
            return around
        far, number = (a.reshape(len(points_ras), least) for a in cKDTree(self.points).query(points_ras, least))
        known = far[:, -1] <= reach_mm
        around[known] = np.median(self.vectors[number[known]], axis=1)
        return around


def left_over(
    fixed: Volume, moving: Volume, region: Mask, allowed: Mask, settings: VerifySettings | None = None
) -> LeftOver:
    """What is left of a motion between two images on one grid of cubic voxels.

    region: where blobs of the fixed image are looked for; allowed: where the moving image can be believed. A blob is
    recognized if its block looks clearly more similar there than elsewhere, leads back to where it came from and moves
    as those about it do. Raises ValueError for images on different grids.
    """
    settings = settings or VerifySettings()
    if not all(fixed.grid.same_as(other.grid) for other in (moving, region, allowed)):
        raise ValueError("the two images and both regions must lie on one grid")
    voxel = float(fixed.grid.spacing.mean())
    starts = blobs(fixed.hu, region.inside, settings.sigma_mm / voxel, max(round(settings.cell_mm / voxel), 1))
    looked_for = len(starts)
    if not looked_for:
        return LeftOver(np.zeros((0, 3)), np.zeros((0, 3)), 0)
    reach = round(settings.reach_mm / voxel)
    here = describe(fixed.hu, _about(starts, fixed.grid, BLOCK_RADIUS))
    there = describe(moving.hu, _about(starts, fixed.grid, reach + BLOCK_RADIUS))
    found = find_similar(here, there, allowed.inside, starts, reach)
    clear = found.is_inner & (found.cost < settings.most_ratio * found.runner_up)
    starts, shift = starts[clear], found.shift[clear]
    ends = np.rint(starts + shift).astype(np.int64)
    here = describe(fixed.hu, _about(ends, fixed.grid, reach + BLOCK_RADIUS))
    back = find_similar(there, here, np.ones(fixed.hu.shape, bool), ends, reach)
    kept = np.linalg.norm(shift + back.shift, axis=1) * voxel <= settings.round_trip_mm
    points = fixed.grid.to_ras(starts[kept].astype(float))
    vectors = shift[kept] @ fixed.grid.ras_from_ijk[:3, :3].T
    agree = moves_with_neighbours(points, vectors, settings.neighbours, settings.stray_mm)
    return LeftOver(points[agree], vectors[agree], looked_for)


def rigid_between(first: Array, second: Array) -> RigidTransform:
    """The rigid motion that takes points (n, 3) nearest to others (n, 3), by least squares. Ref: Kabsch 1976."""
    centre, other = first.mean(axis=0), second.mean(axis=0)
    u, _, vt = np.linalg.svd((first - centre).T @ (second - other))
    rotation = vt.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, other - rotation @ centre
    return RigidTransform(matrix)


def _about(voxels: Array, grid: Grid, reach: int) -> Array:
    """Voxels of a grid at most `reach` away along each axis from some of them (n, 3)."""
    marked = np.zeros(grid.shape, np.uint8)
    marked[tuple(voxels.T)] = 1
    return np.asarray(ndimage.maximum_filter(marked, 2 * reach + 1) > 0)
