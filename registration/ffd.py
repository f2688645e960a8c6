"""Free-form deformation: a B-spline field added to a prior map, from coarse to fine.

Ref: Rueckert 1999; Alvarez 2021, section 6.1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from registration.correspondences import Correspondences
from registration.images.pyramid import Pyramid, PyramidLevel, cropped
from registration.maps.bspline import BSplineField, control_grid
from registration.maps.composite import CompositeTransform, dense_field
from registration.maps.field import DisplacementField, PointMap
from registration.maps.rigid import RigidTransform
from registration.terms.gauss_newton import Descent, Stop, gauss_newton
from registration.terms.image_term import ImageTerm
from registration.terms.metrics import GlobalNcc, LocalNcc, Metric
from registration.terms.objective import Objective, Term
from registration.terms.penalties import Bending, CorrespondingPoints, Folding
from registration.volume import Array, Grid, Mask, Volume

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Weights:
    """Strength of each term beside the dissimilarity, which runs from 0 to 2.

    bending: mm^2; keypoints: of the mean squared distance of correspondences, 1/mm^2; folding: of the barrier, no unit.
    """

    bending: float = 300.0
    keypoints: float = 0.02
    folding: float = 1.0


@dataclass(frozen=True)
class FfdSettings:
    """How `register_ffd` works.

    spacing_mm: finest control spacing; levels: each coarser one doubles it; voxel_mm: finest image voxels;
    window_mm: edge of the local correlation's window, None for one correlation over all samples;
    noise_hu: standard deviation below which a window counts as noise; robust_mm: correspondences that are farther off
    count less; weights: see `Weights`; steps: Gauss-Newton steps per level at most; residual: relative one to which
    each is solved; metric: another dissimilarity than these correlations, made from the samples of a level.
    """

    spacing_mm: float = 16.0
    levels: int = 4
    voxel_mm: float = 2.0
    window_mm: float | None = 14.0
    noise_hu: float = 20.0
    robust_mm: float = 4.0
    weights: Weights = field(default_factory=Weights)
    steps: int = 30
    residual: float = 0.1
    metric: Callable[[PyramidLevel], Metric] | None = None


@dataclass(frozen=True)
class FfdFit:
    """moving_from_fixed: the map found; status: why the finest level stopped; history: objective per step and level;
    min_det, folded_share: least det of the map's gradient on the finest voxels, and share of them with det <= 0;
    shrunk: factor by which the correction had to be scaled so that nothing folds (1: not at all)."""

    moving_from_fixed: CompositeTransform
    status: Stop
    history: tuple[tuple[float, ...], ...]
    min_det: float
    folded_share: float
    shrunk: float


@dataclass(frozen=True)
class _Problem:
    """What stays the same over the levels."""

    settings: FfdSettings
    prior: PointMap
    matches: Correspondences | None

    def points_terms(self, control: Grid) -> list[Term]:
        """The term of the correspondences, where there are any."""
        if self.matches is None:
            return []
        weight = self.settings.weights.keypoints
        return [CorrespondingPoints(control, self.matches, self.prior, weight, self.settings.robust_mm)]


def register_ffd(
    fixed: Volume,
    moving: Volume,
    settings: FfdSettings,
    *,
    fixed_mask: Mask | None = None,
    moving_mask: Mask | None = None,
    prior: PointMap | None = None,
    matches: Correspondences | None = None,
    progress: Progress | None = None,
) -> FfdFit:
    """Find the smooth correction u of a prior map so that moving(prior(x) + u(x)) looks like fixed(x).

    fixed_mask: where images are compared (default everywhere); moving_mask: what the moving image sees (samples that
    map outside lose their weight); prior: any map of points, fixed to moving (default identity); the bending energy is
    that of u alone, so it also holds the result to the prior; matches: correspondences, from whose spline the coarsest
    level starts.
    A barrier keeps det(dT/dx) > 0 at every level; if voxels fold all the same, the last level is repeated with a
    stronger one, and at last u is scaled down until none does.
    """
    problem = _Problem(settings, prior or RigidTransform.identity(), matches)
    fixed_mask = fixed_mask or Mask(np.ones(fixed.hu.shape, dtype=bool), fixed.ras_from_ijk)
    fixed, fixed_mask = cropped(fixed, fixed_mask)
    pyramid = Pyramid(fixed, fixed_mask, moving, moving_mask, settings.voxel_mm)
    spline, histories = _first(problem, fixed.grid), []
    for level in range(settings.levels):
        if level > 0:
            spline = spline.refined()
        spacing = settings.spacing_mm * 2 ** (settings.levels - 1 - level)
        if progress is not None:
            progress(f"free-form deformation, {spacing:.0f} mm grid", level / settings.levels)
        images = pyramid.at(min(max(settings.voxel_mm, spacing / 8), 8.0))
        spline, descent = _level(problem, images, spline)
        histories.append(descent.history)
    whole = _WholeMap(problem.prior, images.samples.grid)
    for _ in range(2):
        if whole.det(spline).min() > 0:
            break
        problem = replace(problem, settings=_stiffer(problem.settings))
        spline, descent = _level(problem, images, spline)
        histories.append(descent.history)
    spline, shrunk, det = whole.unfolded(spline)
    found = CompositeTransform(problem.prior, spline)
    return FfdFit(found, descent.stop, tuple(histories), float(det.min()), float(np.mean(det <= 0)), shrunk)


def _first(problem: _Problem, grid: Grid) -> BSplineField:
    """Coarsest spline: zero, or the one that fits the correspondences."""
    settings = problem.settings
    control = control_grid(grid, settings.spacing_mm * 2 ** (settings.levels - 1))
    c = np.zeros((3, *control.shape), dtype=np.float32)
    if points := problem.points_terms(control):
        c = gauss_newton(Objective([*points, Bending(control, settings.weights.bending)]), c, 30).coefficients
    return BSplineField(np.moveaxis(c, 0, 3).astype(float), control.ras_from_ijk)


def _level(problem: _Problem, images: PyramidLevel, spline: BSplineField) -> tuple[BSplineField, Descent]:
    """One level of Gauss-Newton steps."""
    weights, control, prior = problem.settings.weights, spline.control, problem.prior
    metric = chosen_metric(images, problem.settings)
    image = ImageTerm(images.samples, metric, images.moving, prior, control, images.seen)
    blocks, _ = images.samples.blocks()
    terms: list[Term] = [image, Bending(control, weights.bending), Folding(control, blocks, prior, weights.folding)]
    terms += problem.points_terms(control)
    start = np.moveaxis(spline.coefficients, 3, 0)
    settings = problem.settings
    descent = gauss_newton(Objective(terms), start, settings.steps, residual=settings.residual, refresh=image.refresh)
    return BSplineField(np.moveaxis(descent.coefficients, 0, 3).astype(float), spline.ras_from_ijk), descent


def chosen_metric(images: PyramidLevel, settings: FfdSettings) -> Metric:
    """The dissimilarity that the settings ask for, on the samples of one level."""
    if settings.metric is not None:
        return settings.metric(images)
    if settings.window_mm is None:
        return GlobalNcc(images.fixed)
    grid = images.samples.grid
    radius = max(round(settings.window_mm / float(grid.spacing.max()) / 2), 2)
    return LocalNcc(images.fixed, images.samples.index, grid.shape, radius, settings.noise_hu)


def _stiffer(settings: FfdSettings) -> FfdSettings:
    return replace(settings, weights=replace(settings.weights, folding=100 * settings.weights.folding))


class _WholeMap:
    """The whole map P + u on the finest voxels."""

    def __init__(self, prior: PointMap, grid: Grid) -> None:
        self._grid, self._prior = grid, dense_field(prior, grid).vectors

    def det(self, spline: BSplineField) -> Array:
        """det of its gradient, (ni, nj, nk)."""
        vectors = self._prior + spline.dense(self._grid).vectors
        return DisplacementField(vectors, self._grid.ras_from_ijk).jacobian_determinant()

    def unfolded(self, spline: BSplineField) -> tuple[BSplineField, float, Array]:
        """The spline scaled by the largest of 1, 0.9, 0.81, ... that folds no voxel, that factor, and det."""
        scale, scaled = 1.0, spline
        while (det := self.det(scaled)).min() <= 0 and scale > 0.01:
            scale *= 0.9
            scaled = BSplineField(scale * spline.coefficients, spline.ras_from_ijk)
        return scaled, scale, det
