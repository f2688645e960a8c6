"""Free-form deformation: known maps by value and sign, what holds it back, and no folding."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from registration import sliding
from registration.correspondences import Correspondences
from registration.ffd import FfdFit, FfdSettings, Weights, register_ffd
from registration.images.morphology import dilate
from registration.maps.bspline import BSplineField, control_grid
from registration.maps.composite import CompositeTransform
from registration.maps.rigid import RigidTransform
from registration.sliding import LungImage, finest_weights, masked, register_sliding
from registration.terms.gauss_newton import Stop
from registration.volume import Array, Grid, Mask, Volume
from tests.registration.scenes import image_of, make_pattern, oriented

CENTRE = np.array([10.0, -30.0, 120.0])
GRID = oriented("LPS", (40, 38, 36), 2.5, CENTRE)
WIDE = oriented("RAS", (64, 64, 64), 2.5, CENTRE)
PATTERN = make_pattern(4)
INNER = GRID.to_ras(np.random.default_rng(2).uniform(6, 29, (300, 3)))
COARSE = FfdSettings(levels=3, voxel_mm=2.5, weights=Weights(bending=20.0))


def wave(points: Array) -> Array:
    """A smooth map that moves points by up to 6 mm, twists, and shrinks along S."""
    x, y, z = (points - CENTRE).T
    u = np.stack([4 * np.sin(y / 30) + 1, 3 * np.cos(z / 25) - 2, -0.08 * z + 2 * np.sin(x / 35)], axis=1)
    return points + u


def error(got: Array, expected: Array) -> Array:
    return np.asarray(np.linalg.norm(got - expected, axis=1))


@pytest.mark.parametrize("window_mm", [14.0, None])
def test_a_known_map_comes_back(window_mm: float | None) -> None:
    fixed, moving = image_of(lambda p: PATTERN(wave(p)), GRID), image_of(PATTERN, WIDE)
    fit = register_ffd(fixed, moving, replace(COARSE, window_mm=window_mm))
    assert error(INNER, wave(INNER)).mean() > 2.5
    assert error(fit.moving_from_fixed(INNER), wave(INNER)).mean() < 0.15
    assert error(fit.moving_from_fixed(INNER), wave(INNER)).max() < 0.8
    assert fit.folded_share == 0
    assert fit.status in (Stop.CONVERGED, Stop.SMALL_STEP)


def test_it_corrects_a_rigid_prior_through_gain_and_offset() -> None:
    prior = RigidTransform.about(CENTRE, np.array([0.05, 0.1, -0.15]), np.array([20.0, -10.0, 5.0]))
    fixed = image_of(lambda p: 0.7 * PATTERN(prior(wave(p))) + 90, GRID)
    moving = image_of(PATTERN, oriented("RAS", (64, 64, 64), 2.5, prior(CENTRE[None])[0]))
    fit = register_ffd(fixed, moving, COARSE, prior=prior)
    assert error(fit.moving_from_fixed(INNER), prior(wave(INNER))).mean() < 0.2
    dense = fit.moving_from_fixed.dense(GRID)
    assert error(dense(INNER), fit.moving_from_fixed(INNER)).max() < 0.2


def test_the_history_never_rises_within_a_level() -> None:
    fit = register_ffd(image_of(lambda p: PATTERN(wave(p)), GRID), image_of(PATTERN, WIDE), COARSE)
    assert len(fit.history) == 3
    for level in fit.history:
        assert np.all(np.diff(level) < 1e-6)


def test_samples_that_leave_the_moving_view_do_not_pull() -> None:
    """Half of the moving image is unseen and holds rubbish; the seen half must register as if it were not there."""
    moving = image_of(PATTERN, WIDE)
    seen = WIDE.points()[..., 0] < CENTRE[0] + 6
    rubbish = np.where(seen, moving.hu, np.random.default_rng(0).uniform(-1000, 500, WIDE.shape)).astype(np.float32)
    fixed = image_of(lambda p: PATTERN(wave(p)), GRID)
    fit = register_ffd(fixed, Volume(rubbish, WIDE.ras_from_ijk), COARSE, moving_mask=Mask(seen, WIDE.ras_from_ijk))
    far = INNER[INNER[:, 0] < CENTRE[0] - 8]
    assert error(fit.moving_from_fixed(far), wave(far)).mean() < 0.25


def test_correspondences_lead_beyond_the_capture_range() -> None:
    stripes = make_pattern(6, waves=80, shortest_mm=4.0)
    fine = oriented("RAS", (80, 90, 90), 1.25, CENTRE)
    grid = oriented("LPS", (34, 32, 30), 1.25, CENTRE)
    push = np.array([0.0, 16.0, -12.0])
    fixed = image_of(lambda p: stripes(p + push), grid)
    moving = image_of(stripes, fine)
    points = grid.to_ras(np.random.default_rng(1).uniform(3, 27, (60, 3)))
    matches = Correspondences.of(points, points + push)
    matches.moving[:6] += 40.0
    settings = FfdSettings(levels=1, voxel_mm=1.25, window_mm=8.0)
    without = register_ffd(fixed, moving, settings)
    guided = register_ffd(fixed, moving, settings, matches=matches)
    assert error(without.moving_from_fixed(points), points + push).mean() > 5
    assert error(guided.moving_from_fixed(points[6:]), points[6:] + push).mean() < 0.5


def test_contradictory_correspondences_cannot_fold_the_map() -> None:
    rng = np.random.default_rng(3)
    points = GRID.to_ras(rng.uniform(10, 25, (30, 3)))
    crossing = Correspondences.of(points, 2 * CENTRE - points)
    blank = image_of(lambda p: 0 * p[:, 0], GRID)
    strong = FfdSettings(levels=2, voxel_mm=4.0, robust_mm=50.0, weights=Weights(bending=1.0, keypoints=1.0))
    fit = register_ffd(blank, blank, strong, matches=crossing)
    assert fit.min_det > 0
    assert fit.folded_share == 0
    moved = fit.moving_from_fixed(points) - CENTRE
    assert np.linalg.norm(moved, axis=1).mean() < 0.7 * np.linalg.norm(points - CENTRE, axis=1).mean()


def test_masks_that_are_empty_or_elsewhere_are_refused() -> None:
    blank = image_of(PATTERN, GRID)
    empty = Mask(np.zeros(GRID.shape, dtype=bool), GRID.ras_from_ijk)
    with pytest.raises(ValueError, match="mask is empty"):
        register_ffd(blank, blank, COARSE, fixed_mask=empty)
    elsewhere = Mask(np.ones(WIDE.shape, dtype=bool), WIDE.ras_from_ijk)
    with pytest.raises(ValueError, match="must lie on the fixed image's grid"):
        register_ffd(blank, blank, COARSE, fixed_mask=elsewhere)


def test_a_lung_slides_past_a_wall_that_stays() -> None:
    """A ball moves 12 mm along S inside a patterned wall that does not; masked images follow the ball."""
    wall, lung = make_pattern(7), make_pattern(8)
    slide = np.array([0.0, 0.0, 12.0])
    radius = 36.0

    def scene(points: Array, shift: Array) -> Array:
        inside = np.hypot(*(points - CENTRE)[:, :2].T) < radius
        return np.where(inside, 0.4 * lung(points + shift) - 600, 0.4 * wall(points) + 300)

    grid = oriented("LPS", (44, 44, 30), 2.5, CENTRE)
    fixed = image_of(lambda p: scene(p, slide), grid)
    moving = image_of(lambda p: scene(p, np.zeros(3)), WIDE)

    def tube(g: Grid) -> Mask:
        return Mask(np.hypot(*np.moveaxis(g.points() - CENTRE, 3, 0)[:2]) < radius, g.ras_from_ijk)

    images = LungImage(fixed, tube(grid)), LungImage(moving, tube(WIDE))
    fit = register_sliding(*images, COARSE)
    led = register_sliding(*images, COARSE, coarse_beyond_mm=14.0)
    assert (fit.coarse, led.coarse) == (True, False)
    assert fit.matched == led.matched > 20
    assert fit.moved_mm == led.moved_mm == pytest.approx(np.linalg.norm(slide), abs=1.0)
    rng = np.random.default_rng(5)
    angle, r = rng.uniform(0, 2 * np.pi, 200), rng.uniform(26, 34, 200)
    near = CENTRE + np.stack([r * np.cos(angle), r * np.sin(angle), rng.uniform(-20, 20, 200)], axis=1)
    assert error(fit.moving_from_fixed(near), near + slide).mean() < 0.5
    assert error(led.moving_from_fixed(near), near + slide).mean() < 0.5
    assert error(led.moving_from_fixed(near), fit.moving_from_fixed(near)).max() > 0.01  # not the same registrations
    plain = register_ffd(fixed, moving, COARSE)
    assert error(plain.moving_from_fixed(near), near + slide).mean() > 2.0


@pytest.mark.parametrize(
    ("count", "limit", "coarse"), [(30, 9.0, True), (30, 11.0, False), (19, 11.0, True), (0, 1000.0, True)]
)
def test_the_coarse_levels_run_where_matches_moved_far_or_are_too_few(
    monkeypatch: pytest.MonkeyPatch, count: int, limit: float, coarse: bool
) -> None:
    points = INNER[:count]
    matches = Correspondences.of(points, points + np.array([0.0, 0.0, 10.0]))
    still = CompositeTransform(RigidTransform.identity(), BSplineField(np.zeros((4, 4, 4, 3)), np.eye(4)))
    asked: list[dict[str, Any]] = []

    def register(*_images: Volume, **named: Any) -> FfdFit:
        asked.append(named)
        return FfdFit(still, Stop.CONVERGED, (), 1.0, 0.0, 1.0)

    monkeypatch.setattr(sliding, "match_keypoints", lambda *_values, **_named: matches)
    monkeypatch.setattr(sliding, "register_ffd", register)
    blank = Volume(np.full(GRID.shape, -700, np.float32), GRID.ras_from_ijk)
    image = LungImage(blank, Mask(np.linalg.norm(GRID.points() - CENTRE, axis=-1) < 20, GRID.ras_from_ijk))
    fit = register_sliding(image, image, COARSE, coarse_beyond_mm=limit)
    assert fit.coarse is coarse
    assert len(asked) == 1 + coarse
    enough = count >= 20
    assert fit.matched == (count if enough else 0)
    assert fit.moved_mm == (pytest.approx(10.0) if enough else np.inf)
    for named in asked:
        assert (named["matches"] is not None) is enough


def test_bare_tissue_follows_the_depth_and_not_a_tapering_wall() -> None:
    """Vessels deep in a cone move 9 mm along it; its wall and 9 mm of bare tissue below the wall look unmoved.

    Where bare tissue ends in one pattern alone is decided by rounding: a millionth of the intensities moved its mean
    error there by up to a quarter. So four are pooled: 1.74 to 1.77 mm off along the cone against 5.3 to 5.6 without
    keypoints.
    """
    slide = np.array([0.0, 0.0, 9.0])
    settings = replace(COARSE, voxel_mm=2.8)
    grid, wide = oriented("LPS", (40, 40, 27), 2.8, CENTRE), oriented("RAS", (40, 40, 36), 2.8, CENTRE)

    def depth(points: Array) -> Array:
        off = points - CENTRE
        return 38.0 - 0.2 * off[:, 2] - np.hypot(off[:, 0], off[:, 1])

    def cone(g: Grid) -> Mask:
        return Mask(depth(g.points().reshape(-1, 3)).reshape(g.shape) > 0, g.ras_from_ijk)

    def image(g: Grid, vessels: Callable[[Array], Array], shift: Array) -> Volume:
        def shown(points: Array) -> Array:
            d = depth(points)
            tissue = -850 + 0.8 * (vessels(points + shift) + 500) * np.clip((d - 9) / 3, 0, 1)
            return np.where(d > 0, tissue, 40.0)

        return image_of(shown, g)

    bare = CENTRE + np.random.default_rng(6).uniform([-40, -40, -25], [40, 40, 10], (4000, 3))
    bare = bare[(depth(bare) > 3) & (depth(bare) < 9)]
    around = Mask(dilate(cone(grid).inside, 5.0, grid.spacing), grid.ras_from_ijk)
    along, before = [], []
    for seed in range(8, 12):
        vessels = make_pattern(seed)
        fixed, moving = image(grid, vessels, slide), image(wide, vessels, np.zeros(3))
        fit = register_sliding(LungImage(fixed, cone(grid)), LungImage(moving, cone(wide)), settings)
        held = register_ffd(masked(fixed, cone(grid)), masked(moving, cone(wide)), settings, fixed_mask=around)
        assert fit.folded_share == 0
        for f, off in ((fit, along), (held, before)):
            off.append(np.abs(f.moving_from_fixed(bare)[:, 2] - bare[:, 2] - slide[2]).mean())
    assert np.mean(along) < 1.95
    assert np.mean(along) < 0.37 * np.mean(before)


def test_masking_and_dilating_by_value() -> None:
    grid = Grid((21, 21, 21), np.diag([1.0, 1.0, 2.0, 1.0]))
    inside = np.zeros(grid.shape, dtype=bool)
    inside[10, 10, 10] = True
    lung = Mask(inside, grid.ras_from_ijk)
    ball = dilate(inside, 5.0, grid.spacing)
    assert ball[15, 10, 10]
    assert not ball[16, 10, 10]
    assert ball[10, 10, 12]
    assert not ball[10, 10, 13]
    hu = masked(Volume(np.full(grid.shape, -500, np.float32), grid.ras_from_ijk), lung).hu
    assert hu[10, 10, 10] == -500
    assert hu[9, 10, 10] == -1100


def test_fields_of_a_fit_lie_on_grids_parallel_to_the_fixed_image() -> None:
    control = control_grid(GRID, 16.0)
    spline = BSplineField(np.zeros((*control.shape, 3)), control.ras_from_ijk)
    assert spline.dense(GRID).grid.same_as(GRID)


def test_few_matches_hold_the_finest_levels_little_and_let_them_bend_little() -> None:
    given = Weights(bending=6.0, keypoints=2.0)
    none, some, many = (finest_weights(given, n) for n in (0, 450, 5000))
    assert (none.bending, none.keypoints) == (6.0, 0.0)
    assert (some.bending, some.keypoints) == (pytest.approx(4.0), pytest.approx(0.5))
    assert (many.bending, many.keypoints) == (pytest.approx(2.0), pytest.approx(1.0))


@pytest.mark.parametrize("window_mm", [14.0, None])
def test_a_moving_image_that_sees_none_of_the_samples_is_refused(window_mm: float | None) -> None:
    image = image_of(PATTERN, oriented("RAS", (20, 20, 20), 4.0, CENTRE))
    nothing = Mask(np.zeros(image.hu.shape, dtype=bool), image.ras_from_ijk)
    settings = FfdSettings(spacing_mm=32.0, levels=1, voxel_mm=4.0, window_mm=window_mm)
    with pytest.raises(ValueError, match="sees none of the 8000 samples of the fixed mask"):
        register_ffd(image, image, settings, moving_mask=nothing)
