"""What the registration's studies measure, on values that are known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from registration.images.interpolate import interpolate
from registration.maps.field import DisplacementField
from registration.maps.rigid import RigidTransform
from registration.volume import Mask, Volume
from vatsloc.evaluation.evaluate import errors_by_depth
from vatsloc.study.bench import registration as bench
from vatsloc.study.bench.cost_registration import Images, exponent
from vatsloc.study.bench.elastix import ElastixSettings, elastix_version, run_elastix
from vatsloc.study.bench.isolated import isolated
from vatsloc.study.bench.registration import (
    Dense,
    Ours,
    bench_registration,
    case_folder,
    depth_table,
    page,
    score,
    table,
)
from vatsloc.study.stability import registration as stability
from vatsloc.study.stability.registration import Scene, make_pair
from vatsloc.workflow.stages import quiet

AGREED = {"tre_mean", "tre_p95", "tre_max", "seconds", "peak_mb", "min_det", "folded_share"}
AFFINE = np.diag([-2.0, -2.0, 2.0, 1.0])


def blobs(shift_ras: tuple[float, float, float] = (0, 0, 0)) -> Volume:
    """Soft balls in lung, moved by `shift_ras` mm."""
    grid = Volume(np.zeros((36, 40, 32), dtype=np.float32), AFFINE).grid
    points, hu = grid.points(), np.full(grid.shape, -850.0)
    for centre in np.random.default_rng(4).uniform([-60, -66, 10], [-12, -12, 54], (14, 3)):
        hu += 800 * np.exp(-np.sum((points - centre - shift_ras) ** 2, axis=-1) / (2 * 5.0**2))
    return Volume(hu.astype(np.float32), AFFINE)


@pytest.fixture
def images() -> Images:
    """A pair 3 mm apart along each axis, with the landmarks that say so."""
    fixed, moving = blobs(), blobs((3, 3, 3))
    everywhere = Mask(np.ones(fixed.hu.shape, dtype=bool), AFFINE)
    marks = np.array([[-20.0, -30.0, 20.0], [-40.0, -50.0, 40.0]])
    return Images(fixed, moving, everywhere, everywhere, everywhere, RigidTransform.identity(), marks, marks + 3.0)


def test_score_of_a_known_shift(images: Images) -> None:
    shift = np.zeros((*images.fixed.hu.shape, 3)) + np.array([3.0, 3.0, -1.0])
    row = score(images, field := DisplacementField(shift, AFFINE), field)
    assert [row[key] for key in ("tre_mean", "tre_p95", "tre_max", "n")] == pytest.approx([4.0, 4.0, 4.0, 2])
    assert [row["min_det"], row["folded_share"]] == pytest.approx([1.0, 0.0])


def test_score_tells_tissue_by_depth(images: Images) -> None:
    """Two points each 2 and 7 mm deep, of which the first is found and the second is 4 mm off."""
    fixed = np.array([[-20.0, -30.0, 20.0], [-40.0, -50.0, 40.0]])
    dense = Dense(fixed, fixed + np.array([[3.0, 0, 0], [3.0, 4.0, 0]]), np.array([2.0, 7.0]))
    field = DisplacementField(np.zeros((*images.fixed.hu.shape, 3)) + np.array([3.0, 0, 0]), AFFINE)
    first, second, *rest = score(images, field, field, dense)["by_depth"]
    assert (first["from_mm"], first["to_mm"], first["n"], first["mm"]["mean"]) == (0, 5, 1, pytest.approx(0, abs=1e-9))
    assert (second["from_mm"], second["to_mm"], second["n"], second["mm"]["p95"]) == (5, 10, 1, pytest.approx(4.0))
    assert all(told["mm"] is None for told in rest)


def test_the_page_tells_ours_and_elastix_by_depth() -> None:
    def classes(mm: float) -> list[dict[str, Any]]:
        return errors_by_depth({"mm": np.full(3, mm)}, np.array([1.0, 6.0, 12.0]))

    ours = {"by_depth": classes(1.5), "by_depth_whole": classes(0.9), "seconds": 3.0, "seconds_registered": 7.0}
    peer = {"by_depth": classes(2.0), "seconds": 27.0}
    rows = {"lung mask": peer}
    bare = {"name": "bare", "ours": {"by_depth_whole": []}, "elastix_rows": None}  # no dense truth
    told = depth_table([{"name": "one", "ours": ours, "elastix_rows": rows}, bare])
    assert "| case | program | 0-5 mm | 5-10 mm | 10-20 mm | s |" in told
    assert "| one | ours, all of phase 1 | 0.90 / 0.90 | 0.90 / 0.90 | 0.90 / 0.90 | 7.0 |" in told
    assert "| one | ours, free form | 1.50 / 1.50 | 1.50 / 1.50 | 1.50 / 1.50 | 3.0 |" in told
    assert "| one | elastix, lung mask | 2.00 / 2.00 | 2.00 / 2.00 | 2.00 / 2.00 | 27.0 |" in told
    assert "bare" not in told
    assert depth_table([bare]) == ""


def test_score_counts_the_folded_half(images: Images) -> None:
    vectors = np.zeros((*images.fixed.hu.shape, 3))
    x = images.fixed.grid.points()[..., 0]
    vectors[..., 0] = np.where(x < -34.0, -1.5 * (x + 34.0), 0.0)
    field = DisplacementField(vectors, AFFINE)
    row = score(images, field, field)
    assert row["min_det"] == pytest.approx(-0.5)
    assert row["folded_share"] == pytest.approx(18 / 36)


def test_exponent_of_a_power_law() -> None:
    rows = [{"voxels": n, "seconds": 3e-6 * n**0.8} for n in (1e5, 1e6, 1e7)]
    assert exponent(rows, "seconds") == pytest.approx(0.8)


def test_isolated_returns_values_and_errors() -> None:
    assert isolated(divmod, 7, 3) == (2, 1)
    with pytest.raises(ZeroDivisionError):
        isolated(divmod, 7, 0)


def test_without_elastix_its_row_is_null(images: Images, monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    mine: dict[str, Any] = dict.fromkeys((*AGREED, "seconds_phase1", "seconds_cold", "seconds_spine"), 1.0)
    cost = {"sizes": [], "exponent_seconds": 1.0, "exponent_mb": 1.0}
    monkeypatch.setattr(bench, "elastix_version", lambda: None)
    monkeypatch.setattr(bench, "isolated", lambda function, *_: Ours(mine, images))
    monkeypatch.setattr(bench, "measure_cost", lambda _: cost)
    result = bench_registration([tmp_path / "case"])
    [case] = result["cases"]
    assert (case["name"], case["elastix"]) == ("case", None)
    assert set(case["ours"]) >= AGREED
    assert case["rigid"]["tre_mean"] == pytest.approx(np.sqrt(27))
    assert result["cost"] == cost
    assert "itk-elastix is not installed" in table(result)


def test_the_page_counts_where_we_are_no_worse() -> None:
    ours = {"tre_mean": 0.5, "tre_p95": 2.0, "tre_max": 3.0, "seconds": 4.0, "peak_mb": 1, "min_det": 1}
    ours |= {"folded_share": 0.0, "seconds_phase1": 1.0, "seconds_cold": 1.0, "seconds_spine": 1.0}
    peer = ours | {"tre_mean": 0.7, "tre_p95": 1.5, "seconds": 26.0}
    case = {"name": "one", "ours": ours, "rigid": ours, "elastix": peer, "elastix_rows": {"lung mask": peer}}
    cost = {"sizes": [], "exponent_seconds": 1.0, "exponent_mb": 1.0}
    made = page({"cases": [case], "cost": cost, "elastix_version": "1"})
    assert made.endswith("| one | 6.5 x | yes | no | yes |\n")


def test_a_name_and_a_seed_make_a_phantom(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    made: list[Any] = []
    monkeypatch.setattr(bench, "write_phantom", lambda *given: made.append(given[:3]))
    assert case_folder(Path("small-left:12"), tmp_path, quiet) == tmp_path / "small-left-12"
    assert made == [("small-left", tmp_path / "small-left-12", 12)]
    assert case_folder(Path("some/folder"), tmp_path, quiet) == Path("some/folder")
    assert len(made) == 1


def test_the_study_s_scene_moves_as_its_truth_says() -> None:
    pair = make_pair(Scene(noise_hu=0.0), 0)
    fixed, moving = pair.fixed.volume, pair.moving.volume
    there = interpolate(moving.hu, moving.grid, pair.truth, 0.0)
    here = interpolate(fixed.hu, fixed.grid, pair.probes, 0.0)
    assert np.corrcoef(here, there)[0, 1] > 0.95
    still = interpolate(moving.hu, moving.grid, pair.probes, 0.0)
    assert np.corrcoef(here, still)[0, 1] < 0.5


def test_a_finished_sweep_is_read_and_not_run_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    ran: list[str] = []

    def row(axis: str, _values: Any) -> list[dict[str, Any]]:
        ran.append(axis)
        names = ("plain", "masked", "ours")
        return [{axis: 1.0, "method": m, "start_mm": 2.0, "tre_mean": 0.5, "success": 1.0} for m in names]

    monkeypatch.setattr(stability, "sweep", row)
    monkeypatch.setattr(stability, "spine_sweep", lambda: [{"spine": "whole", "right": 2}])
    first = stability.stability_registration(tmp_path, quiet)
    assert stability.stability_registration(tmp_path, quiet) == first
    assert ran == list(stability.AXES)
    assert "| 1 | masked | 2 | 0.5 | 1 |" in (tmp_path / "tables.md").read_text()
    assert (tmp_path / "stability-registration.png").stat().st_size > 1000


@pytest.mark.skipif(elastix_version() is None, reason="itk-elastix is not installed")
def test_elastix_finds_a_known_shift_by_value_and_sign(
    images: Images, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    settings = ElastixSettings(grid_mm=24.0, levels=1, iterations=100, samples=1000)
    run = isolated(run_elastix, images.fixed, blobs((4, -3, 2)), images.usable, settings)
    middle = images.fixed.grid.to_ras(np.array([[18.0, 20.0, 16.0]]))
    np.testing.assert_allclose(run.moving_from_fixed.displacement(middle)[0], [4, -3, 2], atol=0.4)
    assert run.moving_from_fixed.grid.same_as(images.fixed.grid)
    assert not list(tmp_path.iterdir())
