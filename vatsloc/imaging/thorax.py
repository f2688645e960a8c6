"""The operated lung's space in a CBCT, parted from the other lung, the airways and the air outside the body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from registration.images.morphology import close, dilate, erode, largest
from registration.images.resample import resample_mask
from registration.maps.field import PointMap
from registration.volume import Array, Grid, Mask, Volume
from vatsloc.errors import InputRefused
from vatsloc.imaging.airways import TrackedAirways, track_airways
from vatsloc.imaging.cbct import FieldOfView, PreparedCbct
from vatsloc.imaging.lattice import on_grid, working_copy
from vatsloc.imaging.lungs import Lungs, Side

SPACING_MM = 2.0
AERATED_HU = -350.0
LEAST_SHARE = 0.40
DEEP_MM = 6.0
"""Below a lung's surface; bronchi there go with the lung."""


@dataclass(frozen=True)
class ThoraxPrior:
    """Where the CT says things are, carried into the frame of a CBCT: the operated lung, the other one, the airways."""

    lung: Mask
    other: Mask
    airways: Mask


def carry_prior(lungs: Lungs, side: Side, cbct: Volume, ct_from_cbct: PointMap) -> ThoraxPrior:
    """Masks of the CT on a 2 mm grid over `cbct`. ct_from_cbct: any map of points (n, 3) in RAS mm."""
    grid = working_copy(cbct, SPACING_MM).grid
    other = lungs.right if side == "left" else lungs.left
    lung, beside, airways = (resample_mask(m, grid, ct_from_cbct) for m in (lungs.of(side), other, lungs.airways))
    return ThoraxPrior(lung, beside, airways)


def visible_share(lung: Mask, field: FieldOfView, cbct_from_ct: PointMap) -> float:
    """Share of the CT's lung that falls into the CBCT's field of view, bad slices left out."""
    points = lung.grid.to_ras(np.argwhere(lung.inside)[::97].astype(float))
    ijk = np.rint(field.usable.grid.to_ijk(cbct_from_ct(points))).astype(int)
    within = ((ijk >= 0) & (ijk < field.usable.inside.shape)).all(axis=1)
    return float(field.usable.inside[tuple(ijk[within].T)].sum() / max(len(points), 1))


def require_share(share: float, side: Side, least: float = LEAST_SHARE) -> None:
    """Raise InputRefused when a CBCT shows less than `least` of the operated lung."""
    if share < least:
        raise InputRefused(
            f"CBCT shows {100 * share:.0f} % of the {side} lung, {100 * least:.0f} % needed; "
            "re-crop, or lower [gates] min_overlap."
        )


def inflated_lung(cbct: PreparedCbct, prior: ThoraxPrior) -> Mask:
    """The operated lung in the inflated CBCT, inside the field of view, vessels closed by an 8 mm ball.

    Ref: Alvarez 2021, section 6.1.4, without the hand-made corrections.
    """
    work, seen = working_scene(cbct)
    space, _ = lung_space(work, seen, prior)
    spacing = work.grid.spacing
    closed = ndimage.binary_fill_holes(close(space, 8.0, spacing)) & seen
    return on_grid(largest(closed), work.grid, cbct.volume.grid, smooth_mm=1.0)


def working_scene(cbct: PreparedCbct) -> tuple[Volume, Array]:
    """Working copy of a prepared CBCT and which of its voxels were seen."""
    work = working_copy(cbct.volume, SPACING_MM)
    return work, on_grid(cbct.field.mask.inside, cbct.volume.grid, work.grid).inside


def central_airways(prior: ThoraxPrior, grid: Grid) -> Array:
    """Which voxels of a grid are expected to be airways and not deep in a lung, where a collapse moves them far."""
    lung, other, tubes = (_on(m, grid) for m in (prior.lung, prior.other, prior.airways))
    deep = [erode(inside, DEEP_MM, grid.spacing) for inside in (lung, other)]
    return np.asarray(tubes & ~deep[0] & ~deep[1])


def lung_space(work: Volume, seen: Array, prior: ThoraxPrior) -> tuple[Array, TrackedAirways]:
    """Aerated voxels of the operated side, its lung and the air around it when it has collapsed; and the airways.

    Aerated regions are cut at their necks, every core goes to the prior it overlaps most, and cores grow back together.
    """
    spacing = work.grid.spacing
    lung, other = (_on(m, work.grid) for m in (prior.lung, prior.other))
    airways = track_airways(work, seen, central_airways(prior, work.grid))
    near = dilate(lung, 15.0, spacing) | dilate(other, 10.0, spacing)
    aerated = (work.hu < AERATED_HU) & seen & near & ~dilate(airways.inside, 2.5, spacing)
    return _grow(_owners(aerated, spacing, lung, other, airways.inside), aerated) == 1, airways


def _on(mask: Mask, grid: Grid) -> Array:
    return mask.inside if mask.grid.same_as(grid) else on_grid(mask.inside, mask.grid, grid).inside


def _owners(aerated: Array, spacing: Array, lung: Array, other: Array, tubes: Array) -> Array:
    """Owner of every core: 1 operated lung, 2 anything else. Cores that belong to both lungs are cut deeper."""
    owner = np.zeros(aerated.shape, dtype=np.uint8)
    pending = np.ones(aerated.shape, dtype=bool)
    for radius in (2.5, 4.0, 6.0, 9.0, 13.0):
        labels, count = ndimage.label(erode(aerated, radius, spacing) & pending)
        if count == 0:
            break
        size = np.bincount(labels.ravel(), minlength=count + 1).astype(float)
        in_lung, in_other, in_tubes = (np.bincount(labels[m], minlength=count + 1) for m in (lung, other, tubes))
        both = (np.minimum(in_lung, in_other) > 0.2 * np.maximum(in_lung, in_other)) & (size > 100)
        both[0] = False
        mine = (in_lung > in_other) & (in_lung > in_tubes) & (in_lung > 0.15 * size)
        value = np.where(mine, 1, 2).astype(np.uint8)
        value[both] = 0
        value[0] = 0
        settled = value[labels]
        owner = np.where(owner == 0, settled, owner)
        pending = both[labels]
        if not both.any():
            break
    else:
        owner = np.where(pending & (owner == 0) & aerated, np.where(lung, 1, 2), owner).astype(np.uint8)
    return owner


def _grow(owner: Array, allowed: Array) -> Array:
    """Cores grown inside `allowed`, all at one pace, until nothing changes; at most 20 voxels far."""
    grown, free = owner, allowed & (owner == 0)
    for _ in range(20):
        front = np.zeros_like(grown)
        for axis in range(3):
            here, there = np.moveaxis(front, axis, 0), np.moveaxis(grown, axis, 0)
            np.maximum(here[1:], there[:-1], out=here[1:])
            np.maximum(here[:-1], there[1:], out=here[:-1])
        reached = free & (front > 0)
        if not reached.any():
            break
        grown = np.where(reached, front, grown)
        free &= ~reached
    return grown
