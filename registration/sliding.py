"""Registration of a lung that slides along its wall: whole or depth alone first, then masked from what lies around.

Ref: Wu 2008; Alvarez 2021, section 6.1.4 (the masked images); the order is our own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from registration.ffd import FfdFit, FfdSettings, chosen_metric, register_ffd
from registration.field import PointMap
from registration.interpolate import interpolate
from registration.nearby import bounding_box, grown, near
from registration.pyramid import Images, Pyramid
from registration.resample import coarsen, coarsen_mask, resample_mask
from registration.volume import Cut, Mask, Volume

COARSE_STEPS = 100
OUTSIDE_HU = -1100.0
BEYOND_MM = 5.0
LAST_LEVELS = 2
AROUND_MM = 20.0
"""What is kept around the lungs: more than they grow by, and more than voxels are blurred by."""
REACH_MM = 50.0
"""How far from the moving lung the first registrations may look."""
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
    cut = _around(fixed_lung, AROUND_MM)
    fixed, fixed_lung = fixed.part(cut), fixed_lung.part(cut)
    seen = None if seen is None else seen.part(cut)
    prior = _first(fixed, moving.part(_around(moving_lung, REACH_MM)), fixed_lung, settings, seen, prior, progress)
    cut = _around(moving_lung, AROUND_MM)
    region = grown(fixed_lung, BEYOND_MM)
    if seen is not None:
        region = Mask(region.inside & seen.inside, region.ras_from_ijk)
    return register_ffd(
        masked(fixed, fixed_lung),
        masked(moving.part(cut), moving_lung.part(cut)),
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


def _first(
    fixed: Volume,
    moving: Volume,
    lung: Mask,
    settings: FfdSettings,
    seen: Mask | None,
    prior: PointMap | None,
    progress: Callable[[str, float], None] | None,
) -> PointMap | None:
    """Map found on coarser voxels by the whole lung or by its depth; the prior where nothing lies so deep.

    Both are found up to twice the finest spacing, and the one under which the depth looks more alike goes on to it.
    """
    settings = replace(settings, voxel_mm=1.5 * settings.voxel_mm)
    fixed, moving = coarsen(fixed, settings.voxel_mm), coarsen(moving, settings.voxel_mm)
    inside = coarsen_mask(lung, settings.voxel_mm).hu >= 0.5
    shown = np.ones_like(inside) if seen is None else coarsen_mask(seen, settings.voxel_mm).hu >= 0.5
    # Where the scanner's view ends there is no wall, so the depth counts from what it shows outside the lung.
    bare = near(~inside & shown, DEEP_MM, fixed.grid.spacing)
    whole, deep = (Mask(region & shown, fixed.ras_from_ijk) for region in (inside, inside & ~bare))
    if not deep.inside.any():
        return prior
    levels = max(settings.levels - 1, 1)
    coarse = replace(settings, spacing_mm=2 * settings.spacing_mm, levels=levels, steps=COARSE_STEPS)
    samples = Pyramid(fixed, deep, moving, None, settings.voxel_mm).at(settings.voxel_mm)
    found = []
    for region in (whole, deep):
        fit = register_ffd(fixed, moving, coarse, fixed_mask=region, prior=prior, progress=progress).moving_from_fixed
        found.append((_unlikeness(samples, fit, settings), region, fit.field.refined()))
    _, region, start = min(found, key=lambda candidate: candidate[0])
    fine = replace(settings, levels=1)
    return register_ffd(
        fixed, moving, fine, fixed_mask=region, prior=prior, start=start, progress=progress
    ).moving_from_fixed


def _unlikeness(images: Images, found: PointMap, settings: FfdSettings) -> float:
    """Dissimilarity of the samples under a map."""
    m = interpolate(images.moving.hu, images.moving.grid, found(images.samples.points()), OUTSIDE_HU)
    weights = np.ones(len(m), dtype=np.float32)
    return chosen_metric(images, settings).evaluate(m, weights).value


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


def _around(lung: Mask, margin_mm: float) -> Cut:
    """Slices about a lung."""
    return bounding_box(lung.inside, np.ceil(margin_mm / lung.grid.spacing).astype(int))
