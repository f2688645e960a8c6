"""Blocks compared by their self-similarity: how a voxel's neighbours resemble each other, whatever grey values they
have.

Gain, offset and noise of the scanner, and the density of the tissue, drop out; what is left is the shape of vessels and
airways. Ref: Heinrich 2013 (self-similarity context, quantized, compared by Hamming distance).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numba import njit

from registration.kernels.threads import in_parts
from registration.keypoints.matching import subvoxel_peak
from registration.volume import Array

STEP = 2
"""Voxels from a voxel to the six neighbours that are compared with each other."""
RIM = STEP + 1
"""Voxels about an image that its border's neighbours reach."""
LEVELS = 6
"""Each comparison is told in so many steps; with 12 comparisons of 5 bits a voxel's description fits 64 bits."""
BLOCK_RADIUS = 4
"""Voxels; every other one within 1.1 times this radius is compared."""
EXCLUDED = 2
"""Shifts this near to the best one, in voxels, are the same place."""
NO_COST = np.float32(61.0)
"""Beyond any mean Hamming distance."""

_SIX = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)])
_PAIRS = np.array([(a, b) for a, b in combinations(range(6), 2) if not np.array_equal(_SIX[a], -_SIX[b])])
_STEPS = np.arange(-BLOCK_RADIUS, BLOCK_RADIUS + 1, 2)
_BLOCK = np.array([(a, b, c) for a in _STEPS for b in _STEPS for c in _STEPS if a * a + b * b + c * c <= 20])
_LIMITS = np.log(np.arange(1, LEVELS) / LEVELS)
"""Of minus a difference over the mean one: exp of it, times `LEVELS`, is 1, 2, ... there."""


@dataclass(frozen=True)
class Similar:
    """Where the blocks about some voxels look most alike in another image.

    shift: (n, 3) voxels, between voxels; cost: (n,) mean Hamming distance of the best block, 0 to 60; runner_up: (n,)
    of the best one elsewhere; is_inner: (n,) whether the best one lies inside the search and the image.
    """

    shift: Array
    cost: Array
    runner_up: Array
    is_inner: Array


class _Found(NamedTuple):
    """What `_search` fills. best: (n, 2) costs of the best and the next best shift (n, 3); around: (n, 27) costs about
    the best."""

    best: Array
    shift: Array
    around: Array


class _Pair(NamedTuple):
    """What `_search` compares. fixed, moving: descriptions of two images, flat (n,); shape: (3,) of both; allowed:
    voxels of the moving one that count; block: (m, 3) voxels about a middle one; offsets: (m,) the same, flat.
    """

    fixed: Array
    moving: Array
    shape: Array
    allowed: Array
    block: Array
    offsets: Array


def describe(hu: Array, needed: Array) -> Array:
    """Self-similarity (ni, nj, nk) uint64 of an image (ni, nj, nk) at the voxels `needed` (bool), 0 elsewhere.

    Ref: Heinrich 2013, eq. 3 and 4.
    """
    out = np.zeros(hu.shape, np.uint64)
    padded = np.pad(np.asarray(hu, np.float32), RIM, mode="edge")
    pairs = _SIX[_PAIRS[:, 0]] * STEP, _SIX[_PAIRS[:, 1]] * STEP
    in_parts(partial(_describe, padded, np.ascontiguousarray(needed), pairs, out), len(out))
    return out


def find_similar(fixed: Array, moving: Array, allowed: Array, starts: Array, reach: int) -> Similar:
    """The blocks of `moving` most like those of `fixed` about voxels `starts` (n, 3), up to `reach` voxels away.

    fixed, moving: descriptions of two images on one grid; allowed: voxels of the moving image that count.
    """
    n = len(starts)
    best, around = np.full((n, 2), NO_COST, np.float32), np.full((n, 27), NO_COST, np.float32)
    found = _Found(best, np.zeros((n, 3), np.int64), around)
    _, nj, nk = fixed.shape
    offsets = (_BLOCK @ np.array([nj * nk, nk, 1])).astype(np.uint64)  # of unsigned indices numba asks no sign
    here, there = (np.ascontiguousarray(codes).ravel() for codes in (fixed, moving))
    pair = _Pair(here, there, np.array(fixed.shape), np.ascontiguousarray(allowed), _BLOCK, offsets)
    in_parts(partial(_search, pair, np.ascontiguousarray(starts, np.int64), reach, found), len(starts))
    offset, is_top = subvoxel_peak(-around / NO_COST)
    return Similar(found.shift + offset, best[:, 0], best[:, 1], is_top)


@njit(cache=True)
def _popcount(bits):
    """How many of 64 bits are set."""
    bits -= (bits >> np.uint64(1)) & np.uint64(0x5555555555555555)
    bits = (bits & np.uint64(0x3333333333333333)) + ((bits >> np.uint64(2)) & np.uint64(0x3333333333333333))
    bits = (bits + (bits >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((bits * np.uint64(0x0101010101010101)) >> np.uint64(56))


@njit(cache=True)
def _differences(hu, i, j, start, stop, one, other, out):
    """Sums of squared differences of the 27 voxels about two neighbours, of voxels (i, j, start) to (i, j, stop)."""
    n = stop - start
    for k in range(n):
        out[k] = 0
    for a in range(-1, 2):
        for b in range(-1, 2):
            here, there = hu[i + a + one[0], j + b + one[1]], hu[i + a + other[0], j + b + other[1]]
            for c in range(-1, 2):
                p = here[start + c + one[2] : stop + c + one[2]]
                q = there[start + c + other[2] : stop + c + other[2]]
                for k in range(n):
                    out[k] += (p[k] - q[k]) ** 2


@njit(cache=True, nogil=True)
def _describe(padded, needed, pairs, out, start_plane, end_plane):
    first, second = pairs
    for i in range(start_plane, end_plane):
        apart, own = np.empty((len(first), out.shape[2]), np.float32), np.empty(len(first), np.float32)
        for j in range(out.shape[1]):
            asked = np.flatnonzero(needed[i, j])
            if len(asked) == 0:
                continue
            start, stop = asked[0], asked[-1] + 1
            for m in range(len(first)):
                _differences(padded, i + RIM, j + RIM, start + RIM, stop + RIM, first[m], second[m], apart[m])
            for k in asked:
                least, total = apart[0, k - start], np.float32(0)
                for m in range(len(first)):
                    least = min(least, apart[m, k - start])
                for m in range(len(first)):
                    own[m] = apart[m, k - start] - least
                    total += own[m]
                spread = max(total / np.float32(len(first)), np.float32(1e-3))
                bits = np.uint64(0)
                for m in range(len(first)):
                    closeness, level = -own[m] / spread, 0
                    for n in range(LEVELS - 1):
                        level += closeness >= _LIMITS[n]
                    bits |= ((np.uint64(1) << np.uint64(level)) - np.uint64(1)) << np.uint64((LEVELS - 1) * m)
                out[i, j, k] = bits


@njit(cache=True)
def _holds_block(shape, at):
    """Whether the whole block about a voxel lies in an image."""
    inside = True
    for m in range(3):
        inside &= BLOCK_RADIUS <= at[m] < shape[m] - BLOCK_RADIUS
    return inside


@njit(cache=True)
def _number(shape, at):
    """Flat number of a voxel."""
    return np.uint64((at[0] * shape[1] + at[1]) * shape[2] + at[2])


@njit(cache=True)
def _whole_cost(pair, own, at):
    """Mean Hamming distance of a block's descriptions (m,) and those about a voxel, all of them in the image."""
    total, middle = 0, _number(pair.shape, at)
    for m in range(len(own)):
        total += _popcount(own[m] ^ pair.moving[middle + pair.offsets[m]])
    return np.float32(total / len(own))


@njit(cache=True)
def _cut_cost(pair, start, at):
    """Mean Hamming distance of two blocks over the voxels that lie in both images."""
    total, n, here, there = 0, 0, _number(pair.shape, start), _number(pair.shape, at)
    for m in range(len(pair.block)):
        inside = True
        for axis in range(3):
            p, x = start[axis] + pair.block[m, axis], at[axis] + pair.block[m, axis]
            inside &= min(p, x) >= 0 and max(p, x) < pair.shape[axis]
        if inside:
            total += _popcount(pair.fixed[here + pair.offsets[m]] ^ pair.moving[there + pair.offsets[m]])
            n += 1
    return np.float32(total / n) if 2 * n >= len(pair.block) else NO_COST


@njit(cache=True)
def _fill(cost, pair, start, own, window):
    """Costs, where not known yet, of every `step`-th shift up to `half` about the one at `middle` (3,).

    cost: (w, w, w) of all shifts; own: the block's descriptions, none where it is cut; window: middle, half, step.
    """
    middle, half, step = window
    reach, at = cost.shape[0] // 2, np.empty(3, np.int64)
    for a in range(max(middle[0] - half, 0), min(middle[0] + half + 1, cost.shape[0]), step):
        for b in range(max(middle[1] - half, 0), min(middle[1] + half + 1, cost.shape[1]), step):
            for c in range(max(middle[2] - half, 0), min(middle[2] + half + 1, cost.shape[2]), step):
                at[0], at[1], at[2] = start[0] + a - reach, start[1] + b - reach, start[2] + c - reach
                if (
                    min(at[0], at[1], at[2]) < 0
                    or at[0] >= pair.shape[0]
                    or at[1] >= pair.shape[1]
                    or at[2] >= pair.shape[2]
                ):
                    continue
                if cost[a, b, c] != NO_COST or not pair.allowed[at[0], at[1], at[2]]:
                    continue
                if len(own) and _holds_block(pair.shape, at):
                    cost[a, b, c] = _whole_cost(pair, own, at)
                else:
                    cost[a, b, c] = _cut_cost(pair, start, at)


@njit(cache=True)
def _top(cost):
    top, width = np.argmin(cost), cost.shape[0]
    return top // width**2, top // width % width, top % width


@njit(cache=True, nogil=True)
def _search(pair, starts, reach, found, first, end):
    """Fill what is found of starts first..end.

    Every other shift is compared, and all about the best of these.
    """
    width = 2 * reach + 1
    for n in range(first, end):
        own = np.empty(len(pair.block) if _holds_block(pair.shape, starts[n]) else 0, np.uint64)
        for m in range(len(own)):
            own[m] = pair.fixed[_number(pair.shape, starts[n]) + pair.offsets[m]]
        cost = np.full((width, width, width), NO_COST)
        _fill(cost, pair, starts[n], own, ((reach, reach, reach), reach, 2))
        _fill(cost, pair, starts[n], own, (_top(cost), 3, 1))
        i, j, k = _top(cost)
        found.best[n, 0] = cost[i, j, k]
        found.shift[n, 0], found.shift[n, 1], found.shift[n, 2] = i - reach, j - reach, k - reach
        if min(i, j, k) > 0 and max(i, j, k) < width - 1:
            for m in range(27):
                found.around[n, m] = cost[i - 1 + m // 9, j - 1 + m // 3 % 3, k - 1 + m % 3]
        found.best[n, 1] = _least_elsewhere(cost, (i, j, k))


@njit(cache=True)
def _least_elsewhere(cost, top):
    """Least cost of shifts farther than EXCLUDED voxels from the best along some axis."""
    least = NO_COST
    for a in range(cost.shape[0]):
        for b in range(cost.shape[1]):
            for c in range(cost.shape[2]):
                if max(abs(a - top[0]), abs(b - top[1]), abs(c - top[2])) > EXCLUDED:
                    least = min(least, cost[a, b, c])
    return least
