"""Blocks of one image found in another that is stretched and turned about them, compared where both show the same kind
of tissue and nowhere else.

Beside a border that one image has and the other has not, only a correlation that leaves out what lies beyond can tell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from registration.keypoints.matching import FLAT_HU, between_voxels
from registration.volume import Array

LEAST_INSIDE = 0.35
"""Share of a block's voxels that have to lie inside in both images."""
LEAST_NCC = 0.3
"""Below this there is no need to look for the way back."""


@dataclass(frozen=True)
class Inside:
    """An image and what of it counts. hu: (ni, nj, nk) float32; inside: of that shape, bool."""

    hu: Array
    inside: Array


@dataclass(frozen=True)
class Found:
    """shift: (n, 3) voxels of the fixed image from where a block was expected to where it was found, turned as the
    guess says; ncc: (n,), -1 where none was found; stray: (n,) how many voxels the way there and back ends off its
    start.
    """

    shift: Array
    ncc: Array
    stray: Array


def find_turned(fixed: Inside, moving: Inside, starts: Array, maps: Array, radius: int, reach: int) -> Found:
    """The blocks about voxels `starts` (n, 3) of a fixed image in a moving one, up to `reach` voxels from where they
    are expected.

    maps: (n, 3, 4), from a voxel's offset from its start to a voxel of the moving image.
    """
    n = len(starts)
    best, back = np.zeros((n, 3), np.int64), np.zeros((n, 3), np.int64)
    around = np.full((n, 27), -1, np.float32)
    _find_all(
        *_plain(fixed), *_plain(moving), np.ascontiguousarray(starts, np.int64), maps, radius, reach, best, around, back
    )
    offset, is_top = between_voxels(around)
    return Found(best + offset, np.where(is_top, around[:, 13], -1), np.linalg.norm(back, axis=1))


def _plain(image: Inside) -> tuple[Array, Array]:
    """Values about zero, so that sums of squares keep their digits, and what counts of them."""
    level = image.hu[image.inside].mean(dtype=float) if image.inside.any() else 0.0
    return np.ascontiguousarray(image.hu - np.float32(level), np.float32), np.ascontiguousarray(image.inside)


@njit(cache=True, fastmath=True)
def _between(image, i, j, k, a, b, c):
    """Value between eight voxels, a fraction (a, b, c) beyond voxel (i, j, k)."""
    near = (1 - b) * ((1 - c) * image[i, j, k] + c * image[i, j, k + 1])
    near += b * ((1 - c) * image[i, j + 1, k] + c * image[i, j + 1, k + 1])
    far = (1 - b) * ((1 - c) * image[i + 1, j, k] + c * image[i + 1, j, k + 1])
    far += b * ((1 - c) * image[i + 1, j + 1, k] + c * image[i + 1, j + 1, k + 1])
    return (1 - a) * near + a * far


@njit(cache=True, fastmath=True)
def _carried(moving, within, matrix, half):
    """A cube of the moving image on the fixed one's voxels, and which of them count."""
    size = 2 * half + 1
    cube, known = np.zeros((size, size, size), np.float32), np.zeros((size, size, size), np.bool_)
    for p in range(size):
        for q in range(size):
            for r in range(size):
                a, b, c = p - half, q - half, r - half
                x = matrix[0, 3] + matrix[0, 0] * a + matrix[0, 1] * b + matrix[0, 2] * c
                y = matrix[1, 3] + matrix[1, 0] * a + matrix[1, 1] * b + matrix[1, 2] * c
                z = matrix[2, 3] + matrix[2, 0] * a + matrix[2, 1] * b + matrix[2, 2] * c
                i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
                if min(i, j, k) < 0:
                    continue
                if i + 1 >= moving.shape[0] or j + 1 >= moving.shape[1] or k + 1 >= moving.shape[2]:
                    continue
                if within[int(np.rint(x)), int(np.rint(y)), int(np.rint(z))]:
                    known[p, q, r] = True
                    cube[p, q, r] = _between(moving, i, j, k, x - i, y - j, z - k)
    return cube, known


@njit(cache=True, fastmath=True)
def _ncc(block, inside, cube, known, a, b, c):
    """NCC of a block with the one of a cube whose first voxel is (a, b, c), over voxels that count in both; -1 where
    those are few or show nothing.
    """
    width, n = block.shape[0], 0
    f, m, ff, mm, fm = np.float32(0), np.float32(0), np.float32(0), np.float32(0), np.float32(0)
    for p in range(width):
        for q in range(width):
            for r in range(width):
                if inside[p, q, r] and known[a + p, b + q, c + r]:
                    u, v = block[p, q, r], cube[a + p, b + q, c + r]
                    n += 1
                    f += u
                    m += v
                    ff += u * u
                    mm += v * v
                    fm += u * v
    if n < LEAST_INSIDE * width**3:
        return np.float32(-1)
    ff -= f * f / n
    mm -= m * m / n
    if min(ff, mm) < n * np.float32(FLAT_HU**2):
        return np.float32(-1)
    return (fm - f * m / n) / np.sqrt(ff * mm)


@njit(cache=True, fastmath=True)
def _scores(block, inside, cube, known, first, reach):
    """NCC (2 reach + 1, ...) at every shift about the voxel `first` (3,) of a cube, and the shift (3,) of the best."""
    n, middle = 2 * reach + 1, block.shape[0] // 2
    scores, top, best = np.full((n, n, n), np.float32(-1)), np.float32(-1), np.zeros(3, np.int64)
    for p in range(n):
        for q in range(n):
            for r in range(n):
                a, b, c = first[0] + p - reach, first[1] + q - reach, first[2] + r - reach
                if not known[a + middle, b + middle, c + middle]:
                    continue
                scores[p, q, r] = _ncc(block, inside, cube, known, a, b, c)
                if scores[p, q, r] > top:
                    top = scores[p, q, r]
                    best[0], best[1], best[2] = p - reach, q - reach, r - reach
    return scores, best


@njit(cache=True, fastmath=True)
def _cut(image, first, width):
    """A block whose first voxel is `first` (3,)."""
    a, b, c = first
    return image[a : a + width, b : b + width, c : c + width].copy()


@njit(cache=True, fastmath=True)
def _find(fixed, inside, moving, within, start, matrix, radius, reach, best, around, back):
    """One block of `find_turned`."""
    width, half = 2 * radius + 1, radius + reach
    for m in range(3):
        if start[m] < half or start[m] >= fixed.shape[m] - half:
            return
    block, lung = _cut(fixed, start - radius, width), _cut(inside, start - radius, width)
    if lung.sum() < LEAST_INSIDE * width**3:
        return
    cube, known = _carried(moving, within, matrix, half)
    middle = np.full(3, reach)
    scores, shift = _scores(block, lung, cube, known, middle, reach)
    a, b, c = shift + reach
    if np.abs(shift).max() == reach or scores[a, b, c] < LEAST_NCC:
        return
    best[:] = shift
    around[:] = scores[a - 1 : a + 2, b - 1 : b + 2, c - 1 : c + 2].copy().ravel()
    found, lung = _cut(cube, middle + shift, width), _cut(known, middle + shift, width)
    back[:] = _scores(found, lung, fixed, inside, start - radius, reach)[1]


@njit(cache=True, parallel=True)
def _find_all(fixed, inside, moving, within, starts, maps, radius, reach, best, around, back):
    for n in prange(starts.shape[0]):
        _find(fixed, inside, moving, within, starts[n], maps[n], radius, reach, best[n], around[n], back[n])
