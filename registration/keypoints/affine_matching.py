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
NEAR = 2
"""Voxels along each axis that are looked through first where the first good block will do."""
LANES = 8
"""Shifts that a processor works on side by side."""
STRIDE = 2
"""Beyond them every second shift is looked at, then what lies about the best of these."""


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
    fixed: MaskedImage, moving: MaskedImage, starts: Array, affines: Array, reach: int, sure: float = float("inf")
) -> BlockMatches:
    """The blocks about voxels `starts` (n, 3) of a fixed image in a moving one, up to `reach` voxels from where they
    are expected.

    affines: (n, 3, 4), from a voxel's offset from its start to a voxel of the moving image. sure: the NCC from which a
    block found within NEAR voxels is taken without a look at those farther off, and every second one of those suffices;
    twice as fast. The way back is looked for within NEAR voxels then. Without it the best of all shifts is found.
    """
    n = len(starts)
    best = _Best(np.zeros((n, 3), np.int64), np.full((n, 27), -1, np.float32), np.zeros((n, 3), np.int64))
    images = _centred(fixed), _centred(moving)
    where = np.ascontiguousarray(starts, np.int64), np.ascontiguousarray(affines, float)

    in_parts(partial(_match_some, *images, where, reach, np.float32(sure), best), n)
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
    m = image.shape[0]
    rows, planes = np.zeros(m, np.float32), np.zeros(m, np.float32)
    for c in range(WIDTH):
        for t in range(m - WIDTH + 1):
            rows[t] += image[t + c]
    for b in range(WIDTH):
        for t in range(m - (WIDTH - 1) * side):
            planes[t] += rows[t + b * side]
    for p in range(sums.shape[0]):
        for a in range(WIDTH):
            first = (p + a) * side * side
            for t in range(sums.shape[1]):
                sums[p, t] += planes[first + t]


@njit(cache=True)
def _powers(image):
    """Which voxels count, their values and the squares of these, (3, n) float32, voxel by voxel, then zeros."""
    hu, inside = image.hu.ravel(), image.inside.ravel()
    powers = np.zeros((3, hu.size + LANES), np.float32)
    for n in range(hu.size):
        one = np.float32(inside[n])
        powers[0, n], powers[1, n], powers[2, n] = one, one * hu[n], one * hu[n] * hu[n]
    return powers


@njit(cache=True)
def _room(shifts, side):
    """Zeros (6, shifts, m) for sums: m is a whole number of LANES, or the last few shifts would take as long as all."""
    return np.zeros((6, shifts, ((shifts - 1) * side + shifts + LANES - 1) // LANES * LANES), np.float32)


@njit(cache=True)
def _scores(block, near, reach, best):
    """NCC (2 reach + 1, ...) of a block at every shift within an image `near`, over voxels that count in both, -1 where
    those are few or show nothing. best: (3,) set to the best shift.
    """
    side = near.hu.shape[0]
    taps, images, sums = _powers(block), _powers(near), _room(2 * reach + 1, side)
    whole, all_near = block.inside.all(), near.inside.all()
    for k in range(6):  # sums of 1, f, m, f^2, m^2 and f m
        one, other = (0, 1, 0, 2, 0, 1)[k], (0, 0, 1, 0, 2, 1)[k]
        if all_near and other == 0:
            sums[k] = taps[one].sum()
        elif whole and one == 0:
            _add_up(images[other], side, sums[k])
        else:
            _correlate(taps[one][: WIDTH**3].reshape((WIDTH, WIDTH, WIDTH)), images[other], side, sums[k])
    return _coefficients(sums, near.inside, reach, 1, best)


@njit(cache=True)
def _look_far(block, near, reach, best):
    """Sets best (3,) to the best of every second shift within an image `near`, and returns its NCC."""
    half, taps, images = near.hu.shape[0] // 2 + 1, _powers(block), _powers(near)
    parts, sums = np.zeros((3, 2, 2, 2, half**3 + LANES), np.float32), _room(reach + 1, half)
    for k in range(3):
        _deal(images[k], near.hu.shape[0], parts[k])
    all_near = near.inside.all()
    for k in range(6):
        one, other = (0, 1, 0, 2, 0, 1)[k], (0, 0, 1, 0, 2, 1)[k]
        if all_near and other == 0:
            sums[k] = taps[one].sum()
        else:
            _correlate_parts(taps[one][: WIDTH**3].reshape((WIDTH, WIDTH, WIDTH)), parts[other], half, sums[k])
    return _coefficients(sums, near.inside, reach, STRIDE, best).max()


@njit(cache=True)
def _deal(image, side, parts):
    """A flat image's voxels of even and of odd index along each axis, (2, 2, 2, m): what lies two apart lies side by
    side, (side // 2 + 1) voxels an axis.
    """
    half = side // 2 + 1
    for p in range(side):
        for q in range(side):
            row, to = image[(p * side + q) * side :], parts[p % 2, q % 2]
            at = (p // 2 * half + q // 2) * half
            for r in range(half):
                to[0, at + r] = row[2 * r]
            for r in range(half - 1):
                to[1, at + r] = row[2 * r + 1]


@njit(cache=True)
def _correlate_parts(taps, parts, half, sums):
    """`_correlate` for every second shift. parts: what `_deal` made of the image, `half` voxels an axis."""
    for p in range(sums.shape[0]):
        total = sums[p]
        for a in range(WIDTH):
            for b in range(WIDTH):
                row, first = taps[a, b], ((p + a // 2) * half + b // 2) * half
                last = first + total.shape[0] + WIDTH // 2
                even, odd = parts[a % 2, b % 2, 0, first:last], parts[a % 2, b % 2, 1, first:last]
                for t in range(total.shape[0]):
                    part = row[WIDTH - 1] * even[t + WIDTH // 2]
                    for c in range(WIDTH // 2):
                        part += row[2 * c] * even[t + c]
                        part += row[2 * c + 1] * odd[t + c]
                    total[t] += part


@njit(cache=True)
def _coefficients(sums, inside, reach, stride, best):
    """What `_scores` returns, from the sums (6, n, m) of `coefficient`. inside: what of the image searched counts."""
    n, flat, top = sums.shape[1], np.float32(FLAT_HU**2), np.float32(-1)
    side = inside.shape[0] if stride == 1 else inside.shape[0] // 2 + 1
    scores = np.full((n, n, n), np.float32(-1))
    for p in range(n):
        for q in range(n):
            for r in range(n):
                t = q * side + r
                known = sums[0, p, t]
                a, b, c = stride * p, stride * q, stride * r
                if not inside[a + RADIUS, b + RADIUS, c + RADIUS] or known < LEAST_INSIDE * WIDTH**3:
                    continue
                scores[p, q, r] = coefficient(
                    known, sums[1, p, t], sums[2, p, t], sums[3, p, t], sums[4, p, t], sums[5, p, t], flat, flat
                )
                if scores[p, q, r] > top:
                    top = scores[p, q, r]
                    best[0], best[1], best[2] = a - reach, b - reach, c - reach
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


@njit(cache=True)
def _is_peak(scores, found, reach, least):
    """Whether the best shift has neighbours on all sides, and scores `least` or more."""
    inside = max(abs(found[0]), abs(found[1]), abs(found[2])) < reach
    return inside and scores[found[0] + reach, found[1] + reach, found[2] + reach] >= least


@njit(cache=True, inline="always")
def _searched(block, image, affine, reach, sure, best):
    """The image's cube about where a block is expected, and scores (27,) about the best shift, which best (3,) is set
    to; scores of -1 where there is none.
    """
    around, first = np.full(27, np.float32(-1)), reach if np.isinf(sure) else min(NEAR, reach)
    cube = _warped(image, affine, RADIUS + first)
    scores, middle = _scores(block, cube, first, best), np.zeros(3, np.int64)
    if first < reach and not _is_peak(scores, best, first, sure):
        cube = _warped(image, affine, RADIUS + reach)
        if _look_far(block, cube, reach, middle) < LEAST_NCC:
            return cube, around
        for m in range(3):
            middle[m] = min(max(middle[m], first - reach), reach - first)
        a, b, c = middle[0] + reach - first, middle[1] + reach - first, middle[2] + reach - first
        scores = _scores(block, _block(cube, a, b, c, WIDTH + 2 * first), first, best)
    if _is_peak(scores, best, first, np.float32(LEAST_NCC)):
        for m in range(27):
            a, b, c = best[0] + first - 1 + m // 9, best[1] + first - 1 + m // 3 % 3, best[2] + first - 1 + m % 3
            around[m] = scores[a, b, c]
    for m in range(3):
        best[m] += middle[m]
    return cube, around


@njit(cache=True, nogil=True)
def _match_some(fixed, moving, where, reach, sure, best, first, end):
    """Blocks first..end of `match_affine_blocks`. where: starts and affines."""
    back_reach = reach if np.isinf(sure) else min(NEAR, reach)
    half = RADIUS + back_reach
    for n in range(first, end):
        start, found = where[0][n], np.zeros(3, np.int64)
        if not _holds(fixed, start, RADIUS + reach):
            continue
        block = _block(fixed, start[0] - RADIUS, start[1] - RADIUS, start[2] - RADIUS, WIDTH)
        if block.inside.sum() < LEAST_INSIDE * WIDTH**3:
            continue
        cube, around = _searched(block, moving, where[1][n], reach, sure, found)
        if around[13] < LEAST_NCC:
            continue
        for m in range(27):
            best.around[n, m] = around[m]
        for m in range(3):
            best.shift[n, m] = found[m]
        middle = cube.hu.shape[0] // 2 - RADIUS
        there = _block(cube, middle + found[0], middle + found[1], middle + found[2], WIDTH)
        near = _block(fixed, start[0] - half, start[1] - half, start[2] - half, 2 * half + 1)
        _scores(there, near, back_reach, found)
        for m in range(3):
            best.back[n, m] = found[m]
