"""Affine-warped block matching: blocks of one image found in another that is stretched and turned about them.

Only voxels that both images show as the same kind of tissue are compared: beside a border that one image has and the
other has not, a correlation over whole blocks cannot tell.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from registration.kernels.correlation import coefficient
from registration.kernels.trilinear import value
from registration.keypoints.matching import FLAT_HU, subvoxel_peak
from registration.volume import Array

RADIUS = 3
WIDTH = 2 * RADIUS + 1
"""Of a block, voxels; known when kernels are compiled, or they are five times slower."""
LEAST_INSIDE = 0.35
"""Share of a block's voxels that have to lie inside in both images."""
LEAST_NCC = 0.3
"""Below this there is no need to look for the way back."""


class MaskedImage(NamedTuple):
    """An image and what of it counts. hu: (ni, nj, nk) float32; inside: of that shape, bool."""

    hu: Array
    inside: Array


@dataclass(frozen=True)
class BlockMatches:
    """shift: (n, 3) voxels of the fixed image from where a block was expected to where it was found, as the affine map
    turns them; ncc: (n,), -1 where none was found; round_trip: (n,) how many voxels the way there and back ends off its
    start.
    """

    shift: Array
    ncc: Array
    round_trip: Array


class _Best(NamedTuple):
    """What the search fills: shift, back: (n, 3) best shifts there and back; around: (n, 27) scores about the first."""

    shift: Array
    around: Array
    back: Array


def match_affine_blocks(
    fixed: MaskedImage, moving: MaskedImage, starts: Array, affines: Array, reach: int
) -> BlockMatches:
    """The blocks about voxels `starts` (n, 3) of a fixed image in a moving one, up to `reach` voxels from where they
    are expected.

    affines: (n, 3, 4), from a voxel's offset from its start to a voxel of the moving image.
    """
    n = len(starts)
    best = _Best(np.zeros((n, 3), np.int64), np.full((n, 27), -1, np.float32), np.zeros((n, 3), np.int64))
    _match_all(
        _centred(fixed),
        _centred(moving),
        np.ascontiguousarray(starts, np.int64),
        np.ascontiguousarray(affines, float),
        reach,
        best,
    )
    offset, is_peak = subvoxel_peak(best.around)
    ncc = np.where(is_peak, best.around[:, 13], -1)
    return BlockMatches(best.shift + offset, ncc, np.linalg.norm(best.back, axis=1))


def _centred(image: MaskedImage) -> MaskedImage:
    """Values about zero, so that sums of squares keep their digits."""
    level = image.hu[image.inside].mean(dtype=float) if image.inside.any() else 0.0
    hu = np.ascontiguousarray(image.hu - np.float32(level), np.float32)
    return MaskedImage(hu, np.ascontiguousarray(image.inside))


@njit(cache=True)
def _warped(moving, affine, half):
    """A cube of the moving image on the fixed one's voxels, and which of them count."""
    size = 2 * half + 1
    cube, known = np.zeros((size, size, size), np.float32), np.zeros((size, size, size), np.bool_)
    for p in range(size):
        for q in range(size):
            for r in range(size):
                a, b, c = p - half, q - half, r - half
                x = affine[0, 3] + affine[0, 0] * a + affine[0, 1] * b + affine[0, 2] * c
                y = affine[1, 3] + affine[1, 0] * a + affine[1, 1] * b + affine[1, 2] * c
                z = affine[2, 3] + affine[2, 0] * a + affine[2, 1] * b + affine[2, 2] * c
                i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
                if min(i, j, k) < 0:
                    continue
                if i + 1 >= moving.hu.shape[0] or j + 1 >= moving.hu.shape[1] or k + 1 >= moving.hu.shape[2]:
                    continue
                if moving.inside[int(np.rint(x)), int(np.rint(y)), int(np.rint(z))]:
                    known[p, q, r] = True
                    cube[p, q, r] = value(moving.hu, i, j, k, x - i, y - j, z - k)
    return MaskedImage(cube, known)


@njit(cache=True)
def _correlate(taps, image, side, sums):
    """Adds to sums (n, m) what a block of `taps` gives, multiplied with a flat image of `side` voxels an axis, at every
    shift: plane by plane, a plane's rows one after the other.

    Shifts are worked on side by side in the processor, which a loop over the block's voxels inside would prevent: five
    times faster.
    """
    for p in range(sums.shape[0]):
        total = sums[p]
        for a in range(WIDTH):
            for b in range(WIDTH):
                row, first = taps[a, b], ((p + a) * side + b) * side
                values = image[first : first + total.shape[0] + WIDTH - 1]
                for t in range(total.shape[0]):
                    part = np.float32(0)
                    for c in range(WIDTH):
                        part += row[c] * values[t + c]
                    total[t] += part


@njit(cache=True)
def _add_up(image, side, sums):
    """The same for a block of ones, axis by axis."""
    rows = np.zeros(image.shape[0], np.float32)
    for t in range(image.shape[0] - WIDTH + 1):
        for c in range(WIDTH):
            rows[t] += image[t + c]
    planes = np.zeros(image.shape[0], np.float32)
    for t in range(image.shape[0] - (WIDTH - 1) * side):
        for b in range(WIDTH):
            planes[t] += rows[t + b * side]
    for p in range(sums.shape[0]):
        for a in range(WIDTH):
            first = (p + a) * side * side
            for t in range(sums.shape[1]):
                sums[p, t] += planes[first + t]


@njit(cache=True)
def _scores(block, image, first, reach):
    """NCC (2 reach + 1, ...) of a block at every shift about the voxel `first` (3,) of an image, over voxels that count
    in both, -1 where those are few or show nothing, and the shift (3,) of the best.
    """
    n = 2 * reach + 1
    side = n + WIDTH - 1
    near = _block(image, first - reach, side)
    one, counts = block.inside.astype(np.float32), near.inside.astype(np.float32)
    f, flat_n, flat_m = block.hu * one, counts.ravel(), (near.hu * counts).ravel()
    sums = np.zeros((6, n, (n - 1) * side + n), np.float32)
    if block.inside.all():
        _add_up(flat_n, side, sums[0])
        _add_up(flat_m, side, sums[2])
        _add_up(flat_m * flat_m, side, sums[4])
    else:
        _correlate(one, flat_n, side, sums[0])
        _correlate(one, flat_m, side, sums[2])
        _correlate(one, flat_m * flat_m, side, sums[4])
    if near.inside.all():
        sums[1], sums[3] = f.sum(), (f * f).sum()
    else:
        _correlate(f, flat_n, side, sums[1])
        _correlate(f * f, flat_n, side, sums[3])
    _correlate(f, flat_m, side, sums[5])
    return _coefficients(sums, near.inside, reach)


@njit(cache=True)
def _coefficients(sums, inside, reach):
    """What `_scores` returns, from the sums (6, n, m) of `coefficient`. inside: what of the image searched counts."""
    n, flat = 2 * reach + 1, np.float32(FLAT_HU**2)
    scores, top, best = np.full((n, n, n), np.float32(-1)), np.float32(-1), np.zeros(3, np.int64)
    for p in range(n):
        for q in range(n):
            for r in range(n):
                known, f, m, ff, mm, fm = sums[:, p, q * inside.shape[0] + r]
                if not inside[p + RADIUS, q + RADIUS, r + RADIUS] or known < LEAST_INSIDE * WIDTH**3:
                    continue
                scores[p, q, r] = coefficient(known, f, m, ff, mm, fm, flat, flat)
                if scores[p, q, r] > top:
                    top = scores[p, q, r]
                    best[0], best[1], best[2] = p - reach, q - reach, r - reach
    return scores, best


@njit(cache=True)
def _block(image, first, width):
    """The block whose first voxel is `first` (3,)."""
    a, b, c = first
    return MaskedImage(
        image.hu[a : a + width, b : b + width, c : c + width].copy(),
        image.inside[a : a + width, b : b + width, c : c + width].copy(),
    )


@njit(cache=True)
def _match(fixed, moving, start, affine, reach, shift, around, back):
    """One block of `match_affine_blocks`."""
    half = RADIUS + reach
    for m in range(3):
        if start[m] < half or start[m] >= fixed.hu.shape[m] - half:
            return
    block = _block(fixed, start - RADIUS, WIDTH)
    if block.inside.sum() < LEAST_INSIDE * WIDTH**3:
        return
    cube = _warped(moving, affine, half)
    middle = np.full(3, reach)
    scores, best = _scores(block, cube, middle, reach)
    a, b, c = best + reach
    if np.abs(best).max() == reach or scores[a, b, c] < LEAST_NCC:
        return
    shift[:] = best
    around[:] = scores[a - 1 : a + 2, b - 1 : b + 2, c - 1 : c + 2].copy().ravel()
    back[:] = _scores(_block(cube, middle + best, WIDTH), fixed, start - RADIUS, reach)[1]


@njit(cache=True, parallel=True)
def _match_all(fixed, moving, starts, affines, reach, best):
    for n in prange(starts.shape[0]):
        _match(fixed, moving, starts[n], affines[n], reach, best.shift[n], best.around[n], best.back[n])
