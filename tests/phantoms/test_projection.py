"""The C-arm: line integrals of a ball, known densities, places, noise, scatter, hardening, heartbeat and truncation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from phantoms import SPECS, make_case, projection
from phantoms.cbct import Flaws, Scanner, scanner_grid
from phantoms.cone_beam import Circle, feldkamp, parker_weights
from phantoms.cone_beam import project as line_integrals_of
from phantoms.projection import WATER_PER_MM, Beat, CArm, c_arm_of, develop, expose_views, extend, project, scene_grid
from phantoms.scanner_figures import scanner_figures
from phantoms.voxels import Array, Image
from vatsloc.errors import CaseError
from vatsloc.synthetic.case import scanned

SCANNER = Scanner(fov=160.0, length=60.0)
VIEW = scanner_grid(np.zeros(3), (4.0, 4.0, 4.0), 60.0, 160.0)
ARM = CArm(views=120, pixel=5.0, height=130.0, photons=1e12, scattered=0.0, scatter=0.0)
TIGHT = replace(ARM, width=250.0)


def _cylinder(radius: float) -> Image:
    scene = scene_grid(VIEW)
    axis = np.hypot(*np.moveaxis(scene.points()[..., :2], -1, 0))
    return Image(np.where(axis < radius, 0, -1000).astype(np.float32), scene.ras_from_ijk)


def _profile(image: Image) -> Array:
    """Mean HU in rings 8 mm wide about the axis, in the middle slices."""
    axis = np.hypot(*np.moveaxis(image.grid.points()[..., :2], -1, 0))
    middle = np.s_[:, :, 5:-5]
    return np.array([image.hu[middle][axis[middle] // 8 == n].mean() for n in range(10)])


@pytest.fixture(scope="module")
def ball() -> tuple[Circle, Array, Array]:
    """Line integrals (views, columns, rows) of a ball of radius 25 mm off the axis, and what they are by geometry."""
    circle, place, radius, h = Circle(785.0, 1200.0, 200.0, 90, 4.0, (50, 70)), np.array([20.0, -14.0, 8.0]), 25.0, 1.5
    shape = (90, 80, 70)
    axes = [(np.arange(n) - (n - 1) / 2) * h for n in shape]
    away = np.linalg.norm(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1) - place, axis=-1)
    volume = np.clip(0.5 - (away - radius) / h, 0, 1)
    found = line_integrals_of(volume, np.full(3, h), circle, np.zeros(1))[0]
    c, s = np.cos(circle.angles)[:, None, None], np.sin(circle.angles)[:, None, None]
    u, v = circle.columns_mm[None, :, None], circle.rows_mm[None, None, :]
    ray = np.stack(np.broadcast_arrays(-1200 * c - u * s, -1200 * s + u * c, v), axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    to_ball = place - np.stack(np.broadcast_arrays(785 * c, 785 * s, 0 * c), axis=-1)
    along = (to_ball * ray).sum(axis=-1)
    exact = 2 * np.sqrt(np.maximum(radius**2 - (to_ball**2).sum(axis=-1) + along**2, 0))
    return circle, found, exact


def test_line_integrals_of_a_ball_are_its_chords(ball: tuple[Circle, Array, Array]) -> None:
    _, found, exact = ball
    assert exact.max() == pytest.approx(50.0, abs=0.1)
    deep = exact > 30
    assert np.abs(found - exact)[deep].max() < 0.6
    assert np.abs(found - exact).mean() < 0.05
    assert found.sum() == pytest.approx(exact.sum(), rel=2e-3)


def test_the_ball_is_reconstructed_from_its_exact_chords(ball: tuple[Circle, Array, Array]) -> None:
    circle, _, exact = ball
    volume = feldkamp(exact.astype(np.float32), circle, (40, 40, 40), np.full(3, 2.0), 0.9)
    at = (np.stack(np.meshgrid(*[np.arange(40) - 19.5] * 3, indexing="ij"), axis=-1)) * 2.0
    away = np.linalg.norm(at - [20.0, -14.0, 8.0], axis=-1)
    assert volume[away < 19].mean() == pytest.approx(1.0, abs=0.01)
    assert volume[(away > 32) & (away < 38)].mean() == pytest.approx(0.0, abs=0.01)


def test_the_weights_of_a_ray_and_of_its_reverse_add_up_to_one() -> None:
    circle = Circle(785.0, 1200.0, 200.0, 2001, 4.0, (2, 91))
    weights = parker_weights(circle)
    gamma = np.arctan(circle.columns_mm / 1200.0)
    for column in (0, 20, 45, 70, 90):
        back = circle.angles + np.pi - 2 * gamma[column]
        both = np.flatnonzero(back <= circle.angles[-1])
        reverse = np.interp(back[both], circle.angles, weights[:, 90 - column])
        assert_allclose(weights[both, column] + reverse, 1.0, atol=2e-3)
    with pytest.raises(ValueError, match="an arc of 190 degrees is too short for the detector's width"):
        parker_weights(replace(circle, arc=190.0))


def test_water_is_zero_and_air_is_minus_a_thousand() -> None:
    found = _profile(expose_views(_cylinder(60.0), VIEW, SCANNER, np.random.default_rng(0), ARM))
    assert_allclose(found[:6], 0, atol=6)
    assert found[9] == pytest.approx(-1000, abs=15)


def test_a_ball_is_found_where_it_is() -> None:
    scene = scene_grid(VIEW)
    place = np.array([22.0, -30.0, 9.0])
    near = np.linalg.norm(scene.points() - place, axis=-1) < 10
    image = expose_views(
        Image(np.where(near, 0, -1000).astype(np.float32), scene.ras_from_ijk),
        VIEW,
        SCANNER,
        np.random.default_rng(0),
        ARM,
    )
    weight = np.maximum(image.hu + 700, 0)
    assert_allclose((weight[..., None] * VIEW.points()).sum(axis=(0, 1, 2)) / weight.sum(), place, atol=0.5)


def test_truncation_raises_the_rim_and_an_end_of_water_mends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    exact = project(_cylinder(130.0), TIGHT)
    mended = _profile(develop(exact, VIEW, SCANNER, np.random.default_rng(0), TIGHT))
    monkeypatch.setattr(projection, "extend", lambda p, _step, n: np.pad(p, ((0, 0), (0, 0), (n, n))))
    cut = _profile(develop(exact, VIEW, SCANNER, np.random.default_rng(0), TIGHT))
    assert cut[9] - cut[0] > 150
    assert_allclose(mended[:9], 0, atol=25)


def test_noise_falls_with_the_root_of_the_dose_and_scatter_darkens_the_middle() -> None:
    exact = project(_cylinder(60.0), ARM)

    def shot(photons: float, scatter: float, seed: int) -> Image:
        return develop(
            exact,
            VIEW,
            SCANNER,
            np.random.default_rng(seed),
            replace(ARM, photons=photons, scattered=scatter, scatter=scatter),
        )

    core = np.s_[14:26, 14:26, 3:-3]
    noise = [(shot(n, 0.0, 1).hu - shot(n, 0.0, 2).hu)[core].std() / np.sqrt(2) for n in (2e3, 8e3)]
    assert noise[0] / noise[1] == pytest.approx(2.0, rel=0.08)
    lost = _profile(shot(1e12, 0.1, 1))
    assert lost[0] < -20
    assert lost[0] < lost[5] - 5


def test_steel_hardens_the_beam_and_water_does_not() -> None:
    scene = _cylinder(60.0)
    hard = replace(ARM, hardening=True)
    assert_allclose(_profile(expose_views(scene, VIEW, SCANNER, np.random.default_rng(0), hard))[:6], 0, atol=6)
    x, y, _ = np.moveaxis(scene.grid.points(), -1, 0)
    for place in (-25.0, 25.0):
        scene.hu[np.hypot(x - place, y) < 4] = 20000
    between = np.s_[18:22, 19:21, 5:-5]
    lost = [
        expose_views(scene, VIEW, SCANNER, np.random.default_rng(0), replace(ARM, hardening=h)).hu[between].mean()
        for h in (False, True)
    ]
    assert lost[1] < lost[0] - 80


def test_a_beating_heart_blurs_its_wall_and_nothing_far_away() -> None:
    scene = scene_grid(VIEW)
    away = [np.linalg.norm(scene.points() - place, axis=-1) for place in ((-20.0, 0.0, 0.0), (62.0, 0.0, 0.0))]
    hu = np.where((away[0] < 30) | (away[1] < 14), 0, -1000).astype(np.float32)
    still, beating = (
        expose_views(Image(hu, scene.ras_from_ijk), VIEW, SCANNER, np.random.default_rng(0), ARM, beat)
        for beat in (None, Beat(np.array([-20.0, 0.0, 0.0]), 30.0, 8.0))
    )
    wall = np.abs(np.linalg.norm(VIEW.points() - [-20.0, 0.0, 0.0], axis=-1) - 26) < 3
    inside = np.linalg.norm(VIEW.points() - [-20.0, 0.0, 0.0], axis=-1) < 12
    far = np.linalg.norm(VIEW.points() - [62.0, 0.0, 0.0], axis=-1) < 8
    assert beating.hu[wall].mean() < still.hu[wall].mean() - 100
    assert abs(beating.hu[inside].mean() - still.hu[inside].mean()) < 25
    assert abs(beating.hu[far].mean() - still.hu[far].mean()) < 50


def test_gain_and_offset_are_those_asked_for() -> None:
    plain = expose_views(_cylinder(60.0), VIEW, SCANNER, np.random.default_rng(0), ARM)
    wrong = replace(SCANNER, flaws=Flaws(gain=0.9, offset=-40.0))
    assert_allclose(
        _profile(expose_views(_cylinder(60.0), VIEW, wrong, np.random.default_rng(0), ARM))[:6],
        0.9 * (_profile(plain)[:6] + 1000) - 1040,
        atol=1.0,
    )


def test_a_cut_cylinder_of_water_is_continued_as_itself() -> None:
    x = np.arange(-80.0, 81.0, 1.0)
    inside = 2 * WATER_PER_MM * np.sqrt(130.0**2 - x**2)
    wide = extend(np.tile(inside, (4, 4, 1)).astype(np.float32), 1.0, 60)[2, 2]
    outside = np.arange(81.0, 141.0)
    assert_allclose(wide[-60:], 2 * WATER_PER_MM * np.sqrt(np.maximum(130.0**2 - outside**2, 0)), atol=0.25)
    assert_allclose(wide[:60], wide[-60:][::-1], rtol=1e-4)
    assert_allclose(wide[60:-60], inside, rtol=1e-6)


def test_the_c_arm_has_the_field_and_dose_of_the_scanner() -> None:
    plain, poor, small = c_arm_of(Scanner()), c_arm_of(Scanner(noise=42.0)), c_arm_of(Scanner(fov=190.0, length=85.0))
    assert poor.photons == pytest.approx(plain.photons / 4)
    assert small.height == pytest.approx(plain.height / 2)
    reach = np.sin(np.arctan(small.width / 2 / small.source_detector)) * small.source_axis
    assert reach == pytest.approx(99.0)
    assert c_arm_of(Scanner(), 2.0).pixel == pytest.approx(2.0 * 1200 / 785)


def test_figures_are_the_errors_and_the_noise_put_in() -> None:
    clean = Image(np.full((40, 40, 30), 40.0, dtype=np.float32), np.diag([-2.0, -2.0, 2.0, 1.0]))
    clean.hu[:20] = -800
    rng = np.random.default_rng(0)
    shots = [
        Image(clean.hu - 30 + 15 * rng.standard_normal(clean.hu.shape, dtype=np.float32), clean.ras_from_ijk)
        for _ in range(2)
    ]
    found = scanner_figures(clean, (shots[0], shots[1]), 80.0)
    assert found["lung, 0 to 0.5 of the radius"] == pytest.approx(-30, abs=2)
    assert found["soft tissue, 0.5 to 0.8 of the radius"] == pytest.approx(-30, abs=2)
    assert found["noise in soft tissue"] == pytest.approx(15, rel=0.05)
    assert found["grain across slices"] == pytest.approx(1.0, abs=0.1)
    assert np.isnan(found["gas, 0 to 0.5 of the radius"])


def test_other_domains_are_refused() -> None:
    with pytest.raises(CaseError, match=r"--cbct must be image or projection, got \"sound\""):
        scanned(SPECS["demo"], "sound")
    with pytest.raises(ValueError, match="domain must be 'image' or 'projection', got 'sound'"):
        make_case(replace(SPECS["demo"], scanner=Scanner(domain="sound")))
