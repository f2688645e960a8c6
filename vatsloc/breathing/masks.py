"""Lungs of a mask as it comes: slices that were dropped filled in, stray bits left out, pieces joined, lungs parted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from registration.images.morphology import close, distances_to
from registration.images.resample import resample_mask
from registration.volume import Array, Grid, Mask, Volume
from vatsloc.errors import InputRefused
from vatsloc.frames import Side
from vatsloc.imaging.lattice import working_copy
from vatsloc.imaging.lungs import grow_both, part_joined

SPACING_MM = 2.0
LEAST_ML = 100.0
"""Less lung than this is none: a child's has more."""
STRAY_SHARE = 0.02
"""Pieces below this share of the largest one are stray bits."""
GAP_MM = 25.0
"""Slices missing over more than this are not filled in: the shape between is not known."""
TORN_SHARE = 0.7
"""A slice that holds less than this of what both its neighbours have in common has lost a part."""
BEHIND = (0.8, 0.7, 0.6, 0.5, 0.4, 0.3)
"""Shares of the depth, from the back, behind which joined lungs are looked for as two."""
BACK_MM, STOREYS, BACK_SEEN = 15.0, 3, 0.4
"""How far in front of its back wall a lung's back reaches, in how many storeys of one height it is looked at, and the
share of each that an expired mask holds at least: 0.54 to 0.92 in whole lungs, 0.0 to 0.27 where it lacks its back."""
JOIN_MM = (4.0, 8.0, 12.0, 16.0)
"""Radii, one after the other, of the ball that closes what lies between pieces of one lung."""


@dataclass(frozen=True)
class CleanLungs:
    """Lungs by side, on voxels about 2 mm wide along R, A, S; notes: what was mended, as sentences."""

    lungs: dict[Side, Mask]
    notes: tuple[str, ...]


def lungs_of(mask: Mask, name: str) -> CleanLungs:
    """One or two lungs of a mask. name: of the state, for the sentences. Raises InputRefused where no lung is left."""
    work = working_copy(Volume(mask.inside.astype(np.float32), mask.ras_from_ijk), SPACING_MM)
    grid, inside = work.grid, work.hu >= 0.5
    voxel_ml = float(grid.spacing.prod()) / 1000
    notes: list[str] = []
    inside, mended = fill_slices(inside, grid.spacing[2])
    if mended:
        notes.append(f"The {name} mask: {mended} slices were missing or torn and were filled in.")
    inside, strays = _without_strays(inside)
    if strays * voxel_ml > 1:
        notes.append(f"The {name} mask: {strays * voxel_ml:.0f} ml of stray bits were left out.")
    if inside.sum() * voxel_ml < LEAST_ML:
        raise InputRefused(
            f"The {name} mask holds {inside.sum() * voxel_ml:.0f} ml of lung, {LEAST_ML:.0f} ml needed; "
            "give a mask of one lung or of both."
        )
    halves = _halves(inside, grid)
    lungs: dict[Side, Mask] = {}
    for side, half in halves.items():
        whole, lost = _joined(half, grid.spacing)
        other = halves["left" if side == "right" else "right"] if len(halves) == 2 else np.zeros_like(half)
        lungs[side] = Mask(_closed(whole, other & ~half, grid.spacing), work.ras_from_ijk)
        if lost * voxel_ml > 5:
            notes.append(
                f"The {name} mask: {lost * voxel_ml:.0f} ml of the {side} lung lie too far from the rest to be joined "
                "to it and were left out."
            )
    return CleanLungs(lungs, tuple(notes))


def to_the_back(expired: Mask, inspired: Mask) -> Mask:
    """Expired lung filled up to the back wall of the inspired one; voxels along the patient's axes.

    On a patient's back, spine and back ribs lie still; but what lies lowest may grow so dense in expiration that a
    threshold leaves it out of the mask.
    """
    inspired = resample_mask(inspired, expired.grid)
    step = -1 if expired.ras_from_ijk[1, 1] < 0 else 1
    lung, full = expired.inside[:, ::step], inspired.inside[:, ::step]
    # Running from back to front: behind the expired lung, and not behind the inspired one.
    behind = ~np.logical_or.accumulate(lung, axis=1) & lung.any(axis=1, keepdims=True)
    filled = lung | (behind & np.logical_or.accumulate(full, axis=1))
    return Mask(filled[:, ::step], expired.ras_from_ijk)


def back_seen(expired: Mask, inspired: Mask) -> Array:
    """Share (`STOREYS`,) of the inspired lung's back that the expired one holds, storey by storey along the body.

    Ribs and spine lie still behind a patient on the back, so little of it is left by a breath. Axes as the patient's.
    """
    full = resample_mask(inspired, expired.grid).inside
    step = -1 if expired.ras_from_ijk[1, 1] < 0 else 1
    lung, full = expired.inside[:, ::step], full[:, ::step]
    back = full & (np.cumsum(full, axis=1) * expired.grid.spacing[1] <= BACK_MM)
    storeys = np.array_split(np.flatnonzero(back.any(axis=(0, 1))), STOREYS)
    return np.array([(back & lung)[:, :, k].sum() / max(back[:, :, k].sum(), 1) for k in storeys])


def fill_slices(inside: Array, spacing_mm: float) -> tuple[Array, int]:
    """Axial slices that are empty, or lack much of what their neighbours share, interpolated by their distance maps.

    inside: (ni, nj, nk) bool, slices along k. Returns the mended mask and how many slices were changed.
    """
    inside = inside.copy()
    area = inside.sum(axis=(0, 1))
    full = np.flatnonzero(area)
    if len(full) < 3:
        return inside, 0
    bad = np.zeros(inside.shape[2], bool)
    bad[full[0] : full[-1] + 1] = area[full[0] : full[-1] + 1] == 0
    for k in range(int(full[0]) + 1, int(full[-1])):
        if not bad[k] and area[k - 1] and area[k + 1]:
            shared = inside[:, :, k - 1] & inside[:, :, k + 1]
            bad[k] = shared.any() and (inside[:, :, k] & shared).sum() < TORN_SHARE * shared.sum()
    good = np.flatnonzero((area > 0) & ~bad)
    mended = 0
    for k in np.flatnonzero(bad).tolist():
        below, above = good[good < k], good[good > k]
        if len(below) == 0 or len(above) == 0 or (above[0] - below[-1]) * spacing_mm > GAP_MM:
            continue
        low, high = int(below[-1]), int(above[0])
        share = (k - low) / (high - low)
        inside[:, :, k] |= (1 - share) * _signed(inside[:, :, low]) + share * _signed(inside[:, :, high]) > 0
        mended += 1
    return inside, mended


def _signed(slice_: Array) -> Array:
    if not slice_.any():
        return np.full(slice_.shape, -1e3)
    return ndimage.distance_transform_edt(slice_) - ndimage.distance_transform_edt(~slice_)


def _without_strays(inside: Array) -> tuple[Array, int]:
    labels, count = ndimage.label(inside)
    if count == 0:
        return inside, 0
    size = np.bincount(labels.ravel())
    size[0] = 0
    kept = size >= STRAY_SHARE * size.max()
    return kept[labels], int(size[~kept].sum())


def _halves(inside: Array, grid: Grid) -> dict[Side, Array]:
    """The lungs of a mask by side: its two largest pieces if side by side, or one parted, or one lung alone."""
    labels, count = ndimage.label(inside)
    size = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    order = np.argsort(size)[::-1] + 1
    seeds = [labels == order[0]]
    for n in order[1:]:
        if size[n - 1] > 0.2 * size[order[0] - 1] and _beside(seeds[0], labels == n, grid):
            seeds.append(labels == n)
            break
    if len(seeds) == 1:
        seeds = _parted(seeds[0], grid)
    if len(seeds) == 1:
        return {lone_side(inside, grid): inside}
    x = [grid.to_ras(np.argwhere(seed).mean(axis=0))[0] for seed in seeds]
    right, left = (seeds[n] for n in np.argsort(x)[::-1])
    # Whatever else is left belongs to the lung that it lies nearer to.
    left_over = np.argwhere(inside & ~(right | left))
    to_right, to_left = (distances_to(lung, left_over, grid.spacing) for lung in (right, left))
    for lung, mine in ((right, to_right <= to_left), (left, to_right > to_left)):
        lung[tuple(left_over[mine].T)] = True
    return {"left": left, "right": right}


def _parted(joined: Array, grid: Grid) -> list[Array]:
    """Two lungs of one piece, or the piece alone if it is one lung.

    They are parted where they are joined thinly. Where they have grown together in front of the heart, spine and
    mediastinum still keep them apart behind: those parts then grow forward at one pace until they meet.
    """
    parted = part_joined(joined, grid)
    if parted is not None and _beside(parted[0], parted[1], grid):
        return list(parted)
    rows = np.flatnonzero(joined.any(axis=(0, 2)))
    for share in BEHIND:
        # Voxel axis 1 runs to the front on a working grid.
        back = joined.copy()
        back[:, rows[0] + int(share * len(rows)) :] = False
        labels, count = ndimage.label(back)
        size = np.bincount(labels.ravel(), minlength=count + 1)[1:]
        if count < 2:
            continue
        one, two = np.argsort(size)[::-1][:2] + 1
        if size[two - 1] > 0.4 * size[one - 1] and _beside(labels == one, labels == two, grid):
            markers = np.where(labels == one, 1, np.where(labels == two, 2, 0)).astype(np.uint8)
            grown = grow_both(markers, joined, sum(joined.shape))
            return [grown == 1, grown == 2]
    return [joined]


def _beside(a: Array, b: Array, grid: Grid) -> bool:
    """Whether two pieces lie side by side, as two lungs do, and not one above or behind the other."""
    apart = np.abs(np.argwhere(a).mean(axis=0) - np.argwhere(b).mean(axis=0)) * grid.spacing
    return bool(apart[0] > 60 and apart[0] > 1.2 * max(apart[1], apart[2]))


def lone_side(inside: Array, grid: Grid) -> Side:
    """Side of a lung that is alone: heart and hilum dent it inward, ribs do not, so more of its hull is empty there."""
    hull, empty = 0.0, 0.0
    x = np.arange(inside.shape[0])
    for k in np.flatnonzero(inside.any(axis=(0, 1)))[::2]:
        for j in np.flatnonzero(inside[:, :, k].any(axis=0)):
            line = np.flatnonzero(inside[:, j, k])
            hull += line.mean()
            empty += 1
    middle = hull / max(empty, 1)
    low = high = 0.0
    for k in np.flatnonzero(inside.any(axis=(0, 1)))[::2]:
        filled = _hull(inside[:, :, k])
        gap = filled & ~inside[:, :, k]
        low += gap[x < middle].sum()
        high += gap[x >= middle].sum()
    # Voxel axis 0 runs to the right on a working grid: what is empty at low R lies inward of a right lung.
    return "right" if low > high else "left"


def _hull(slice_: Array) -> Array:
    """Convex hull of a slice, along its rows of constant j and its columns."""
    from skimage.morphology import convex_hull_image

    return np.asarray(convex_hull_image(slice_)) if slice_.sum() > 8 else slice_


def _joined(lung: Array, spacing: Array) -> tuple[Array, int]:
    """The lung in one piece, closed with a ball as small as will do; else its largest piece and what it lacks."""
    for radius in (0.0, *JOIN_MM):
        closed = lung if radius == 0 else lung | close(lung, radius, spacing)
        labels, count = ndimage.label(closed)
        if count == 1:
            return closed, 0
    size = np.bincount(labels.ravel())
    size[0] = 0
    kept = labels == np.argmax(size)
    return kept, int((lung & ~kept).sum())


def _closed(lung: Array, other: Array, spacing: Array) -> Array:
    """Vessels and hilum closed by a 10 mm ball, holes filled."""
    return ndimage.binary_fill_holes(close(lung, 10.0, spacing)) & ~other
