"""The forecast from the CT alone: means, spreads and sides by value, its ellipsoid by counting, and the command."""

from __future__ import annotations

import json
import shutil
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from registration.volume import Array
from tests import made_once
from vatsloc.errors import CaseError
from vatsloc.evaluation.ellipsoid import in_ellipsoid
from vatsloc.formats.markups import read_points
from vatsloc.study import forecast as study
from vatsloc.workflow.forecast import (
    Forecast,
    Motions,
    calibrated_motions,
    calibration,
    forecast,
    mean_motion,
    motions_of,
)
from vatsloc.workflow.foresee import foresee_case

MIDDLE = np.array([70.0, -10.0, 20.0])
POINT = np.add(MIDDLE, [20.0, 10.0, -30.0])
SHIFT, GRADIENT = np.array([-9.0, 2.0, 5.0]), np.array([[-0.3, 0.1, 0], [0, -0.2, 0.05], [0.02, 0, -0.25]])


def motions(count: int, spread: float, left_mm: float = 0.0, seed: int = 0) -> Motions:
    """Persons about one mean motion, which they have exactly."""
    noise = np.random.default_rng(seed).standard_normal((count, 3))
    noise -= noise.mean(axis=0)
    left = np.tile(left_mm**2 * np.eye(3), (count, 1, 1))
    return Motions(
        np.full(count, "air"), np.full(count, "drawn"), SHIFT + spread * noise, np.tile(GRADIENT, (count, 1, 1)), left
    )


def test_the_centre_is_where_the_mean_motion_takes_the_point() -> None:
    found = forecast(POINT, MIDDLE, "right", motions(9, 4.0))
    assert_allclose(found.centre, POINT + SHIFT + GRADIENT @ (POINT - MIDDLE))
    assert_allclose(found.centre - POINT, mean_motion(POINT[None], MIDDLE, "right", motions(9, 4.0))[0])
    assert found.persons == 9


def test_the_left_lung_moves_as_the_right_one_in_a_mirror() -> None:
    mirror = np.array([-1.0, 1, 1])
    right = forecast(POINT, MIDDLE, "right", motions(9, 4.0))
    left = forecast(POINT * mirror, MIDDLE * mirror, "left", motions(9, 4.0))
    assert_allclose(left.centre, right.centre * mirror)
    assert_allclose(left.semi_axes_mm, right.semi_axes_mm)
    assert_allclose(np.abs(left.axes @ (right.axes * mirror).T), np.eye(3), atol=1e-9)


def test_the_ellipsoid_holds_the_next_person_in_95_of_100_cases() -> None:
    rng, held, trials = np.random.default_rng(1), 0, 2000
    air, drawn_kind = np.full(12, "air"), np.full(12, "drawn")
    axes = np.linalg.qr(rng.standard_normal((3, 3)))[0] * [6.0, 3.0, 1.0]
    still = np.zeros((12, 3, 3))
    for _ in range(trials):
        drawn = rng.standard_normal((13, 3)) @ axes.T
        found = forecast(MIDDLE, MIDDLE, "right", Motions(air, drawn_kind, drawn[:12], still, still))
        held += in_ellipsoid(MIDDLE + drawn[12] - found.centre, found.semi_axes_mm, found.axes)
    assert 0.93 < held / trials < 0.97


def test_what_affine_motions_leave_over_widens_the_ellipsoid_alike_in_all_directions() -> None:
    thin, wide = (forecast(POINT, MIDDLE, "right", motions(9, 4.0, left)) for left in (0.0, 5.0))
    reach = 10 / 9 * 3 * 8 / 6 * 4.757  # F(0.95; 3, 6)
    assert_allclose(wide.semi_axes_mm**2 - thin.semi_axes_mm**2, 25 * reach, rtol=1e-3)
    assert (np.diff(wide.semi_axes_mm) <= 0).all()


def test_each_gas_has_its_own_mean_and_shares_the_spread() -> None:
    air, apart = motions(9, 4.0), np.array([0.0, 0, -12.0])
    both = replace(twice(air), gas=np.repeat(["air", "co2"], 9))
    both.shift[9:] += apart
    alone = forecast(POINT, MIDDLE, "right", air)
    first, second = (forecast(POINT, MIDDLE, "right", both, gas) for gas in ("air", "co2"))
    assert_allclose(first.centre, alone.centre)
    assert_allclose(second.centre, alone.centre + apart)
    assert_allclose(first.semi_axes_mm, second.semi_axes_mm)
    # 16 degrees of freedom instead of 8: F(0.95; 3, 14) and F(0.95; 3, 6)
    ratio = np.sqrt((16 / 14 * 3.344) / (8 / 6 * 4.757))
    assert_allclose(first.semi_axes_mm / alone.semi_axes_mm, ratio, rtol=1e-3)


def test_every_kind_of_anatomy_counts_alike_however_many_persons_have_it() -> None:
    air, apart = motions(9, 4.0), np.array([0.0, 12.0, 0])
    alike = replace(twice(air), anatomy=np.repeat(["drawn", "scan"], 9))
    mixed = replace(alike, shift=alike.shift + apart * (alike.anatomy == "scan")[:, None])
    few = mixed.only(np.arange(18) < 14)
    few.shift[9:] += mixed.shift[9:].mean(axis=0) - few.shift[9:].mean(axis=0)
    alone, both, fewer = (forecast(POINT, MIDDLE, "right", m) for m in (air, mixed, few))
    assert_allclose(both.centre, alone.centre + apart / 2)
    assert_allclose(fewer.centre, both.centre)
    assert_allclose(mean_motion(POINT[None], MIDDLE, "right", few)[0], both.centre - POINT)
    # A third kind lies as far from the two as they lie apart: 3 / 2 of their sample variance, along their difference.
    reach = 19 / 18 * 3 * 16 / 14 * 3.344  # F(0.95; 3, 14)
    added = covariance(both) - covariance(forecast(POINT, MIDDLE, "right", alike))
    assert_allclose(added, np.outer(apart, apart) / 2 * 3 / 2 * reach, rtol=2e-3, atol=1e-6 * reach)


def covariance(found: Forecast) -> Array:
    """The ellipsoid's squared semi-axes as a matrix."""
    return found.axes.T @ np.diag(found.semi_axes_mm**2) @ found.axes


def twice(one: Motions) -> Motions:
    """Every person two times over."""
    return Motions(*(np.concatenate([getattr(one, part.name)] * 2) for part in fields(one)))


def test_fewer_than_five_persons_tell_nothing() -> None:
    with pytest.raises(ValueError, match="holds 4 persons with air in the chest, 5 needed"):
        forecast(POINT, MIDDLE, "right", motions(4, 1.0))


def test_the_calibration_s_own_persons_are_forecast_by_the_others() -> None:
    assert min((calibrated_motions("deflated").gas == gas).sum() for gas in ("air", "co2")) >= 5
    rows, off = [row for row in calibration() if row["gas"] == "air"], []
    for one in rows:
        own = motions_of([one], "deflated")
        here = forecast(POINT, MIDDLE, "right", motions_of([row for row in rows if row is not one], "deflated"))
        off.append(np.linalg.norm(here.centre - POINT - own.shift[0] - own.gradient[0] @ (POINT - MIDDLE)))
    assert np.mean(off) < 12
    inflated, deflated = (
        np.linalg.det(np.eye(3) + calibrated_motions(state).gradient.mean(axis=0)) for state in ("inflated", "deflated")
    )
    assert 0.4 < deflated < 0.7 < inflated < 0.95  # of the lung's volume in the CT


def test_a_calibration_fits_an_affine_motion_and_what_it_leaves() -> None:
    about = np.repeat(np.random.default_rng(2).normal(0, 40, (200, 3)), 2, axis=0)
    rest = np.tile([[3.0, 0, 0], [-3.0, 0, 0]], (200, 1))
    told = study.affine_motion(about, SHIFT + about @ GRADIENT.T + rest)
    assert_allclose(told["shift"], SHIFT)
    assert_allclose(told["gradient"], GRADIENT, atol=1e-9)
    assert_allclose(told["left"], np.diag([9.0, 0, 0]), atol=1e-9)


def test_a_calibration_goes_on_where_it_was_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[tuple[int, Any]] = []
    monkeypatch.setattr(
        study, "moved", lambda seed, scan: made.append((seed, scan)) or {"seed": seed, "shift": [1 / 3]}
    )
    monkeypatch.setattr(study, "read_scan", lambda ct, side: (ct.name, side))
    study.calibrate(tmp_path / "rows.json", 2, {})
    study.calibrate(tmp_path / "rows.json", 3, {"right": [Path("a.nrrd")], "left": [Path("b.nrrd")]})
    first = study.FIRST_SEED
    assert made[:3] == [(first + n, None) for n in range(3)]
    assert made[3:6] == [(first + 100 + n, (("a.nrrd", "right"), "right")) for n in range(3)]
    assert made[6:] == [(first + 200 + n, (("b.nrrd", "left"), "left")) for n in range(3)]
    assert json.loads((tmp_path / "rows.json").read_text())[2] == {"seed": first + 2, "shift": [0.33333]}


def test_drawn_operations_lie_between_the_suite_s_and_are_the_same_again() -> None:
    specs = [study.drawn_spec(seed) for seed in range(3000, 3030)]
    assert specs == [study.drawn_spec(seed) for seed in range(3000, 3030)]
    assert {spec.collapse.gas for spec in specs} == {"air", "co2"}
    assert {spec.side for spec in specs} == {"left", "right"}
    assert all(0.25 <= spec.collapse.deflated <= 0.64 and 7 <= spec.collapse.shift <= 38 for spec in specs)
    assert all((spec.collapse.dome_rise < 0) == (spec.collapse.gas == "co2") for spec in specs)


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A case of which only the CT is there."""
    folder = Path(shutil.copytree(made_once.demo_case(tmp_path_factory), tmp_path_factory.mktemp("foresee") / "demo"))
    for path in (*folder.glob("cbct_*"), *folder.glob("landmarks_*"), *folder.glob("truth/*")):
        path.unlink()
    return folder


def test_foresee_writes_a_forecast_that_says_it_is_one(case: Path, tmp_path: Path) -> None:
    told: dict[str, Any] = foresee_case(case, tmp_path / "out")
    agreed = {"nodule_lps", "nodule_ellipsoid95_mm", "nodule_ellipsoid95_axes_lps", "frame", "warnings"}
    assert agreed <= set(told)
    assert told["frame"] == "ct"
    assert told == json.loads((tmp_path / "out" / "foresee.json").read_text(encoding="utf-8"))
    assert any("forecast" in warning for warning in told["warnings"])
    marked = read_points(tmp_path / "out" / "nodule_foreseen_ct.mrk.json").ras[0]
    assert_allclose(marked * [-1, -1, 1], told["nodule_lps"], atol=1e-6)
    assert 5 < told["moves_mm"] < 60
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "A forecast, not a measurement" in page
    assert page.count("data:image/jpeg") == 3
    foresee_case(case, tmp_path / "out")  # its own folder may be replaced
    with pytest.raises(CaseError, match="holds files that vatsloc did not write"):
        foresee_case(case, case)
