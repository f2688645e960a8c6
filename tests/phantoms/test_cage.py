"""Motion of the chest's walls: it leaves the spine alone, can be undone, and meets a volume."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from phantoms.anatomy import draw_build, make_shapes, spine_y
from phantoms.cage import CageMotion, fit_dome


@pytest.fixture(scope="module", params=[1, -1])
def motion(request: pytest.FixtureRequest) -> CageMotion:
    return CageMotion(draw_build(np.random.default_rng(4)), request.param, 30.0, 16.0, 8.0, 5.0)


def test_spine_stays(motion: CageMotion) -> None:
    z = np.random.default_rng(0).uniform(-180, 120, 400)
    around = np.random.default_rng(1).uniform([-24, -54], [24, 18], (400, 2))
    spine = np.stack([around[:, 0], spine_y(motion.build, z) + around[:, 1], z], axis=1)
    assert np.abs(motion.displacement(spine)).max() == 0


def test_diaphragm_rises_and_mediastinum_falls_away_from_the_operated_side(motion: CageMotion) -> None:
    dome = motion.build.dome[0 if motion.side == 1 else 1]
    points = np.array([[motion.side * 54.0, 2.0, dome - 20], [0.0, 20.0, -60.0]])
    u = motion.displacement(points)
    assert u[0, 2] == pytest.approx(30, abs=2)
    assert motion.side * u[1, 0] < -5


def test_inverse_undoes_the_motion(motion: CageMotion) -> None:
    points = np.random.default_rng(0).uniform([-150, -110, -200], [150, 110, 130], (2000, 3))
    assert_allclose(motion.inverse(motion(points)), points, atol=0.02)


def test_inverse_undoes_a_fall_so_steep_that_fixed_point_steps_run_away(monkeypatch: pytest.MonkeyPatch) -> None:
    newton, left = CageMotion._newton, []

    def watched(self: CageMotion, points: np.ndarray, tolerance_mm: float) -> np.ndarray:
        left.append(len(points))
        return newton(self, points, tolerance_mm)

    monkeypatch.setattr(CageMotion, "_newton", watched)
    motion = CageMotion(draw_build(np.random.default_rng(4)), -1, 30.0, 16.0, 50.0, 5.0)
    points = np.random.default_rng(0).uniform([-150, -110, -200], [150, 110, 130], (20000, 3))
    assert_allclose(motion.inverse(motion(points)), points, atol=0.02)
    assert sum(left) > 0


def test_dome_is_fitted_to_the_volume_and_the_carried_room_has_it() -> None:
    build = draw_build(np.random.default_rng(4))
    lung = make_shapes(build).right_lung
    lung = lung.crop(lung.values < 0, 24.0)
    fitted = fit_dome(CageMotion(build, 1, 0.0, 16.0, 5.0, 6.0), lung, 0.85)
    assert fitted.operated_dome > 0
    room = fitted.carry(lung)
    share = np.clip(0.5 - room.values / 3, 0, 1).sum() / np.clip(0.5 - lung.values / 3, 0, 1).sum()
    assert share == pytest.approx(0.85, abs=0.012)
