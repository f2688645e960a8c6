"""The spine: vertebrae with the heads of their ribs, found as the densest upright column at the back of the body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from registration.images.filters import gaussian
from registration.images.morphology import close, dilate
from registration.volume import Array, Mask, Volume
from vatsloc.errors import InputRefused
from vatsloc.imaging.lattice import on_grid, working_copy

SPACING_MM = 2.5
BODY_RADIUS_MM = 16.0
BENDING_MM_PER_MM = 0.6
REACH_R_MM = 40.0
REACH_FRONT_MM = 36.0
REACH_BACK_MM = 48.0
LEAST_LENGTH_MM = 60.0
METAL_HU, METAL_RIM_MM = 2000.0, 15.0
"""No bone is so dense; streaks make metal's surroundings look like bone."""


@dataclass(frozen=True)
class Spine:
    """Spine of an image on its grid. mask: vertebrae, rib heads and a rim of what touches them.

    centres_ras: (n, 3) centres of the vertebral column from bottom to top, mm; bone_hu: threshold that was used.
    """

    mask: Mask
    centres_ras: Array
    bone_hu: float

    def __repr__(self) -> str:
        lo, hi = self.centres_ras[0], self.centres_ras[-1]
        return f"Spine(from {np.round(lo, 1)} to {np.round(hi, 1)} RAS mm, bone above {self.bone_hu:.0f} HU)"


RIM_MM = 3.0
"""Soft tissue that is kept around bone."""


def segment_spine(image: Volume, usable: Mask | None = None) -> Spine:
    """Spine of a CT or CBCT.

    usable: voxels to trust (field of view without bad slices).
    Raises InputRefused where no upright column of bone is seen. Ref: Alvarez 2021, section 6.1.1.
    """
    work = working_copy(image, SPACING_MM)
    spacing = work.grid.spacing
    seen = (
        np.ones(work.grid.shape, dtype=bool)
        if usable is None
        else on_grid(usable.inside, usable.grid, work.grid).inside
    )
    bone_hu = bone_threshold(work.hu[seen])
    metal = dilate(work.hu > METAL_HU, METAL_RIM_MM, spacing)
    excess = np.where(seen & ~metal, np.clip(work.hu - bone_hu, 0, 250), 0).astype(np.float32)
    slices = np.flatnonzero(seen.any(axis=(0, 1)))
    if slices.size * spacing[2] < LEAST_LENGTH_MM:
        raise InputRefused(
            f"The image shows {slices.size * spacing[2]:.0f} mm along the spine, {LEAST_LENGTH_MM:.0f} mm needed; "
            "give one that is not cropped so far."
        )
    path = _column(work, excess, seen, slices)
    region = _around(path, work, slices) & seen
    bone = gaussian(excess, 0.5) > 0
    vertebrae = _joined_to_column(bone & region, path, slices, spacing)
    if vertebrae.sum() * spacing.prod() / 1000 < 0.5 * slices.size * spacing[2]:
        raise InputRefused(
            f"No spine found: {vertebrae.sum() * spacing.prod() / 1000:.0f} ml of bone above {bone_hu:.0f} HU in an "
            "upright column; check that the image holds the spine and its intensities are HU."
        )
    solid = close(vertebrae, 6.0, spacing)
    mask = dilate(solid, RIM_MM, spacing) & seen
    centres = work.grid.to_ras(np.column_stack([path, slices]).astype(float))
    return Spine(on_grid(mask, work.grid, image.grid), centres, bone_hu)


def bone_threshold(hu: Array) -> float:
    """HU above which tissue is bone, set from the image's own soft-tissue peak and its brightest tail.

    42 % of the way from the peak between -200 and 200 HU to the 99.8th percentile, 100 to 250 HU above it:
    cupping and a wrong scale move both ends alike.
    """
    counts, edges = np.histogram(hu, bins=np.arange(-200.0, 201.0, 10.0))
    smooth = ndimage.gaussian_filter1d(counts.astype(float), 2.0)
    soft = float(edges[int(smooth.argmax())] + 5.0)
    dense = float(np.percentile(hu, 99.8))
    return soft + float(np.clip(0.42 * (dense - soft), 100.0, 250.0))


def _column(work: Volume, excess: Array, seen: Array, slices: Array) -> Array:
    """In-slice index (n, 2) of the column's centre: the smooth upright path through the most bone.

    By dynamic programming over the slices.
    """
    spacing = work.grid.spacing
    sigma = BODY_RADIUS_MM / 2 / spacing
    density = gaussian(excess, (sigma[0], sigma[1], 2 * sigma[2]))[:, :, slices]
    weight = gaussian(seen.astype(np.float32), (sigma[0], sigma[1], 0))[:, :, slices]
    density = density / np.maximum(weight, 0.8)
    density /= max(float(density.max()), 1e-6)
    density = density - _too_far_front(work)[:, :, slices]
    reach = np.maximum(np.rint(BENDING_MM_PER_MM * spacing[2] / spacing[:2]), 1).astype(int)
    footprint = np.ones(2 * reach + 1, dtype=bool)
    best = density[:, :, 0]
    trail = [best]
    for k in range(1, len(slices)):
        best = ndimage.maximum_filter(best, footprint=footprint, mode="constant", cval=-np.inf) + density[:, :, k]
        trail.append(best)
    i, j = np.unravel_index(int(trail[-1].argmax()), best.shape)
    path = [(int(i), int(j))]
    for score in reversed(trail[:-1]):
        lo = np.maximum(np.array(path[-1]) - reach, 0)
        window = score[lo[0] : path[-1][0] + reach[0] + 1, lo[1] : path[-1][1] + reach[1] + 1]
        di, dj = np.unravel_index(int(window.argmax()), window.shape)
        path.append((int(lo[0] + di), int(lo[1] + dj)))
    raw = np.array(path[::-1], dtype=float)
    return ndimage.gaussian_filter1d(raw, 20.0 / spacing[2], axis=0, mode="nearest")


def _too_far_front(work: Volume) -> Array:
    """Penalty, 0 in the back 55 % of the body to 0.8 at its front, where sternum and ribs are bright too."""
    body = work.hu > -300
    depth = np.flatnonzero(body.any(axis=(0, 2)))
    if depth.size == 0:
        return np.zeros(work.grid.shape, dtype=np.float32)
    fraction = (np.arange(work.grid.shape[1]) - depth[0]) / max(depth[-1] - depth[0], 1)
    penalty = 0.8 * np.clip((fraction - 0.55) / 0.45, 0, 1)
    return np.broadcast_to(penalty.astype(np.float32)[None, :, None], work.grid.shape)


def _around(path: Array, work: Volume, slices: Array) -> Array:
    """Box about the column in every slice: to both rib heads, to the front of the bodies, to the processes."""
    region = np.zeros(work.grid.shape, dtype=bool)
    sx, sy, _ = work.grid.spacing
    i, j = np.arange(work.grid.shape[0]), np.arange(work.grid.shape[1])
    for (ci, cj), k in zip(path, slices, strict=True):
        side = np.abs(i - ci) * sx <= REACH_R_MM
        ahead = (j - cj) * sy
        region[:, :, k] = side[:, None] & ((ahead <= REACH_FRONT_MM) & (ahead >= -REACH_BACK_MM))[None, :]
    return region


def _joined_to_column(bone: Array, path: Array, slices: Array, spacing: Array) -> Array:
    """Bone that hangs together with the column's core; loose specks are dropped."""
    core = np.zeros_like(bone)
    i, j = np.ogrid[: bone.shape[0], : bone.shape[1]]
    for (ci, cj), k in zip(path, slices, strict=True):
        core[:, :, k] = ((i - ci) * spacing[0]) ** 2 + ((j - cj) * spacing[1]) ** 2 <= BODY_RADIUS_MM**2
    labels, count = ndimage.label(bone, np.ones((3, 3, 3), dtype=bool))
    if count == 0:
        return bone.copy()
    hits = np.bincount(labels[core & bone], minlength=count + 1)
    sizes = np.bincount(labels.ravel(), minlength=count + 1) * spacing.prod()
    keep = (hits > 0) & (sizes > 500.0)
    keep[0] = False
    return keep[labels]
