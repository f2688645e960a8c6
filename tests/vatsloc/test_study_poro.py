"""Benchmark of the poroelastic lung: the other program agrees, and the tables hold what readers rely on."""

from __future__ import annotations

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from poro.tissue import Tissue
from vatsloc.study import bench_poro as bench
from vatsloc.study import cost_poro as cost
from vatsloc.study import stability_poro as stability
from vatsloc.study.getfem_peer import getfem_python
from vatsloc.study.poro_lung import HILUM_CENTRE, RADII_MM, lung, smooth_wall, system_of, wall_level
from vatsloc.study.tables import markdown


def test_getfem_gives_the_same_displacements() -> None:
    if getfem_python() is None:
        pytest.skip("GetFEM is not installed")
    result = bench.compare_getfem(3_000, 4, lambda _: None)
    assert result is not None
    assert result["rel_diff_free"] < 1e-8
    assert result["rel_diff_contact"] < 1e-3
    assert min(value["nodes in contact"] for value in result["values"]) > 20
    assert all(row["times faster"] == row["GetFEM s"] / row["ours s"] > 0 for row in result["speed"])
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
    moved = system.obstacle.rest + np.random.default_rng(0).uniform(-8, 8, system.obstacle.rest.shape)
    assert_allclose(system.obstacle.level.evaluate(moved)[0], wall_level(moved), atol=1e-3)


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


def test_rows_become_a_markdown_table() -> None:
    text = markdown([{"kappa_b": 1e-8, "phi": 0.5}, {"kappa_b": 1e-7, "phi": 0.25}])
    assert text.splitlines()[2:] == ["| 1e-08 | 0.5 |", "| 1e-07 | 0.25 |"]
