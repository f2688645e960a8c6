"""Free-form deformation: a B-spline field added to a prior map, from coarse to fine.

Ref: Rueckert 1999; Alvarez 2021, section 6.1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from registration.bspline import BSplineField, control_grid
from registration.field import DisplacementField, PointMap, sample_map
from registration.metric import GlobalNcc, LocalNcc
from registration.newton import Stop, gauss_newton
from registration.objective import Objective, Term
from registration.penalties import Bending, Departure, Folding, Keypoints, Matches
from registration.resample import coarsen, coarsen_mask
from registration.rigid import RigidTransform
from registration.similarity import ImageTerm, Metric, Samples
from registration.volume import Array, Grid, Mask, Volume

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Weights:
    """Strength of each term beside the dissimilarity, which runs from 0 to 2.

    bending: mm^2; prior (mean squared departure), keypoints: 1/mm^2; folding: of the barrier, no unit.
    """

    bending: float = 300.0
    prior: float = 0.0
    keypoints: float = 0.01
    folding: float = 1.0


@dataclass(frozen=True)
class FfdSettings:
    """How `register_ffd` works.

    spacing_mm: finest control spacing; levels: each coarser one doubles it; voxel_mm: finest image voxels;
    window_mm: edge of the local correlation's window, None for one correlation over all samples;
    noise_hu: standard deviation below which a window counts as noise; mass_preserving: lung HU follows the volume;
    weights: see `Weights`; steps: Gauss-Newton steps per level at most.
    """

    spacing_mm: float = 16.0
    levels: int = 4
    voxel_mm: float = 2.0
    window_mm: float | None = 14.0
    noise_hu: float = 20.0
    mass_preserving: bool = False
    weights: Weights = field(default_factory=Weights)
    steps: int = 15


@dataclass(frozen=True)
class CorrectedMap:
    """x -> prior(x) + u(x): a B-spline displacement added to a prior map."""

    prior: PointMap
    field: BSplineField

    def __call__(self, points_ras: Array) -> Array:
        """Images (n, 3) of points (n, 3) in RAS mm."""
        return self.prior(points_ras) + self.field.displacement(points_ras)

    def dense(self, grid: Grid) -> DisplacementField:
        """The whole map on the voxels of a grid parallel to the control grid."""
        u = self.field.dense(grid).vectors
        return DisplacementField(sample_map(self.prior, grid).vectors + u, grid.ras_from_ijk)


@dataclass(frozen=True)
class FfdFit:
    """moving_from_fixed: the map found; status: why the finest level stopped; history: objective per step and level;
    min_det: least det of its gradient on the voxels compared; folded_share: share of voxels with det <= 0."""

    moving_from_fixed: CorrectedMap
    status: Stop
    history: tuple[tuple[float, ...], ...]
    min_det: float
    folded_share: float


def register_ffd(
    fixed: Volume,
    moving: Volume,
    settings: FfdSettings,
    *,
    fixed_mask: Mask | None = None,
    moving_mask: Mask | None = None,
    prior: PointMap | None = None,
    keypoints: Keypoints | None = None,
    progress: Progress | None = None,
) -> FfdFit:
    """Find the smooth correction u of a prior map so that moving(prior(x) + u(x)) looks like fixed(x).

    fixed_mask: where images are compared (default everywhere); moving_mask: what the moving image sees (samples that
    map outside lose their weight); prior: any map of points, fixed to moving (default identity); the bending energy is
    that of u alone, so it also holds the result to the prior.
    """
    prior = prior or RigidTransform.identity()
    fixed_mask = fixed_mask or Mask(np.ones(fixed.hu.shape, dtype=bool), fixed.ras_from_ijk)
    fixed, fixed_mask = _cropped(fixed, fixed_mask)
    spline: BSplineField | None = None
    histories, stop = [], Stop.ITERATIONS
    pyramid = _Pyramid(fixed, fixed_mask, moving, moving_mask)
    for level in range(settings.levels):
        spacing = settings.spacing_mm * 2 ** (settings.levels - 1 - level)
        voxel = min(max(settings.voxel_mm, spacing / 8), 8.0)
        if progress is not None:
            progress(f"free-form deformation, {spacing:.0f} mm grid", level / settings.levels)
        images = pyramid.at(voxel)
        spline = _started(spline, fixed.grid, settings, level)
        objective, image = _objective(images, settings, voxel, spline.control, prior, keypoints)
        start = np.moveaxis(spline.coefficients, 3, 0)
        descent = gauss_newton(objective, start, settings.steps, refresh=image.refresh)
        histories.append(descent.history)
        stop = descent.stop
        spline = BSplineField(np.moveaxis(descent.coefficients, 0, 3).astype(float), spline.ras_from_ijk)
    assert spline is not None
    result = CorrectedMap(prior, spline)
    det = result.dense(images.samples.grid).jacobian_determinant().reshape(-1)[images.samples.index]
    return FfdFit(result, stop, tuple(histories), float(det.min()), float(np.mean(det <= 0)))


@dataclass(frozen=True)
class _Images:
    """One level: fixed values at the samples, the moving image, and where that sees."""

    samples: Samples
    fixed: Array
    moving: Volume
    seen: Volume | None


class _Pyramid:
    """Images coarsened to a voxel size."""

    def __init__(self, fixed: Volume, fixed_mask: Mask, moving: Volume, moving_mask: Mask | None) -> None:
        self._fixed, self._fixed_mask, self._moving, self._moving_mask = fixed, fixed_mask, moving, moving_mask

    def at(self, voxel_mm: float) -> _Images:
        fixed = coarsen(self._fixed, voxel_mm)
        share = coarsen_mask(self._fixed_mask, voxel_mm)
        index = np.flatnonzero(share.hu >= 0.5)
        moving = coarsen(self._moving, voxel_mm)
        seen = None if self._moving_mask is None else coarsen_mask(self._moving_mask, voxel_mm)
        return _Images(Samples(fixed.grid, index), fixed.hu.reshape(-1)[index], moving, seen)


def _objective(
    images: _Images,
    settings: FfdSettings,
    voxel_mm: float,
    control: Grid,
    prior: PointMap,
    keypoints: Keypoints | None,
) -> tuple[Objective, ImageTerm]:
    weights = settings.weights
    metric = _metric(images, settings, voxel_mm)
    image = ImageTerm(
        images.samples, metric, images.moving, prior, control, images.seen, mass_preserving=settings.mass_preserving
    )
    blocks, _ = images.samples.blocks()
    terms: list[Term] = [image, Bending(control, weights.bending), Folding(control, blocks, prior, weights.folding)]
    if weights.prior > 0:
        terms.append(Departure(control, blocks, weights.prior))
    if keypoints is not None:
        terms.append(Matches(control, keypoints, prior, weights.keypoints))
    return Objective(terms), image


def _metric(images: _Images, settings: FfdSettings, voxel_mm: float) -> Metric:
    if settings.window_mm is None:
        return GlobalNcc(images.fixed)
    radius = max(round(settings.window_mm / voxel_mm / 2), 2)
    return LocalNcc(images.fixed, images.samples.index, images.samples.grid.shape, radius, settings.noise_hu)


def _started(spline: BSplineField | None, grid: Grid, settings: FfdSettings, level: int) -> BSplineField:
    """Zero at the first level, the refined result of the one before at the others."""
    if spline is not None:
        return spline.refined()
    control = control_grid(grid, settings.spacing_mm * 2 ** (settings.levels - 1 - level))
    return BSplineField(np.zeros((*control.shape, 3)), control.ras_from_ijk)


def _cropped(fixed: Volume, mask: Mask, margin_mm: float = 8.0) -> tuple[Volume, Mask]:
    """Both restricted to the mask's bounding box and a margin."""
    where = np.argwhere(mask.inside)
    if len(where) == 0:
        raise ValueError("the fixed mask is empty; nothing to register, check the segmentation")
    margin = margin_mm / fixed.grid.spacing
    box = fixed.grid.box(where.min(axis=0) - margin, where.max(axis=0) + 1 + margin)
    lo = np.rint(fixed.grid.to_ijk(box.ras_from_ijk[:3, 3])).astype(int)
    cut = tuple(slice(a, a + n) for a, n in zip(lo, box.shape, strict=True))
    return Volume(fixed.hu[cut], box.ras_from_ijk), Mask(mask.inside[cut], box.ras_from_ijk)
