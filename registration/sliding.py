"""Registration of a lung that slides along its wall: led by keypoints inside it, masked from what lies around.

Ref: Wu 2008; Alvarez 2021, section 6.1.4 (the masked images); Polzin 2013 (keypoints before images).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from math import ceil, log2

import numpy as np

from registration.correspondences import Correspondences
from registration.ffd import FfdFit, FfdSettings, Weights, register_ffd
from registration.images.morphology import bounding_box, dilate
from registration.images.resample import coarsen, resample, resample_mask
from registration.keypoints.matching import MatchSettings, match_keypoints
from registration.maps.composite import dense_field
from registration.maps.field import PointMap
from registration.maps.rigid import RigidTransform
from registration.volume import Array, Mask, Volume

OUTSIDE_HU = -1100.0
BEYOND_MM = 5.0
LEADING_MM = 32.0
"""Finest control spacing that keypoints lead alone; the finer levels, and this one once more, correct the first map."""
SOFTER = 1 / 3
"""Share of the bending weight that these keep where many keypoints are matched: what they correct is small then."""
AROUND_MM = 20.0
"""What is kept around the lungs: more than they are dilated by, and more than voxels are blurred by."""
FAR_MM, NEAR_MM = 24.0, 8.0
"""How far along each axis keypoints are looked for about the prior, and about the first map."""
RESIDUAL = 0.3
"""Relative residual to which their steps are solved: closer takes longer and ends no nearer."""
HOLD = 0.5
"""Share of their weight that keypoints keep at the finest levels, where images are nearer than half a voxel."""
ENOUGH = 900
"""Fewer matches hold less: the errors of each weigh more in their mean."""
LEAST_MATCHES = 20
"""Fewer matches than this may all be chance."""


@dataclass(frozen=True)
class LungImage:
    """An image and the lung in it. seen: the scanner's field of view, None for all of the image."""

    volume: Volume
    lung: Mask
    seen: Mask | None = None

    def near(self, margin_mm: float) -> LungImage:
        """The slices about the lung."""
        cut = bounding_box(self.lung.inside, np.ceil(margin_mm / self.lung.grid.spacing).astype(int))
        seen = None if self.seen is None else self.seen.part(cut)
        return LungImage(self.volume.part(cut), self.lung.part(cut), seen)

    def seen_of(self, region: Array) -> Mask:
        """What the scanner saw of a region given by voxels (ni, nj, nk)."""
        inside = region if self.seen is None else region & self.seen.inside
        return Mask(inside, self.volume.ras_from_ijk)


@dataclass(frozen=True)
class SlidingFit(FfdFit):
    """A free-form deformation, and how it began. matched: keypoints matched about the prior, 0 for too few; moved_mm:
    how far 95 % of them moved against it, infinite for too few; coarse: whether the coarse levels ran.
    """

    matched: int
    moved_mm: float
    coarse: bool


def register_sliding(
    fixed: LungImage,
    moving: LungImage,
    settings: FfdSettings,
    prior: PointMap | None = None,
    *,
    coarse_beyond_mm: float = -1.0,
    progress: Callable[[str, float], None] | None = None,
) -> SlidingFit:
    """Free-form deformation of a lung alone, whatever its wall does.

    prior: any map of points, fixed to moving (default identity). Both images are set to -1100 HU outside their
    lungs and compared inside the fixed lung dilated by 5 mm, so the wall is met and nothing outside can pull. A
    smooth wall looks alike wherever it has slid to, and vessels look alike when the map starts far off, so
    keypoints inside the lung are matched first, up to 24 mm off the prior, and lead the coarse levels, down to a
    control spacing of 32 mm; matched again under that map, they hold the finest, and where there are many these
    bend more easily. coarse_beyond_mm: the coarse levels are left out where 95 % of the keypoints moved by no more
    than that against the prior; those matches then hold the finest.
    """
    fixed, moving = fixed.near(AROUND_MM), moving.near(AROUND_MM)
    images = masked(fixed.volume, fixed.lung), masked(moving.volume, moving.lung)
    start = prior or RigidTransform.identity()
    finer = max(ceil(log2(LEADING_MM / settings.spacing_mm)), 1)
    coarse = replace(
        settings,
        spacing_mm=settings.spacing_mm * 2**finer,
        voxel_mm=1.5 * settings.voxel_mm,
        levels=max(settings.levels - finer, 1),
    )
    voxel = settings.voxel_mm
    inner = LungImage(coarsen(fixed.volume, voxel), fixed.seen_of(fixed.lung.inside))
    match = partial(_match, inner, LungImage(coarsen(moving.volume, voxel), moving.lung), voxel)
    register = partial(register_ffd, *images, fixed_mask=beyond_the_wall(fixed), progress=progress)
    first, matches = start, match(start, FAR_MM)
    matched, moved = 0 if matches is None else len(matches), moved_mm(matches, start)
    is_far = moved > coarse_beyond_mm
    if is_far:
        first = register(settings=coarse, prior=start, matches=matches).moving_from_fixed
        matches = match(first, NEAR_MM)
    weights = finest_weights(settings.weights, 0 if matches is None else len(matches))
    finest = replace(settings, levels=min(settings.levels, finer + 1), weights=weights, residual=RESIDUAL)
    fit = register(settings=finest, prior=first, matches=matches)
    found = {f.name: getattr(fit, f.name) for f in fields(fit)}
    return SlidingFit(**found, matched=matched, moved_mm=moved, coarse=is_far)


def finest_weights(weights: Weights, matches: int) -> Weights:
    """Weights of the finest levels: the more keypoints were matched, up to `ENOUGH`, the more they hold and the less
    bending costs.
    """
    detail = min(matches / ENOUGH, 1.0)
    bending = (1 - detail + detail * SOFTER) * weights.bending
    return replace(weights, bending=bending, keypoints=HOLD * detail * weights.keypoints)


def moved_mm(matches: Correspondences | None, prior: PointMap) -> float:
    """How far 95 % of the matches moved by at most against a prior map, mm; infinite without matches."""
    if matches is None:
        return float("inf")
    return float(np.percentile(np.linalg.norm(matches.moving - prior(matches.fixed), axis=1), 95))


def _match(
    fixed: LungImage, moving: LungImage, voxel_mm: float, prior: PointMap, reach_mm: float
) -> Correspondences | None:
    """Keypoints inside both lungs, matched at most `reach_mm` from where `prior` puts them; None for too few.

    Of either image the volume has voxels of `voxel_mm`; its lung's may be finer.
    """
    grid = fixed.volume.grid
    dense = dense_field(prior, grid)
    matches = match_keypoints(
        fixed.volume,
        resample(moving.volume, grid, dense),
        resample_mask(fixed.lung, grid),
        MatchSettings(voxel_mm=voxel_mm, reach_mm=reach_mm),
        moving_region=resample_mask(moving.lung, grid, dense),
    )
    return None if len(matches) < LEAST_MATCHES else matches.mapped(moving=prior)


def masked(volume: Volume, lung: Mask) -> Volume:
    """`volume` with -1100 HU, below every tissue, outside the lung; both on the same grid."""
    if not volume.grid.same_as(lung.grid):
        raise ValueError(f"the lung mask must lie on the image's grid: {lung!r} against {volume!r}; resample it first")
    hu = np.where(lung.inside, np.maximum(volume.hu, np.float32(-1000)), np.float32(OUTSIDE_HU))
    return Volume(hu.astype(np.float32), volume.ras_from_ijk)


def beyond_the_wall(image: LungImage) -> Mask:
    """What is compared: the lung dilated by 5 mm, so that its wall is met, as far as the scanner saw it."""
    return image.seen_of(dilate(image.lung.inside, BEYOND_MM, image.lung.grid.spacing))
