"""The C-arm: known densities, places, noise and truncation; what needs RTK is skipped where it is not installed."""

from __future__ import annotations

import sys
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
from numpy.testing import assert_allclose

from phantoms import SPECS, make_case, projection
from phantoms.cbct import Scanner, scanner_grid
from phantoms.projection import WATER_PER_MM, CArm, c_arm_of, develop, expose_views, extend, project, scene_grid
from phantoms.scanner_figures import scanner_figures
from phantoms.voxels import Array, Image
from vatsloc.errors import CaseError
from vatsloc.synthetic.case import scanned

needs_rtk = pytest.mark.skipif(find_spec("itk") is None, reason='itk-rtk is not here (extra "projections")')
SCANNER = Scanner(fov=160.0, length=60.0)
VIEW = scanner_grid(np.zeros(3), (4.0, 4.0, 4.0), 60.0, 160.0)
ARM = CArm(views=120, pixel=5.0, height=130.0, photons=1e12, scatter=0.0)
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


@needs_rtk
def test_water_is_zero_and_air_is_minus_a_thousand() -> None:
    found = _profile(expose_views(_cylinder(60.0), VIEW, SCANNER, np.random.default_rng(0), ARM))
    assert_allclose(found[:6], 0, atol=6)
    assert found[9] == pytest.approx(-1000, abs=15)


@needs_rtk
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


@needs_rtk
def test_truncation_raises_the_rim_and_an_end_of_water_mends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    exact = project(projection.attenuation(_cylinder(130.0)), scene_grid(VIEW).spacing, TIGHT)
    mended = _profile(develop(exact, VIEW, SCANNER, np.random.default_rng(0), TIGHT))
    monkeypatch.setattr(projection, "extend", lambda p, _step, n: np.pad(p, ((0, 0), (0, 0), (n, n))))
    cut = _profile(develop(exact, VIEW, SCANNER, np.random.default_rng(0), TIGHT))
    assert cut[9] - cut[0] > 150
    assert_allclose(mended[:9], 0, atol=25)


@needs_rtk
def test_noise_falls_with_the_root_of_the_dose_and_scatter_darkens_the_middle() -> None:
    exact = project(projection.attenuation(_cylinder(60.0)), scene_grid(VIEW).spacing, ARM)

    def shot(photons: float, scatter: float, seed: int) -> Image:
        return develop(
            exact, VIEW, SCANNER, np.random.default_rng(seed), replace(ARM, photons=photons, scatter=scatter)
        )

    core = np.s_[14:26, 14:26, 3:-3]
    noise = [(shot(n, 0.0, 1).hu - shot(n, 0.0, 2).hu)[core].std() / np.sqrt(2) for n in (2e3, 8e3)]
    assert noise[0] / noise[1] == pytest.approx(2.0, rel=0.08)
    lost = _profile(shot(1e12, 0.1, 1))
    assert lost[0] < -20
    assert lost[0] < lost[5] - 5


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


def test_without_rtk_and_for_other_domains_one_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(CaseError, match=r"--cbct must be image or projection, got \"sound\""):
        scanned(SPECS["demo"], "sound")
    with pytest.raises(ValueError, match="domain must be 'image' or 'projection', got 'sound'"):
        make_case(replace(SPECS["demo"], scanner=Scanner(domain="sound")))
    monkeypatch.setattr("vatsloc.synthetic.case.find_spec", lambda _name: None)
    with pytest.raises(CaseError, match=r"get it by pip install \"vatsloc\[projections\]\""):
        scanned(SPECS["demo"], "projection")
    projection._itk.cache_clear()
    monkeypatch.setitem(sys.modules, "itk", None)
    with pytest.raises(ModuleNotFoundError, match="projections need itk-rtk"):
        project(np.zeros((2, 2, 2)), np.ones(3), ARM)
