"""Masks of lungs spoilt the ways in which people hand them in, to see what mending makes of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy import ndimage

from registration.volume import Array, Grid, Mask
from vatsloc.breathing.case import BreathCase, Scan

Spoil = Callable[[Array, Grid, np.random.Generator], Array]
"""A spoilt copy of a mask (ni, nj, nk) bool of lungs, on its grid."""
CUT_MM, MISSING_MM, BACK_MM = 6.0, 22.0, 25.0


def joined(inside: Array, grid: Grid, _rng: np.random.Generator) -> Array:
    """Both lungs in one piece: what lies between them is filled in front, in a fifth of the slices."""
    spoilt, (front, up) = inside.copy(), (_coordinate(inside, grid, axis) for axis in (1, 2))
    for k in range(inside.shape[2]):
        if not 0.4 < up[0, 0, k] < 0.6:
            continue
        for j in np.flatnonzero(front[0, :, 0] > 0.7):
            line = np.flatnonzero(inside[:, j, k])
            if len(line):
                spoilt[line[0] : line[-1] + 1, j, k] = True
    return spoilt


def in_pieces(inside: Array, grid: Grid, _rng: np.random.Generator) -> Array:
    """Each lung in three pieces: two level gaps of `CUT_MM`."""
    spoilt, up = inside.copy(), _coordinate(inside, grid, 2)
    half = CUT_MM / 2 / _extent(inside, grid, 2)
    for at in (0.35, 0.65):
        spoilt &= np.abs(up - at) > half
    return spoilt


def parts_missing(inside: Array, grid: Grid, rng: np.random.Generator) -> Array:
    """Four bites of radius `MISSING_MM` out of the surface."""
    border = np.argwhere(inside & ~ndimage.binary_erosion(inside))
    return inside & ~_balls(inside, grid, border[rng.integers(len(border), size=4)], np.full(4, MISSING_MM))


def stray_bits(inside: Array, grid: Grid, rng: np.random.Generator) -> Array:
    """Twenty balls of 3 to 8 mm anywhere in the image."""
    return inside | _balls(inside, grid, rng.integers(inside.shape, size=(20, 3)), rng.uniform(3, 8, 20))


def dropped_slices(inside: Array, grid: Grid, rng: np.random.Generator) -> Array:
    """A tenth of the slices empty, one by one, and 12 mm in one place."""
    spoilt, filled = inside.copy(), np.flatnonzero(inside.any(axis=(0, 1)))
    spoilt[:, :, rng.choice(filled, len(filled) // 10, replace=False)] = False
    start = filled[int(0.55 * len(filled))]
    spoilt[:, :, start : start + round(12 / grid.spacing[2])] = False
    return spoilt


def back_left_out(inside: Array, grid: Grid, _rng: np.random.Generator) -> Array:
    """The last `BACK_MM` in front of the back wall, in the lower half: too dense for a threshold."""
    behind = -np.sign(grid.ras_from_ijk[1, 1])  # the way along axis 1 that leads to the back
    run = np.cumsum(inside[:, :: -int(behind)], axis=1)[:, :: -int(behind)]
    low = _coordinate(inside, grid, 2) < 0.5
    return inside & ~((run <= BACK_MM / grid.spacing[1]) & low)


SPOILT: dict[str, tuple[Spoil, tuple[str, ...]]] = {
    "both lungs joined": (joined, ("inspiration", "expiration")),
    "in three pieces": (in_pieces, ("expiration",)),
    "parts missing": (parts_missing, ("expiration",)),
    "stray bits": (stray_bits, ("inspiration", "expiration")),
    "slices dropped": (dropped_slices, ("inspiration", "expiration")),
    "dense back left out": (back_left_out, ("expiration",)),
}
"""Ways to spoil masks, and of which states."""


def spoilt(case: BreathCase, way: str) -> BreathCase:
    """The case with its masks spoilt in one of the ways of `SPOILT`; images and landmarks stay."""
    spoil, states = SPOILT[way]
    rng = np.random.default_rng(0)

    def of(scan: Scan | None, state: str) -> Scan | None:
        if scan is None or scan.mask is None or state not in states:
            return scan
        mask = scan.mask
        return replace(scan, mask=Mask(spoil(mask.inside, mask.grid, rng), mask.ras_from_ijk))

    inspiration, expiration = of(case.inspiration, "inspiration"), of(case.expiration, "expiration")
    return replace(case, inspiration=inspiration, expiration=expiration)


def _coordinate(inside: Array, grid: Grid, axis: int) -> Array:
    """From 0 at the back, or the feet, to 1 at the front, or the head, of what is filled; shaped to broadcast."""
    filled = np.flatnonzero(inside.any(axis=tuple(a for a in range(3) if a != axis)))
    share = (np.arange(inside.shape[axis]) - filled[0]) / max(filled[-1] - filled[0], 1)
    share = share if grid.ras_from_ijk[axis, axis] > 0 else 1 - share
    return share.reshape([-1 if a == axis else 1 for a in range(3)])


def _extent(inside: Array, grid: Grid, axis: int) -> float:
    filled = np.flatnonzero(inside.any(axis=tuple(a for a in range(3) if a != axis)))
    return float((filled[-1] - filled[0]) * grid.spacing[axis])


def _balls(inside: Array, grid: Grid, centres: Array, radii_mm: Array) -> Array:
    """Voxels in balls about voxels (n, 3) of radii (n,) mm."""
    found = np.zeros_like(inside)
    for centre, radius in zip(centres, radii_mm, strict=True):
        reach = np.ceil(radius / grid.spacing).astype(int)
        box = tuple(
            slice(max(c - r, 0), min(c + r + 1, n)) for c, r, n in zip(centre, reach, inside.shape, strict=True)
        )
        at = np.moveaxis(np.asarray(np.mgrid[box]), 0, -1)
        found[box] |= np.linalg.norm((at - centre) * grid.spacing, axis=-1) <= radius
    return found
