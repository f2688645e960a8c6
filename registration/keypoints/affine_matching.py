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


class _Search(NamedTuple):
    """radius: of a block; reach: how far shifts go; both in voxels."""

    radius: int
    reach: int


class _Best(NamedTuple):
    """What the search fills: shift, back: (n, 3) best shifts there and back; around: (n, 27) scores about the first."""

    shift: Array
    around: Array
    back: Array


def match_affine_blocks(
    fixed: MaskedImage, moving: MaskedImage, starts: Array, affines: Array, radius: int, reach: int
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
        _Search(radius, reach),
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
def _correlation(block, image, a, b, c):
    """NCC of a block with the one of an image whose first voxel is (a, b, c), over voxels that count in both; -1 where
    those are few or show nothing.
    """
    width, n = block.hu.shape[0], 0
    f, m, ff, mm, fm = np.float32(0), np.float32(0), np.float32(0), np.float32(0), np.float32(0)
    for p in range(width):
        for q in range(width):
            for r in range(width):
                if block.inside[p, q, r] and image.inside[a + p, b + q, c + r]:
                    u, v = block.hu[p, q, r], image.hu[a + p, b + q, c + r]
                    n += 1
                    f += u
                    m += v
                    ff += u * u
                    mm += v * v
                    fm += u * v
    if n < LEAST_INSIDE * width**3:
        return np.float32(-1)
    flat = np.float32(FLAT_HU**2)
    return coefficient(n, f, m, ff, mm, fm, flat, flat)


@njit(cache=True)
def _scores(block, image, first, reach):
    """NCC (2 reach + 1, ...) at every shift about the voxel `first` (3,) of an image, and the shift (3,) of the
    best.
    """
    n, middle = 2 * reach + 1, block.hu.shape[0] // 2
    scores, top, best = np.full((n, n, n), np.float32(-1)), np.float32(-1), np.zeros(3, np.int64)
    for p in range(n):
        for q in range(n):
            for r in range(n):
                a, b, c = first[0] + p - reach, first[1] + q - reach, first[2] + r - reach
                if not image.inside[a + middle, b + middle, c + middle]:
                    continue
                scores[p, q, r] = _correlation(block, image, a, b, c)
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
def _match(fixed, moving, start, affine, search, shift, around, back):
    """One block of `match_affine_blocks`."""
    radius, reach = search.radius, search.reach
    width, half = 2 * radius + 1, radius + reach
    for m in range(3):
        if start[m] < half or start[m] >= fixed.hu.shape[m] - half:
            return
    block = _block(fixed, start - radius, width)
    if block.inside.sum() < LEAST_INSIDE * width**3:
        return
    cube = _warped(moving, affine, half)
    middle = np.full(3, reach)
    scores, best = _scores(block, cube, middle, reach)
    a, b, c = best + reach
    if np.abs(best).max() == reach or scores[a, b, c] < LEAST_NCC:
        return
    shift[:] = best
    around[:] = scores[a - 1 : a + 2, b - 1 : b + 2, c - 1 : c + 2].copy().ravel()
    back[:] = _scores(_block(cube, middle + best, width), fixed, start - radius, reach)[1]


@njit(cache=True, parallel=True)
def _match_all(fixed, moving, starts, affines, search, best):
    for n in prange(starts.shape[0]):
        _match(fixed, moving, starts[n], affines[n], search, best.shift[n], best.around[n], best.back[n])
