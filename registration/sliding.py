"""Registration of a lung that slides along its wall: whole or depth alone first, then masked from what lies around.

Ref: Wu 2008; Alvarez 2021, section 6.1.4 (the masked images); the order is our own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy import ndimage

from registration.ffd import FfdFit, FfdSettings, chosen_metric, register_ffd
from registration.field import PointMap
from registration.interpolate import interpolate
from registration.pyramid import Images, Pyramid
from registration.resample import coarsen, coarsen_mask, resample_mask
from registration.volume import Array, Mask, Volume

OUTSIDE_HU = -1100.0
BEYOND_MM = 5.0
LAST_LEVELS = 2
DEEP_MM = 8.0
"""Nearer to the wall than this a lung shows hardly any vessel, but the wall itself, which slides."""


def register_sliding(
    fixed: Volume,
    moving: Volume,
    moving_lung: Mask,
    settings: FfdSettings,
    *,
    fixed_lung: Mask | None = None,
    seen: Mask | None = None,
    prior: PointMap | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> FfdFit:
    """Free-form deformation of a lung alone, whatever its wall does.

    fixed_lung: the lung in the fixed image; without it, a first registration with the metric inside the moving lung
    (placed by `prior`) carries the moving lung over. seen: field of view of the fixed image. A smooth wall looks alike
    wherever it has slid to, so it can hold the coarse levels at the prior; without it the depth can run away. Hence two
    first registrations, of the whole lung and of what lies deeper than 8 mm, and the one under which the depth looks
    more alike is kept. Then both images are set to -1100 HU outside their lungs and compared inside the fixed lung
    grown by 5 mm at the two finest levels, so the wall is met and nothing outside can pull.
    """
    if fixed_lung is None:
        fixed_lung = _carried(fixed, moving, moving_lung, settings, seen, prior)
    prior = _first(fixed, moving, fixed_lung, settings, seen, prior, progress)
    region = grown(fixed_lung, BEYOND_MM)
    if seen is not None:
        region = Mask(region.inside & seen.inside, region.ras_from_ijk)
    return register_ffd(
        masked(fixed, fixed_lung),
        masked(moving, moving_lung),
        replace(settings, levels=min(settings.levels, LAST_LEVELS)),
        fixed_mask=region,
        prior=prior,
        progress=progress,
    )


def masked(volume: Volume, lung: Mask) -> Volume:
    """`volume` with -1100 HU, below every tissue, outside the lung; both on the same grid."""
    if not volume.grid.same_as(lung.grid):
        raise ValueError(f"the lung mask must lie on the image's grid: {lung!r} against {volume!r}; resample it first")
    hu = np.where(lung.inside, np.maximum(volume.hu, np.float32(-1000)), np.float32(OUTSIDE_HU))
    return Volume(hu.astype(np.float32), volume.ras_from_ijk)


def grown(mask: Mask, distance_mm: float) -> Mask:
    """Every voxel within `distance_mm` of the mask."""
    if not mask.inside.any():
        raise ValueError("the lung mask is empty; check the segmentation")
    inside = mask.inside.copy()
    cut = _box(mask.inside, np.ceil(distance_mm / mask.grid.spacing).astype(int))
    inside[cut] = ndimage.distance_transform_edt(~mask.inside[cut], sampling=mask.grid.spacing) <= distance_mm
    return Mask(inside, mask.ras_from_ijk)


def _first(
    fixed: Volume,
    moving: Volume,
    lung: Mask,
    settings: FfdSettings,
    seen: Mask | None,
    prior: PointMap | None,
    progress: Callable[[str, float], None] | None,
) -> PointMap | None:
    """Map found on coarser voxels by the whole lung or by its depth, whichever makes the depth look more alike; the
    prior where nothing lies so deep."""
    settings = replace(settings, voxel_mm=1.5 * settings.voxel_mm)
    fixed, moving = coarsen(fixed, settings.voxel_mm), coarsen(moving, settings.voxel_mm)
    inside = coarsen_mask(lung, settings.voxel_mm).hu >= 0.5
    shown = np.ones_like(inside) if seen is None else coarsen_mask(seen, settings.voxel_mm).hu >= 0.5
    # Where the scanner's view ends there is no wall, so the depth counts from what it shows outside the lung.
    depth = ndimage.distance_transform_edt(inside | ~shown, sampling=fixed.grid.spacing)
    whole, deep = (Mask(inside & shown & (depth > least), fixed.ras_from_ijk) for least in (0.0, DEEP_MM))
    if not deep.inside.any():
        return prior
    samples = Pyramid(fixed, deep, moving, None).at(settings.voxel_mm)
    found = [
        register_ffd(fixed, moving, settings, fixed_mask=region, prior=prior, progress=progress).moving_from_fixed
        for region in (whole, deep)
    ]
    return min(found, key=lambda candidate: _unlikeness(samples, candidate, settings))


def _unlikeness(images: Images, found: PointMap, settings: FfdSettings) -> float:
    """Dissimilarity of the samples under a map."""
    m = interpolate(images.moving.hu, images.moving.grid, found(images.samples.points()), OUTSIDE_HU)
    weights = np.ones(len(m), dtype=np.float32)
    return chosen_metric(images, settings).evaluate(m, weights, with_slope=False).value


def _carried(
    fixed: Volume,
    moving: Volume,
    moving_lung: Mask,
    settings: FfdSettings,
    seen: Mask | None,
    prior: PointMap | None,
) -> Mask:
    placed = resample_mask(moving_lung, fixed.grid, prior)
    region = placed if seen is None else Mask(placed.inside & seen.inside, placed.ras_from_ijk)
    first = register_ffd(fixed, moving, settings, fixed_mask=region, prior=prior)
    return resample_mask(moving_lung, fixed.grid, first.moving_from_fixed)


def _box(inside: Array, margin: Array) -> tuple[slice, slice, slice]:
    where = [np.flatnonzero(inside.any(axis=tuple({0, 1, 2} - {m}))) for m in range(3)]
    lo = [max(w[0] - g, 0) for w, g in zip(where, margin, strict=True)]
    hi = [w[-1] + g + 1 for w, g in zip(where, margin, strict=True)]
    return (slice(lo[0], hi[0]), slice(lo[1], hi[1]), slice(lo[2], hi[2]))
