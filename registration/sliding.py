"""Registration of a lung that slides along its wall: led by places inside it, masked from what lies around.

Ref: Wu 2008; Alvarez 2021, section 6.1.4 (the masked images); Polzin 2013 (places found again before the images).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from math import ceil, log2

import numpy as np

from registration.ffd import FfdFit, FfdSettings, Weights, register_ffd
from registration.images.morphology import bounding_box, grown
from registration.images.resample import coarsen, resample, resample_mask
from registration.keypoints.matching import MatchSettings, match_keypoints
from registration.maps.composite import on_grid
from registration.maps.field import PointMap
from registration.maps.rigid import RigidTransform
from registration.terms.penalties import Keypoints
from registration.volume import Cut, Mask, Volume

OUTSIDE_HU = -1100.0
BEYOND_MM = 5.0
LEADING_MM = 32.0
"""Finest control spacing that places lead alone; the finer levels, and this one once more, correct the first map."""
SOFTER = 1 / 3
"""Share of the bending weight that these keep where many places are found: what they correct is small then."""
AROUND_MM = 20.0
"""What is kept around the lungs: more than they grow by, and more than voxels are blurred by."""
FAR_MM, NEAR_MM = 24.0, 8.0
"""How far along each axis places are looked for about the prior, and about the first map."""
ROUGHLY = 0.3
"""Relative residual to which their steps are solved: closer takes longer and ends no nearer."""
HOLD = 0.5
"""Share of their weight that places keep at the finest levels, where images are nearer than half a voxel."""
ENOUGH = 900
"""Fewer places hold less: the errors of each weigh more in their mean."""
LEAST_PAIRS = 20
"""Fewer pairs than this may all be chance."""


def register_sliding(
    fixed: Volume,
    moving: Volume,
    moving_lung: Mask,
    settings: FfdSettings,
    *,
    fixed_lung: Mask | None = None,
    seen: Mask | None = None,
    prior: PointMap | None = None,
    is_far: Callable[[Keypoints | None], bool] | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> FfdFit:
    """Free-form deformation of a lung alone, whatever its wall does.

    fixed_lung: the lung in the fixed image; without it, a first registration with the metric inside the moving lung
    (placed by `prior`) carries the moving lung over. seen: field of view of the fixed image. Both images are set to
    -1100 HU outside their lungs and compared inside the fixed lung grown by 5 mm, so the wall is met and nothing
    outside can pull. A smooth wall looks alike wherever it has slid to, and vessels look alike when the map starts far
    off, so places inside the lung are found first, up to 24 mm off the prior, and lead the coarse levels, down to a
    control spacing of 32 mm; found again under that map, they hold the finest, and where there are many these bend more
    easily. is_far: told the places found about the prior, says whether the coarse levels are needed (default always);
    without them those places hold the finest.
    """
    if fixed_lung is None:
        fixed_lung = _carried(fixed, moving, moving_lung, settings, seen, prior)
    cut = _around(fixed_lung, AROUND_MM)
    fixed, fixed_lung = fixed.part(cut), fixed_lung.part(cut)
    seen = Mask(np.ones_like(fixed_lung.inside), fixed_lung.ras_from_ijk) if seen is None else seen.part(cut)
    cut = _around(moving_lung, AROUND_MM)
    moving, moving_lung = moving.part(cut), moving_lung.part(cut)
    region = Mask(grown(fixed_lung, BEYOND_MM).inside & seen.inside, fixed.ras_from_ijk)
    inner = Mask(fixed_lung.inside & seen.inside, fixed.ras_from_ijk)
    images = masked(fixed, fixed_lung), masked(moving, moving_lung)
    start = prior or RigidTransform.identity()
    finer = max(ceil(log2(LEADING_MM / settings.spacing_mm)), 1)
    coarse = replace(
        settings,
        spacing_mm=settings.spacing_mm * 2**finer,
        voxel_mm=1.5 * settings.voxel_mm,
        levels=max(settings.levels - finer, 1),
    )
    voxel = settings.voxel_mm
    found = partial(_found_again, coarsen(fixed, voxel), coarsen(moving, voxel), inner, moving_lung, voxel)
    register = partial(register_ffd, *images, fixed_mask=region, progress=progress)
    first, holding = start, found(start, FAR_MM)
    if is_far is None or is_far(holding):
        first = register(settings=coarse, prior=start, keypoints=holding).moving_from_fixed
        holding = found(first, NEAR_MM)
    held = finest_weights(settings.weights, 0 if holding is None else len(holding.fixed))
    finest = replace(settings, levels=min(settings.levels, finer + 1), weights=held, residual=ROUGHLY)
    return register(settings=finest, prior=first, keypoints=holding)


def finest_weights(weights: Weights, places: int) -> Weights:
    """Weights of the finest levels: the more places were found, up to `ENOUGH`, the more they hold and the less bending
    costs."""
    detail = min(places / ENOUGH, 1.0)
    bending = (1 - detail + detail * SOFTER) * weights.bending
    return replace(weights, bending=bending, keypoints=HOLD * detail * weights.keypoints)


def _found_again(
    fixed: Volume,
    moving: Volume,
    fixed_lung: Mask,
    moving_lung: Mask,
    voxel_mm: float,
    prior: PointMap,
    reach_mm: float,
) -> Keypoints | None:
    """Places inside both lungs that both images show, at most `reach_mm` from where `prior` puts them; None for too
    few.
    """
    dense = on_grid(prior, fixed.grid)
    pairs = match_keypoints(
        resample(moving, fixed.grid, dense),
        fixed,
        resample_mask(fixed_lung, fixed.grid),
        MatchSettings(voxel_mm=voxel_mm, reach_mm=reach_mm),
        first_region=resample_mask(moving_lung, fixed.grid, dense),
    )
    return None if len(pairs) < LEAST_PAIRS else Keypoints(pairs.second, prior(pairs.first), np.ones(len(pairs)))


def masked(volume: Volume, lung: Mask) -> Volume:
    """`volume` with -1100 HU, below every tissue, outside the lung; both on the same grid."""
    if not volume.grid.same_as(lung.grid):
        raise ValueError(f"the lung mask must lie on the image's grid: {lung!r} against {volume!r}; resample it first")
    hu = np.where(lung.inside, np.maximum(volume.hu, np.float32(-1000)), np.float32(OUTSIDE_HU))
    return Volume(hu.astype(np.float32), volume.ras_from_ijk)


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
