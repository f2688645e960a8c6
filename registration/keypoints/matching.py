"""Keypoints of two images that are already roughly aligned, and their correspondences by block matching.

Ref: Foerstner & Guelch 1987 (keypoints); Ourselin 2001 (block matching, there and back); Heinrich 2015 (lungs).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy import ndimage
from scipy.spatial import cKDTree

from registration.correspondences import Correspondences
from registration.images.filters import gaussian
from registration.images.resample import resample, resample_mask
from registration.kernels.correlation import coefficient
from registration.kernels.threads import in_parts
from registration.volume import Array, Mask, Volume

FLAT_HU = 15.0
"""Standard deviation below which a block shows nothing but noise."""
BLUR_VOXELS = 1.0
"""Standard deviation by which images are blurred before every other voxel is left out."""
CANDIDATES = 4
"""How many of the best shifts of the subsampled blocks are refined with whole ones."""


@dataclass(frozen=True)
class MatchSettings:
    """voxel_mm: of the images compared; cell_mm: at most one keypoint per cell; radius: of a block, voxels; reach_mm:
    how far a keypoint may have moved; least_ncc: of two blocks; round_trip_mm: how far from its start the way there and
    back may end; outlier_mm: how far a keypoint may depart from the median motion of its neighbours; band_voxels:
    standard deviations of two Gaussians whose difference is compared instead of grey values. What varies slowly, as
    patches that lost their air do in one image alone, has no say then; vessels have.
    """

    voxel_mm: float = 2.0
    cell_mm: float = 10.0
    radius: int = 3
    reach_mm: float = 14.0
    least_ncc: float = 0.6
    round_trip_mm: float = 2.0
    outlier_mm: float = 5.0
    neighbours: int = 10
    band_voxels: tuple[float, float] | None = None


class _Scales(NamedTuple):
    """An image whole and blurred, for blocks of every voxel and of every other one; (ni, nj, nk) float32 about zero."""

    whole: Array
    blurred: Array


class _Search(NamedTuple):
    """allowed: (ni, nj, nk) where a block's middle may be found; radius: of a block, reach: of shifts, both voxels."""

    allowed: Array
    radius: int
    reach: int


class _Block(NamedTuple):
    """Every `step`-th voxel of a block less their mean, and the sum of their squares."""

    values: Array
    squares: np.float32
    step: int


def match_keypoints(
    fixed: Volume,
    moving: Volume,
    fixed_region: Mask,
    settings: MatchSettings | None = None,
    moving_region: Mask | None = None,
) -> Correspondences:
    """Keypoints of `fixed` inside a region and where `moving` shows them, at most `reach_mm` away along every axis.

    moving_region: where `moving` can be believed, by default everywhere. A match has to correlate, to lead back to
    where it came from and to move as its neighbours do. None, not an error, where nothing is distinctive.
    """
    settings = settings or MatchSettings()
    grid = fixed.grid.with_spacing(settings.voxel_mm)
    here, there = (smoothed(resample(image, grid), settings) for image in (fixed, moving))
    allowed = resample_mask(fixed_region, grid).inside
    believed = np.ones(grid.shape, bool) if moving_region is None else resample_mask(moving_region, grid).inside
    starts = detect_keypoints(here, allowed, settings)
    reach = round(settings.reach_mm / settings.voxel_mm)
    ends, ncc = _match_blocks(here, there, starts, _Search(believed, settings.radius, reach))
    found = np.flatnonzero(ncc >= settings.least_ncc)
    starts, ends, ncc = starts[found], ends[found], ncc[found]
    back, _ = _match_blocks(there, here, np.rint(ends).astype(np.int64), _Search(allowed, settings.radius, reach))
    # The way back starts from a whole voxel, so its fraction is carried along.
    off = np.linalg.norm((back + ends - np.rint(ends) - starts) * grid.spacing, axis=1)
    keep = off <= settings.round_trip_mm
    matches = Correspondences.of(grid.to_ras(starts[keep].astype(float)), grid.to_ras(ends[keep]), ncc[keep])
    motion = matches.moving - matches.fixed
    return matches.only(moves_with_neighbours(matches.fixed, motion, settings.neighbours, settings.outlier_mm))


def moves_with_neighbours(points: Array, motion: Array, neighbours: int, outlier_mm: float) -> Array:
    """Which points (n,) move (n, 3) as the median of their nearest neighbours does, within `outlier_mm`."""
    if len(points) <= neighbours:
        return np.ones(len(points), bool)
    near = cKDTree(points).query(points, neighbours + 1)[1][:, 1:]
    return np.asarray(np.linalg.norm(motion - np.median(motion[near], axis=1), axis=1) <= outlier_mm)


def distinctiveness(hu: Array, spacing: Array) -> Array:
    """1 / trace of the inverse structure tensor, (ni, nj, nk): high where a block cannot be shifted unseen.

    Ref: Foerstner & Guelch 1987.
    """
    slope = np.gradient(hu.astype(np.float32), *spacing)
    t = {(a, b): gaussian(slope[a] * slope[b], 1.4) for a in range(3) for b in range(a, 3)}
    xx, yy, zz, xy, xz, yz = t[0, 0], t[1, 1], t[2, 2], t[0, 1], t[0, 2], t[1, 2]
    minors = (yy * zz - yz**2) + (xx * zz - xz**2) + (xx * yy - xy**2)
    det = xx * (yy * zz - yz**2) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    return np.asarray(np.maximum(det, 0) / np.maximum(minors, 1e-6))


def smoothed(volume: Volume, settings: MatchSettings) -> Volume:
    """The image as blocks are compared: blurred by half a voxel, or between two blurs."""
    if settings.band_voxels is None:
        return Volume(gaussian(volume.hu, 0.5), volume.ras_from_ijk)
    fine, wide = (gaussian(volume.hu, sigma) for sigma in settings.band_voxels)
    return Volume(fine - wide, volume.ras_from_ijk)


def detect_keypoints(image: Volume, allowed: Array, settings: MatchSettings) -> Array:
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


def detect_inside(image: Volume, inside: Array, settings: MatchSettings) -> Array:
    """As `detect_keypoints`, but the region's border is no edge: what lies outside takes the value of the nearest voxel
    inside.
    """
    nearest = ndimage.distance_transform_edt(~inside, return_distances=False, return_indices=True)
    filled = smoothed(Volume(image.hu[tuple(nearest)], image.ras_from_ijk), settings)
    return detect_keypoints(filled, inside, settings)


def _match_blocks(fixed: Volume, moving: Volume, starts: Array, search: _Search) -> tuple[Array, Array]:
    """Voxels (n, 3), between voxels by a quadric, whose blocks look most like those at `starts`, and their NCC."""
    n = len(starts)
    shifts, around = np.zeros((n, 3), np.int64), np.full((n, 27), -1, np.float32)
    if not n:
        return np.zeros((0, 3)), np.zeros(0)
    level = np.float32(moving.hu.mean(dtype=float))
    f, m = (_Scales(hu, gaussian(hu, BLUR_VOXELS)) for hu in (fixed.hu - level, moving.hu - level))
    starts = np.ascontiguousarray(starts, np.int64)
    in_parts(partial(_match_all, f, m, starts, search, shifts, around), len(starts))
    offset, is_peak = subvoxel_peak(around)
    is_peak &= (np.abs(shifts) < search.reach).all(axis=1)
    return starts + shifts + offset, np.where(is_peak, around[:, 13], -1)


def subvoxel_peak(around: Array) -> tuple[Array, Array]:
    """Offset (n, 3) in voxels of the peak of the quadric through the 27 scores (n, 27) about each highest one, in C
    order, and whether it is a peak: not on the border of the search or of the image.
    """
    steps = np.array([(a, b, c) for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1)])
    x, y, z = steps.T
    design = np.stack([np.ones(27), x, y, z, x * x / 2, y * y / 2, z * z / 2, x * y, x * z, y * z], axis=1)
    k = around.astype(float) @ np.linalg.pinv(design).T
    hessian = np.stack([k[:, [4, 7, 8]], k[:, [7, 5, 9]], k[:, [8, 9, 6]]], axis=1)
    known = (around > -1).all(axis=1) & (np.linalg.eigvalsh(hessian)[:, -1] < -1e-6)
    result = np.zeros((len(around), 3))
    result[known] = -np.linalg.solve(hessian[known], k[known, 1:4, None])[..., 0]
    known &= np.abs(result).max(axis=1) <= 1
    return result, known


@njit(cache=True)
def _block(image, at, radius, step):
    """The block about voxel `at`, every `step`-th voxel."""
    width = 2 * radius // step + 1
    values, mean, squares = np.empty((width, width, width), np.float32), np.float32(0), np.float32(0)
    for p in range(width):
        for q in range(width):
            for r in range(width):
                value = image[at[0] - radius + step * p, at[1] - radius + step * q, at[2] - radius + step * r]
                values[p, q, r] = value
                mean += value
    mean /= np.float32(width**3)
    for p in range(width):
        for q in range(width):
            for r in range(width):
                values[p, q, r] -= mean
                squares += values[p, q, r] ** 2
    return _Block(values, squares, step)


@njit(cache=True)
def _correlation(block, image, search, a, b, c):
    """NCC of a block with the one about voxel (a, b, c) of an image; -1 where that cannot be believed or shows
    nothing.
    """
    ni, nj, nk = image.shape
    radius, step = search.radius, block.step
    if a < radius or b < radius or c < radius or a >= ni - radius or b >= nj - radius or c >= nk - radius:
        return np.float32(-1)
    if not search.allowed[a, b, c]:
        return np.float32(-1)
    width = block.values.shape[0]
    m, mm, fm = np.float32(0), np.float32(0), np.float32(0)
    for p in range(width):
        for q in range(width):
            for r in range(width):
                value = image[a - radius + step * p, b - radius + step * q, c - radius + step * r]
                m += value
                mm += value * value
                fm += value * block.values[p, q, r]
    count, zero = np.float32(width**3), np.float32(0)
    return coefficient(count, zero, m, block.squares, mm, fm, zero, np.float32(FLAT_HU**2))


@njit(cache=True)
def _hill_climb(block, image, search, start, shift, around):
    """Move `shift` (3,) to the highest of the 27 scores about it until it is itself the highest; its score."""
    for _ in range(2 * search.reach):
        top, at, n = np.float32(-2), 13, 0
        for a in range(-1, 2):
            for b in range(-1, 2):
                for c in range(-1, 2):
                    x, y, z = shift[0] + a, shift[1] + b, shift[2] + c
                    ncc = np.float32(-1)
                    if max(abs(x), abs(y), abs(z)) <= search.reach:
                        ncc = _correlation(block, image, search, start[0] + x, start[1] + y, start[2] + z)
                    around[n] = ncc
                    if ncc > top or (ncc == top and n == 13):
                        top, at = ncc, n
                    n += 1
        if at == 13:
            break
        shift[0] += at // 9 - 1
        shift[1] += at // 3 % 3 - 1
        shift[2] += at % 3 - 1
    return around[13]


@njit(cache=True)
def _candidates(block, image, search, start, shifts):
    """Fill shifts (m, 3) with the best of every other one by subsampled blocks, best first; how many there are."""
    scores, reach = np.empty(len(shifts), np.float32), search.reach
    count = 0
    for di in range(-reach, reach + 1, 2):
        for dj in range(-reach, reach + 1, 2):
            for dk in range(-reach, reach + 1, 2):
                ncc = _correlation(block, image, search, start[0] + di, start[1] + dj, start[2] + dk)
                if ncc <= -1 or (count == len(shifts) and ncc <= scores[count - 1]):
                    continue
                count = min(count + 1, len(shifts))
                m = count - 1
                while m > 0 and scores[m - 1] < ncc:
                    scores[m] = scores[m - 1]
                    shifts[m, 0], shifts[m, 1], shifts[m, 2] = shifts[m - 1, 0], shifts[m - 1, 1], shifts[m - 1, 2]
                    m -= 1
                scores[m] = ncc
                shifts[m, 0], shifts[m, 1], shifts[m, 2] = di, dj, dk
    return count


@njit(cache=True)
def _match(fixed, moving, start, search, best, around):
    """One point of `_match_all`."""
    radius = search.radius
    for m in range(3):
        if start[m] < radius or start[m] >= fixed.whole.shape[m] - radius:
            return
    whole = _block(fixed.whole, start, radius, 1)
    if whole.squares < np.float32((2 * radius + 1) ** 3 * FLAT_HU**2):
        return
    thin = _block(fixed.blurred, start, radius, 2)
    thin = _Block(thin.values, max(thin.squares, np.float32(1)), thin.step)
    shifts, near, top = np.empty((CANDIDATES, 3), np.int64), np.empty(27, np.float32), np.float32(-1)
    for m in range(_candidates(thin, moving.blurred, search, start, shifts)):
        known = False
        for other in range(m):
            far = max(abs(shifts[m, 0] - shifts[other, 0]), abs(shifts[m, 1] - shifts[other, 1]))
            known |= max(far, abs(shifts[m, 2] - shifts[other, 2])) <= 2
        if known:
            continue
        ncc = _hill_climb(whole, moving.whole, search, start, shifts[m], near)
        if ncc > top:
            top = ncc
            best[0], best[1], best[2] = shifts[m, 0], shifts[m, 1], shifts[m, 2]
            for n in range(27):
                around[n] = near[n]


@njit(cache=True, nogil=True)
def _match_all(fixed, moving, starts, search, shifts, around, first, end):
    """Fill shifts (n, 3) of the best blocks and the scores (n, 27) about them, for starts first..end.

    Every other voxel of the blurred images is compared at every other shift; the CANDIDATES best of these are refined
    with whole blocks.
    """
    for n in range(first, end):
        _match(fixed, moving, starts[n], search, shifts[n], around[n])
