"""Benchmark of the poroelastic lung: the other program agrees, and the tables hold what readers rely on."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import csr_matrix

from poro.fem import Tissue
from poro.mesh import TetMesh
from poro.mesh.tetmesh import dihedral_angles
from vatsloc.study.bench import cost_poro as cost
from vatsloc.study.bench import poro as bench
from vatsloc.study.bench.getfem_peer import getfem_python
from vatsloc.study.bench.poro_lung import HILUM_CENTRE, RADII_MM, lung, smooth_wall, system_of, wall_level
from vatsloc.study.stability import poro as stability
from vatsloc.study.stability import poro_mesh as stability_mesh
from vatsloc.study.stability.poro_mesh import with_slivers
from vatsloc.study.tables import Row, markdown


def test_getfem_gives_the_same_displacements() -> None:
    if getfem_python() is None:
        pytest.skip("GetFEM is not installed")
    result = bench.compare_getfem(3_000, 4, lambda _: None)
    assert result is not None
    assert result["rel_diff_free"] < 1e-8
    assert result["rel_diff_contact"] < 1e-3
    assert min(value["nodes in contact"] for value in result["values"]) > 20
    assert all(row["times faster"] == row["GetFEM s"] / row["ours s"] > 0 for row in result["speed"])
    times = {row["what"]: row["times faster"] for row in result["speed"]}
    assert result["speedup_single"] == times["wall, warm"]
    assert result["speedup_sweep4"] == times["wall, 4 values, warm"]
    assert result["speedup_sweep4_cold"] == times["wall, 4 values, cold"]
    json.dumps(result)
    told = bench.page({"getfem": result, "sizes": []})
    assert "| wall, warm |" in told
    assert "Cost" not in told


def test_without_getfem_the_comparison_is_null(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "getfem_python", lambda: None)
    told: list[str] = []
    assert bench.compare_getfem(3_000, 4, told.append) is None
    assert "not installed" in told[0]
    assert "no comparison" in bench.table({"sizes": [], "getfem": None})


@pytest.mark.parametrize("tets", [3_000, 12_000])
def test_lung_has_the_size_and_hold_asked_for(tets: int) -> None:
    body = lung(tets)
    assert len(body.mesh.tets) == pytest.approx(tets, rel=0.25)
    assert_allclose(wall_level(body.mesh.boundary.points), 0, atol=1.0)
    assert np.linalg.norm(body.mesh.points[body.hilum] - HILUM_CENTRE, axis=1).max() < 22
    assert (np.abs(body.mesh.points) < RADII_MM + 0.5).all()


def test_sampled_wall_equals_its_expression() -> None:
    system = system_of(lung(2_000), Tissue(), smooth_wall())
    moved = system.wall.rest + np.random.default_rng(0).uniform(-8, 8, system.wall.rest.shape)
    assert_allclose(system.wall.level.evaluate(moved)[0], wall_level(moved), atol=1e-3)


def test_exponent_of_a_power_law() -> None:
    rows = [
        {"tets": n, "contact_nodes": 9, "solver": "factor", "seconds": {"contact": 3e-6 * n**1.4}}
        for n in (5_000, 40_000, 300_000)
    ]
    assert cost.exponent(rows, "seconds", "contact") == pytest.approx(1.4)
    assert cost.exponent(rows[:1], "seconds", "contact") is None
    *_, last, slopes = cost.cost_rows(rows, "seconds")
    assert last["contact"] == pytest.approx(3e-6 * 300_000**1.4)
    assert (last["mesh"], slopes["contact"], slopes["mesh"]) == ("-", "1.40", "-")


def test_sweep_covers_the_range_of_a_fit() -> None:
    vectors = np.array([theta.vector() for theta in bench.sweep_thetas()])
    assert len(vectors) == 50
    width = np.array([3, 0.27, 12])
    assert_allclose(vectors.min(axis=0) / width, np.array([-10, 0.65, 0]) / width, atol=0.12)
    assert_allclose(vectors.max(axis=0) / width, np.array([-7, 0.92, 12]) / width, atol=0.12)


def test_penalty_contact_nears_the_active_set_from_behind_the_wall() -> None:
    """The stiffer the penalty, the less the penetration and the smaller the difference to Signorini's solution."""
    exact, soft, stiffer = stability.contact_methods((1_500,))[:3]
    assert exact["deepest_mm"] < 2e-3
    assert soft["deepest_mm"] > 5 * stiffer["deepest_mm"] > 10 * exact["deepest_mm"]
    assert stiffer["rel_diff"] < 0.2 * soft["rel_diff"] < 0.05


def test_finer_meshes_touch_the_same_share_without_penetration() -> None:
    coarse, fine = stability.contact_meshes((1_500, 3_000))
    assert fine["off_finest_mm"] < 1e-12 < 0.1 < coarse["off_finest_mm"] < 2
    assert max(coarse["deepest_mm"], fine["deepest_mm"]) < 1e-6 < 0.1 < fine["penalty_deepest_mm"] < 0.3
    assert coarse["touching_percent"] == pytest.approx(fine["touching_percent"], abs=2)
    assert coarse["mean_pressure_pa"] == pytest.approx(fine["mean_pressure_pa"], rel=0.1)
    assert max(coarse["iterations"], fine["iterations"]) <= 9


@pytest.mark.parametrize("degrees", [8.0, 0.3])
def test_slivers_have_the_angle_asked_for(degrees: float) -> None:
    good = lung(1_500).mesh
    mesh, moved = with_slivers(good, degrees, share=0.1)
    assert dihedral_angles(good).min() > 12
    assert len(moved) == math.ceil(0.1 * (len(good.points) - len(good.boundary.nodes)))
    for node in moved:
        around = TetMesh(mesh.points, mesh.tets[(mesh.tets == node).any(axis=1)])
        assert dihedral_angles(around).min() == pytest.approx(degrees, rel=1e-6)
    assert (mesh.volumes > 0).all()
    assert mesh.volumes.sum() == pytest.approx(good.volumes.sum(), rel=1e-12)
    assert_allclose(mesh.points[mesh.boundary.nodes], good.points[good.boundary.nodes], atol=0)


def test_slivers_slow_multigrid_and_leave_the_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stability_mesh, "ANGLES_DEG", (5.0, 0.1))
    good, mild, bad = stability_mesh.slivers(1_500)
    assert [good["min_dihedral"], mild["min_dihedral"], bad["min_dihedral"]] == pytest.approx([20.3, 5, 0.1], rel=0.05)
    assert bad["condition"] > 10 * mild["condition"] > 10 * good["condition"]
    assert bad["multigrid_iterations"] > 1.5 * mild["multigrid_iterations"] > 1.5 * good["multigrid_iterations"] > 15
    assert max(bad["factor_residual"], bad["multigrid_off"]) < 1e-9
    assert good["factor_off_max_mm"] == 0 < mild["factor_off_mm"] < 0.3  # the mesh itself is 1.1 mm off
    assert bad["factor_off_mm"] < 2 * mild["factor_off_mm"]
    assert bad["contact_iterations"] <= good["contact_iterations"] + 1


def test_condition_number_is_that_of_dense_algebra() -> None:
    root = np.random.default_rng(1).normal(size=(40, 40))
    matrix = root @ root.T + np.eye(40)
    found = stability_mesh._condition(csr_matrix(matrix), lambda b: np.linalg.solve(matrix, b))
    assert found == pytest.approx(np.linalg.cond(matrix), rel=1e-2)


def test_linear_elements_lock_only_near_incompressibility() -> None:
    rows = stability_mesh.towards_incompressible((1_500, 6_000))
    errors = [row["rel_error_6000"] for row in rows]
    assert (np.diff(errors) > 0).all()
    assert errors[0] < 0.1
    assert errors[-1] > 0.7
    assert rows[0]["order"] > 1.7
    assert abs(rows[-1]["order"]) < 0.2


def test_small_hila_swing_invert_and_are_refused() -> None:
    wide, *between, narrow, refused = stability.small_hila(1_500)
    assert wide["hung_inverted_percent"] == 0 < narrow["hung_inverted_percent"] < 5
    assert narrow["hung_mean_mm"] > 10 * wide["hung_mean_mm"]
    assert [row["status"] for row in (wide, *between, narrow)] == ["SOLVED, SOLVED"] * (len(between) + 2)
    assert narrow["gentle_mean_mm"] == pytest.approx(wide["gentle_mean_mm"], rel=0.2)
    assert 0 < narrow["strong_min_det"] < wide["strong_min_det"] < wide["gentle_min_det"] < 1
    assert (refused["hilum_nodes"], refused["hung_min_det"]) == (2, "-")
    assert refused["status"].startswith("refused: hilum needs three distinct nodes")


def test_page_of_the_stability_study_draws_its_numbers_from_the_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    soft = {"method": "penalty 1 kPa/mm", "deepest_mm": 0.25, "iterations": 8}
    rows: dict[str, list[Row]] = {
        "pressure_bounds": [{"kappa_b": 1e-5, "min_pa_lumped": -0.4, "min_pa_consistent": -321.0}],
        "inverted_elements": [
            {"kappa_b": 1e-8, "linear_inverted_percent": 1.5, "linear_min_det": -0.2, "finite_min_det": 0.5}
            | {"linear_volume": 0.5, "finite_volume": 0.63, "finite_load_carried": 1.0}
        ],
        "towards_incompressible": [
            {"poisson": nu, "rel_error_3000": error, "rel_error_24000": error / 4, "order": 2.0}
            for nu, error in ((0.35, 0.1), (0.4999, 0.84))
        ],
        "contact_methods": [
            {"method": "active set", "deepest_mm": 2e-9, "iterations": 7},
            soft,
            soft | {"deepest_mm": 3.0, "iterations": 40},
        ],
        "contact_meshes": [
            {"tets": tets, "iterations": 7, "touching_percent": 36.0, "off_finest_mm": off}
            | {"penalty_deepest_mm": 0.2, "penalty_off_mm": 1.0}
            for tets, off in ((1500, 1.25), (24000, 0.0))
        ],
        "slivers": [
            {"min_dihedral": angle, "multigrid_iterations": steps, "factor_residual": 1e-12, "min_det": det}
            | {"factor_off_mm": 0.1, "factor_off_max_mm": 1.1}
            for angle, steps, det in ((20.0, 16, 0.5), (0.1, 63, -0.1), (0.01, ">200", -0.3))
        ],
        "small_hila": [
            {"hilum_nodes": nodes, "hung_mean_mm": mean, "hung_min_det": det, "gentle_mean_mm": 9.0}
            | {"gentle_min_det": 0.7, "strong_min_det": 0.2, "status": status}
            for nodes, mean, det, status in ((78, 53.0, 0.6, "SOLVED"), (3, 6700.0, -1.0, "SOLVED"))
        ]
        + [
            {
                "hilum_nodes": 2,
                "hung_min_det": "-",
                "strong_min_det": "-",
                "gentle_min_det": "-",
                "status": "refused: x",
            }
        ],
    }
    monkeypatch.setattr(stability, "STUDIES", {name: (lambda held=held: held) for name, held in rows.items()})
    assert stability.stability_poro(tmp_path, lambda _: None) == rows
    told = (tmp_path / "tables.md").read_text()
    for words in (
        "within 0.4 Pa of its range",
        "by up to 321 Pa",
        "up to 1.5 % of this smooth lung's elements invert; det F falls to -0.20",
        "up to 13 points more",
        "by 21 % at nu 0.4999",
        "0.25 mm of penetration remain",
        "at 40 steps",
        "1.2 mm off the finest",
        "63 at 0.1, 1 of 3 meshes not solved in 200",
        "invert from 0.1 degrees down",
        "(53 mm to 6.7 m under linear strain), and elements invert from 3 nodes down",
        "2 nodes are refused.",
        "## small_hila",
    ):
        assert words in told
    assert len(list(tmp_path.glob("*.csv"))) == len(rows)
    assert len(list(tmp_path.glob("*.png"))) == len(stability.PLOTS)


def test_rows_become_a_markdown_table() -> None:
    text = markdown([{"kappa_b": 1e-8, "phi": 0.5}, {"kappa_b": 1e-7, "phi": 0.25}])
    assert text.splitlines()[2:] == ["| 1e-08 | 0.5 |", "| 1e-07 | 0.25 |"]
