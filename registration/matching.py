"""Matched points of two images that are already roughly aligned: distinctive places, found again by block matching.

Ref: Foerstner & Guelch 1987 (distinctiveness); Ourselin 2001 (block matching, there and back); Heinrich 2015 (lungs).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from scipy import ndimage
from scipy.spatial import cKDTree

from registration.resample import resample, resample_mask
from registration.volume import Array, Mask, Volume

FLAT_HU = 15.0
"""Standard deviation below which a block shows nothing but noise."""


@dataclass(frozen=True)
class MatchSettings:
    """voxel_mm: of the images compared; cell_mm: at most one point per cell; radius: of a block, voxels; reach_mm: how
    far a point may have moved; least_ncc: of two blocks; round_trip_mm: how far from its start the way there and back
    may end; stray_mm: how far a point may depart from the median motion of its neighbours.
    """

    voxel_mm: float = 2.0
    cell_mm: float = 10.0
    radius: int = 3
    reach_mm: float = 14.0
    least_ncc: float = 0.6
    round_trip_mm: float = 2.0
    stray_mm: float = 5.0
    neighbours: int = 10


@dataclass(frozen=True)
class Pairs:
    """first, second: (n, 3) RAS mm, the same places in two images; ncc: (n,) correlation of their blocks."""

    first: Array
    second: Array
    ncc: Array

    def __len__(self) -> int:
        return len(self.first)

    def only(self, keep: Array) -> Pairs:
        """The pairs that `keep` (n,), bool or indices, chooses."""
        return Pairs(self.first[keep], self.second[keep], self.ncc[keep])


def match_keypoints(
    first: Volume, second: Volume, region: Mask, settings: MatchSettings | None = None, first_region: Mask | None = None
) -> Pairs:
    """Places of `second` inside `region` and where `first` shows them, at most `reach_mm` away along every axis.

    first_region: where `first` can be believed, by default everywhere. A match has to correlate, to lead back to where
    it came from and to move as its neighbours do. No pair, not an error, where nothing is distinctive.
    """
    settings = settings or MatchSettings()
    grid = second.grid.with_spacing(settings.voxel_mm)
    here, there = _smooth(resample(second, grid)), _smooth(resample(first, grid))
    allowed = resample_mask(region, grid).inside
    believed = np.ones(grid.shape, bool) if first_region is None else resample_mask(first_region, grid).inside
    starts = _distinctive(here, allowed, settings)
    reach = round(settings.reach_mm / settings.voxel_mm)
    ends, ncc = _search(here, there, starts, believed, settings.radius, reach)
    found = np.flatnonzero(ncc >= settings.least_ncc)
    starts, ends, ncc = starts[found], ends[found], ncc[found]
    back, _ = _search(there, here, np.rint(ends).astype(np.int64), allowed, settings.radius, reach)
    # The way back starts from a whole voxel, so its fraction is carried along.
    off = np.linalg.norm((back + ends - np.rint(ends) - starts) * grid.spacing, axis=1)
    keep = off <= settings.round_trip_mm
    pairs = Pairs(grid.to_ras(ends[keep]), grid.to_ras(starts[keep].astype(float)), ncc[keep])
    return pairs.only(alike(pairs.second, pairs.first - pairs.second, settings.neighbours, settings.stray_mm))


def alike(points: Array, motion: Array, neighbours: int, stray_mm: float) -> Array:
    """Which points (n,) move (n, 3) as the median of their nearest neighbours does, within `stray_mm`."""
    if len(points) <= neighbours:
        return np.ones(len(points), bool)
    near = cKDTree(points).query(points, neighbours + 1)[1][:, 1:]
    return np.asarray(np.linalg.norm(motion - np.median(motion[near], axis=1), axis=1) <= stray_mm)


def distinctiveness(hu: Array, spacing: Array) -> Array:
    """1 / trace of the inverse structure tensor, (ni, nj, nk): high where a block cannot be shifted unseen.

    Ref: Foerstner & Guelch 1987.
    """
    slope = np.gradient(hu.astype(np.float32), *spacing)
    t = {(a, b): ndimage.gaussian_filter(slope[a] * slope[b], 1.4) for a in range(3) for b in range(a, 3)}
    xx, yy, zz, xy, xz, yz = t[0, 0], t[1, 1], t[2, 2], t[0, 1], t[0, 2], t[1, 2]
    minors = (yy * zz - yz**2) + (xx * zz - xz**2) + (xx * yy - xy**2)
    det = xx * (yy * zz - yz**2) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    return np.asarray(np.maximum(det, 0) / np.maximum(minors, 1e-6))


def _smooth(volume: Volume) -> Volume:
    return Volume(ndimage.gaussian_filter(volume.hu, 0.5), volume.ras_from_ijk)


def _distinctive(image: Volume, allowed: Array, settings: MatchSettings) -> Array:
    """Voxels (n, 3), the most distinctive one of every cell, a block away from the image's border."""
    score = np.where(allowed, distinctiveness(image.hu, image.grid.spacing), 0)
    edge = settings.radius + 1
    inner = np.zeros(score.shape, bool)
    inner[edge:-edge, edge:-edge, edge:-edge] = True
    ijk = np.argwhere(inner & (score > 0))
    value = score[tuple(ijk.T)]
    cell = np.floor(ijk * image.grid.spacing / settings.cell_mm).astype(np.int64) @ np.array([1, 1 << 20, 1 << 40])
    order = np.argsort(-value, kind="stable")
    _, best = np.unique(cell[order], return_index=True)
    return ijk[np.sort(order[best])]


def _search(
    fixed: Volume, moving: Volume, starts: Array, believed: Array, radius: int, reach: int
) -> tuple[Array, Array]:
    """Voxels (n, 3), between voxels by a quadric, whose blocks look most like those at `starts`, and their NCC."""
    if not len(starts):
        return np.zeros((0, 3)), np.zeros(0)
    scores = np.full((len(starts), *(3 * (2 * reach + 1,))), -1, np.float32)
    _blocks(fixed.hu, moving.hu, np.ascontiguousarray(starts, np.int64), believed, radius, reach, FLAT_HU, scores)
    best = scores.reshape(len(starts), -1).argmax(axis=1)
    shift = np.stack(np.unravel_index(best, scores.shape[1:]), axis=1)
    ncc = scores.reshape(len(starts), -1)[np.arange(len(starts)), best]
    offset, is_top = _between(scores, shift)
    return starts + shift - reach + offset, np.where(is_top, ncc, -1)


def _between(scores: Array, shift: Array) -> tuple[Array, Array]:
    """Offset (n, 3) in voxels of the top of the quadric through the 27 scores about each highest one, and whether it is
    a top: not on the border of the search or of the image.
    """
    steps = np.array([(a, b, c) for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1)])
    x, y, z = steps.T
    design = np.stack([np.ones(27), x, y, z, x * x / 2, y * y / 2, z * z / 2, x * y, x * z, y * z], axis=1)
    inside = ((shift > 0) & (shift < scores.shape[1] - 1)).all(axis=1)
    at = np.clip(shift[:, None] + steps, 0, scores.shape[1] - 1)
    around = scores[np.arange(len(shift))[:, None], at[..., 0], at[..., 1], at[..., 2]].astype(float)
    k = around @ np.linalg.pinv(design).T
    hessian = np.stack([k[:, [4, 7, 8]], k[:, [7, 5, 9]], k[:, [8, 9, 6]]], axis=1)
    known = inside & (around > -1).all(axis=1) & (np.linalg.eigvalsh(hessian)[:, -1] < -1e-6)
    result = np.zeros(shift.shape)
    result[known] = -np.linalg.solve(hessian[known], k[known, 1:4, None])[..., 0]
    known &= np.abs(result).max(axis=1) <= 1
    return result, known


@njit(cache=True, fastmath=True)
def _correlation(block, ff, moving, believed, a, b, c, radius, flat):
    """NCC of a centred block with the one about voxel (a, b, c); -1 where that cannot be believed or shows nothing."""
    ni, nj, nk = moving.shape
    if a < radius or b < radius or c < radius or a >= ni - radius or b >= nj - radius or c >= nk - radius:
        return -1.0
    if not believed[a, b, c]:
        return -1.0
    s, ss, sf = 0.0, 0.0, 0.0
    width = 2 * radius + 1
    for p in range(width):
        for q in range(width):
            for r in range(width):
                m = moving[a - radius + p, b - radius + q, c - radius + r]
                s += m
                ss += m * m
                sf += m * block[p, q, r]
    mm = ss - s * s / width**3
    if mm < width**3 * flat * flat:
        return -1.0
    return sf / np.sqrt(mm * ff)


@njit(cache=True, parallel=True, fastmath=True)
def _blocks(fixed, moving, starts, believed, radius, reach, flat, scores):
    """Fill scores (n, s, s, s) at every other shift, then at every one near the best of those: peaks are wider."""
    ni, nj, nk = fixed.shape
    width = 2 * radius + 1
    for n in prange(starts.shape[0]):
        i, j, k = starts[n, 0], starts[n, 1], starts[n, 2]
        if min(i, j, k) < radius or i >= ni - radius or j >= nj - radius or k >= nk - radius:
            continue
        block = fixed[i - radius : i + radius + 1, j - radius : j + radius + 1, k - radius : k + radius + 1].copy()
        block -= block.sum() / width**3
        ff = (block * block).sum()
        if ff < width**3 * flat * flat:
            continue
        best, da, db, dc = -1.0, 0, 0, 0
        for di in range(-reach, reach + 1, 2):
            for dj in range(-reach, reach + 1, 2):
                for dk in range(-reach, reach + 1, 2):
                    ncc = _correlation(block, ff, moving, believed, i + di, j + dj, k + dk, radius, flat)
                    scores[n, di + reach, dj + reach, dk + reach] = ncc
                    if ncc > best:
                        best, da, db, dc = ncc, di, dj, dk
        if best <= -1.0:
            continue
        for di in range(max(da - 2, -reach), min(da + 2, reach) + 1):
            for dj in range(max(db - 2, -reach), min(db + 2, reach) + 1):
                for dk in range(max(dc - 2, -reach), min(dc + 2, reach) + 1):
                    ncc = _correlation(block, ff, moving, believed, i + di, j + dj, k + dk, radius, flat)
                    scores[n, di + reach, dj + reach, dk + reach] = ncc
