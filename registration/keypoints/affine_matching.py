"""Affine-warped block matching: blocks of one image found in another that is stretched and turned about them.

Only voxels that both images show as the same kind of tissue are compared: beside a border that one image has and the
other has not, a correlation over whole blocks cannot tell.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numba import njit

from registration.kernels.correlation import coefficient
from registration.kernels.threads import in_parts
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
    images = _centred(fixed), _centred(moving)
    where = np.ascontiguousarray(starts, np.int64), np.ascontiguousarray(affines, float)

    in_parts(partial(_match_some, *images, where, reach, best), n)
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
def _powers(image):
    """Which voxels count, their values and the squares of these, (3, n) float32, voxel by voxel."""
    hu, inside = image.hu.ravel(), image.inside.ravel()
    powers = np.zeros((3, hu.size), np.float32)
    for n in range(hu.size):
        if inside[n]:
            powers[0, n], powers[1, n], powers[2, n] = 1, hu[n], hu[n] * hu[n]
    return powers


@njit(cache=True)
def _scores(block, near, reach, best):
    """NCC (2 reach + 1, ...) of a block at every shift within an image `near`, over voxels that count in both, -1 where
    those are few or show nothing. best: (3,) set to the best shift.
    """
    n, side = 2 * reach + 1, near.hu.shape[0]
    taps, images = _powers(block), _powers(near)
    sums = np.zeros((6, n, (n - 1) * side + n), np.float32)
    whole = block.inside.all()
    for k in range(6):  # sums of 1, f, m, f^2, m^2 and f m
        one, other = (0, 1, 0, 2, 0, 1)[k], (0, 0, 1, 0, 2, 1)[k]
        if whole and one == 0:
            _add_up(images[other], side, sums[k])
        else:
            _correlate(taps[one].reshape((WIDTH, WIDTH, WIDTH)), images[other], side, sums[k])
    return _coefficients(sums, near.inside, reach, best)


@njit(cache=True)
def _coefficients(sums, inside, reach, best):
    """What `_scores` returns, from the sums (6, n, m) of `coefficient`. inside: what of the image searched counts."""
    n, flat, top = 2 * reach + 1, np.float32(FLAT_HU**2), np.float32(-1)
    scores = np.full((n, n, n), np.float32(-1))
    for p in range(n):
        for q in range(n):
            for r in range(n):
                t = q * inside.shape[0] + r
                known = sums[0, p, t]
                if not inside[p + RADIUS, q + RADIUS, r + RADIUS] or known < LEAST_INSIDE * WIDTH**3:
                    continue
                scores[p, q, r] = coefficient(
                    known, sums[1, p, t], sums[2, p, t], sums[3, p, t], sums[4, p, t], sums[5, p, t], flat, flat
                )
                if scores[p, q, r] > top:
                    top = scores[p, q, r]
                    best[0], best[1], best[2] = p - reach, q - reach, r - reach
    return scores


@njit(cache=True)
def _block(image, a, b, c, width):
    """The block whose first voxel is (a, b, c)."""
    return MaskedImage(
        image.hu[a : a + width, b : b + width, c : c + width].copy(),
        image.inside[a : a + width, b : b + width, c : c + width].copy(),
    )


@njit(cache=True)
def _holds(image, at, half):
    """Whether a cube about a voxel (3,) lies in an image."""
    inside = True
    for m in range(3):
        inside &= half <= at[m] < image.hu.shape[m] - half
    return inside


@njit(cache=True, nogil=True)
def _match_some(fixed, moving, where, reach, best, first, end):
    """Blocks first..end of `match_affine_blocks`. where: starts and affines."""
    half = RADIUS + reach
    for n in range(first, end):
        start, found = where[0][n], np.zeros(3, np.int64)
        if not _holds(fixed, start, half):
            continue
        block = _block(fixed, start[0] - RADIUS, start[1] - RADIUS, start[2] - RADIUS, WIDTH)
        if block.inside.sum() < LEAST_INSIDE * WIDTH**3:
            continue
        cube = _warped(moving, where[1][n], half)
        near = cube
        for way in range(2):  # there, and from what was found back
            scores = _scores(block, near, reach, found)
            a, b, c = found[0] + reach, found[1] + reach, found[2] + reach
            if way == 1:
                for m in range(3):
                    best.back[n, m] = found[m]
            elif max(abs(found[0]), abs(found[1]), abs(found[2])) == reach or scores[a, b, c] < LEAST_NCC:
                break
            else:
                for m in range(27):
                    best.around[n, m] = scores[a - 1 + m // 9, b - 1 + m // 3 % 3, c - 1 + m % 3]
                for m in range(3):
                    best.shift[n, m], found[m] = found[m], 0
                block = _block(cube, a, b, c, WIDTH)
                near = _block(fixed, start[0] - half, start[1] - half, start[2] - half, 2 * half + 1)
