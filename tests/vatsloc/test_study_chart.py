"""The chart: its points, its front, what it remembers between runs, and its variants of the registration."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from poro.breathing.affine import affine_to_points
from registration.ffd import FfdSettings, Weights
from registration.images.resample import resample
from registration.maps.rigid import RigidTransform
from registration.sliding import LungImage
from registration.volume import Mask, Volume
from tests.vatsloc.browser import CHROMIUM, asked_by_the_page, visit
from vatsloc.errors import CaseError, InputRefused
from vatsloc.study.chart import chart
from vatsloc.study.chart.chart import Row, append_row, read_rows, run_chart
from vatsloc.study.chart.draw import MARK, NUMBER, interactive, places, require_matplotlib, write_chart
from vatsloc.study.chart.points import dominating, points_of, told_of_presets
from vatsloc.study.chart.tables import page
from vatsloc.study.chart.variants import VARIANTS, chosen_variants, masked_only, plain


def row(variant: str, case: str, *numbers: float) -> Row:
    """Mean, 95 % and seconds of every phase, then the nodule; processors take twice as long, tissue is as far off as
    the chain's landmarks and twice so near the pleura."""
    names = [f"{phase}_{what}" for phase in ("phase1", "phase2", "chain") for what in ("mean", "p95", "seconds")]
    named: dict[str, Any] = dict(zip(names, numbers, strict=False))
    cpu: dict[str, Any] = {f"{p}_cpu": 2 * named[f"{p}_seconds"] for p in ("phase1", "phase2", "chain")}
    tissue = {f"tissue_{what}": named[f"chain_{what}"] for what in ("mean", "p95")}
    tissue |= {f"pleura_{what}": 2 * named[f"chain_{what}"] for what in ("mean", "p95")}
    after: dict[str, Any] = {"after_seconds": named["phase2_seconds"] + 3, "after_cpu": cpu["phase2_cpu"] + 6}
    return Row(variant, case, nodule_mm=numbers[9], load=1, **named, **cpu, **after, **tissue)


ROWS = [
    row("rigid", "a", 10, 16, 4, 17, 25, 2, 25, 35, 6, 30),
    row("rigid", "b", 6, 12, 6, 15, 21, 2, 21, 31, 8, 20),
    row("fast", "a", 0.5, 1.0, 10, 0.9, 2.0, 12, 1.0, 2.5, 22, 0.6),
    row("fast", "b", 0.3, 0.6, 12, 0.7, 1.6, 14, 0.8, 1.9, 26, 0.4),
    row("balanced", "a", 0.6, 0.9, 20, 0.5, 1.5, 30, 0.6, 1.4, 50, 0.3),
    row("balanced", "b", 0.4, 0.5, 20, 0.5, 1.5, 30, 0.6, 1.4, 50, 0.3),
    row("alone", "a", 0.6, 0.9, 20, 2.0, 4.0, 10, 2.1, 4.4, 30, 2.0),
    Row("alone", "b", failed="the contact did not settle"),
]


def test_points_average_errors_over_cases_and_take_the_median_of_seconds() -> None:
    points = {(p.phase, p.variant): p for p in points_of(ROWS, VARIANTS)}
    rigid = points["chain", "rigid"]
    assert (rigid.mean, rigid.p95, rigid.seconds, rigid.n, rigid.complete) == (23, 33, 7, 2, True)
    assert (points["chain", "alone"].n, points["chain", "alone"].complete) == (1, False)
    assert ("phase1", "alone") not in points  # its change of pose is that of balanced
    only_b = {(p.phase, p.variant): p for p in points_of(ROWS, VARIANTS, case="b")}
    assert only_b["phase1", "fast"].mean == 0.3
    by_cpu = {(p.phase, p.variant): p for p in points_of(ROWS, VARIANTS, "cpu")}
    assert by_cpu["chain", "rigid"].seconds == 14
    near = points["pleura", "rigid"]
    assert (near.mean, near.p95, near.seconds) == (46, 66, 7)  # its seconds are the chain's
    numbers = [points["chain", name].number for name in ("rigid", "alone", "fast", "balanced")]
    assert numbers == [1, 2, 3, 4]  # in the order of the variants, in every panel
    assert only_b["chain", "balanced"].number == 4


def test_the_front_holds_what_nothing_beats_in_both() -> None:
    points = {(p.phase, p.variant): p for p in points_of(ROWS, VARIANTS)}
    assert points["phase1", "fast"].front == ("mean", "p95")
    assert points["phase1", "balanced"].front == ("p95",)
    assert points["phase1", "rigid"].front == ("mean", "p95")
    # "alone" is faster than balanced in phase 2, but a case is missing: it neither leads nor beats.
    assert points["phase2", "alone"].front == ()
    assert points["phase2", "fast"].front == ("mean", "p95")
    panel = [p for (phase, _), p in points.items() if phase == "phase1"]
    beaten = dominating(points["phase1", "balanced"], panel, "mean")
    assert beaten is not None
    assert beaten.variant == "fast"


def test_a_word_on_every_preset_names_what_beats_it() -> None:
    told = told_of_presets(points_of(ROWS, VARIANTS))
    assert (
        "balanced, Phase 1: CT to inflated: not on the front of the mean: fast has 0.40 mm in 11 s, it 0.50 mm in 20 s."
        in told
    )
    assert "fast, Whole chain: CT to deflated: on the front of the mean (0.90 mm in 24 s)." in told
    assert len(told) == 2 * 4 * 2


def test_rows_survive_the_file_and_a_stranger_s_table_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "runs.csv"
    assert read_rows(path) == []
    for row in ROWS:
        append_row(path, row)
    back = read_rows(path)
    assert back[:-1] == ROWS[:-1]
    assert back[-1].failed == "the contact did not settle"
    assert math.isnan(back[-1].chain_mean)
    path.write_text(path.read_text() + "fast,c,not a number\n")
    with pytest.raises(InputRefused, match="damaged line"):
        read_rows(path)
    path.write_text("variant,case\n")
    with pytest.raises(InputRefused, match="not a table of this version"):
        read_rows(path)


def test_pairs_that_are_there_are_not_run_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    ran: list[tuple[str, str]] = []

    def measured(folder: Path, variants: Mapping[str, Any]) -> Iterator[Row]:
        for name in variants:
            ran.append((folder.name, name))
            yield Row(name, folder.name, chain_mean=0.5, chain_cpu=30.0)

    monkeypatch.setattr(chart, "measure_case", measured)
    monkeypatch.setattr(chart, "warm_up", lambda folder: ran.append((folder.name, "warm")))
    cases = [tmp_path / "a", tmp_path / "b"]
    some = chosen_variants(["fast", "balanced"])
    said: list[str] = []
    assert len(run_chart(cases[:1], some, tmp_path, said.append)) == 2
    assert said[1:] == ["a, fast: chain 0.50 mm, 30 s", "a, balanced: chain 0.50 mm, 30 s"]
    rows = run_chart(cases, chosen_variants(["balanced", "rigid"]), tmp_path)
    assert ran[:3] == [("a", "warm"), ("a", "fast"), ("a", "balanced")]
    assert ran[3:] == [("a", "warm"), ("a", "rigid"), ("b", "balanced"), ("b", "rigid")]
    assert [(row.case, row.variant) for row in rows][-2:] == [("b", "balanced"), ("b", "rigid")]
    run_chart(cases, chosen_variants(["balanced", "rigid"]), tmp_path)
    assert len(ran) == 7


def test_every_variant_s_settings_are_valid_and_unknown_names_are_refused() -> None:
    assert VARIANTS["tetrahedra-5"].settings.mesh.model_edge_mm == 5
    assert not VARIANTS["paper-cost-alone"].settings.residual.on
    assert not VARIANTS["paper-cost-alone"].settings.keypoints.on
    assert VARIANTS["alone"].settings.keypoints.on
    assert VARIANTS["fast"].settings.registration.grid_mm == 20
    for variant in VARIANTS.values():
        assert variant.settings.gates.min_overlap == 0.4
    with pytest.raises(CaseError, match="slow: no such variant; choose from rigid, affine"):
        chosen_variants(["rigid", "slow"])
    assert list(chosen_variants(None)) == list(VARIANTS)


def pair(mapped: Any) -> tuple[Volume, Volume, Mask]:
    """fixed(x) = moving(mapped(x)), balls in a box, and a mask of all of it."""
    affine = np.diag([4.0, 4, 4, 1])
    grid = Volume(np.zeros((30, 30, 30), dtype=np.float32), affine).grid
    hu = np.full(grid.shape, -800.0)
    for centre in np.random.default_rng(2).uniform(10, 106, (60, 3)):
        hu += 700 * np.exp(-np.sum((grid.points() - centre) ** 2, axis=-1) / 72)
    moving = Volume(hu.astype(np.float32), affine)
    return resample(moving, grid, mapped), moving, Mask(np.ones(grid.shape, dtype=bool), affine)


def test_the_stiff_free_form_of_the_variant_affine_is_an_affine_map() -> None:
    matrix = np.array([[1.04, 0.02, 0], [0, 0.97, 0.01], [-0.02, 0, 1.02]])
    fixed, moving, mask = pair(lambda x: (x - 60) @ matrix.T + 60 + [2, -1, 3])
    stiff = VARIANTS["affine"].settings.registration
    settings = FfdSettings(stiff.grid_mm, stiff.levels, 4.0, None, weights=Weights(bending=stiff.bending))
    images = LungImage(fixed, mask, mask), LungImage(moving, mask)
    found = plain(*images, settings, RigidTransform.identity()).moving_from_fixed
    points = np.random.default_rng(3).uniform(20, 96, (200, 3))
    affine = affine_to_points(points, found(points))
    assert np.abs(affine(points) - found(points)).max() < 0.05
    truth = (points - 60) @ matrix.T + 60 + np.array([2, -1, 3])
    assert np.linalg.norm(truth - points, axis=1).mean() > 3
    assert np.linalg.norm(found(points) - truth, axis=1).mean() < 0.5  # an eighth of a voxel


@pytest.mark.parametrize("register", [plain, masked_only])
def test_variants_of_the_registration_find_a_shift_by_value_and_sign(register: Any) -> None:
    shift = np.array([4.0, -3, 2])
    fixed, moving, seen = pair(lambda x: x + shift)
    points, affine = fixed.grid.points(), fixed.ras_from_ijk
    fixed_lung = Mask(np.linalg.norm(points + shift - 60, axis=-1) < 40, affine)
    moving_lung = Mask(np.linalg.norm(points - 60, axis=-1) < 40, affine)
    images = LungImage(fixed, fixed_lung, seen), LungImage(moving, moving_lung)
    fit = register(*images, FfdSettings(24.0, 2, 4.0, None), RigidTransform.identity())
    middle = np.array([[60.0, 60, 60]])
    np.testing.assert_allclose(fit.moving_from_fixed(middle) - middle, [shift], atol=0.3)


def test_the_chart_s_files_hold_its_numbers(tmp_path: Path) -> None:
    write_chart(ROWS, VARIANTS, tmp_path)
    table = (tmp_path / "chart.csv").read_text().splitlines()
    assert 'chain,1,rigid,"spine alone, in both phases",23,33,7,2,mean p95' in table
    svg = (tmp_path / "chart.svg").read_text()
    assert svg.startswith("<?xml")
    assert (tmp_path / "chart.png").stat().st_size > 20_000
    text = page(ROWS, points_of(ROWS, VARIANTS))
    assert "| alone | 2.00 / 4.00; 2.00 |  |" in text
    assert "| fast | 0.90 / 2.00; 0.60 | 0.70 / 1.60; 0.40 |" in text
    assert "| 3 | fast | preset fast | 0.90 | 2.20 | 24.0 | 2 | mean, 95 % |" in text
    assert "| balanced | 0.60 / 1.4; 1.20 / 2.8 | 0.60 / 1.4; 1.20 / 2.8 |" in text
    assert "- alone on b: the contact did not settle" in text


def test_the_page_says_what_the_model_is_worth_and_what_auto_saves() -> None:
    auto = replace(ROWS[4], variant="auto", chain_seconds=42.0, tissue_mean=0.7, nodule_mm=0.2, left_out="x, y")
    whole = replace(ROWS[4], left_out="x")
    elastic = replace(ROWS[4], variant="elastic", tissue_mean=1.8)
    rows = [whole, auto, elastic]
    text = page(rows, points_of(rows, VARIANTS))
    assert "| elastic | balanced | +1.20 | +1.20 |" in text
    assert "| a | y | 8.0 | +0.10 | -0.10 |" in text


def test_the_page_says_what_fewer_scans_cost_where_all_have_an_answer() -> None:
    two = replace(ROWS[4], variant="two-scans", chain_mean=0.9, pleura_mean=2.5, after_seconds=45.0, nodule_mm=0.5)
    none = Row("two-scans", "b", failed="nothing is seen")
    rows = [*ROWS[4:6], two, none]
    text = page(rows, points_of(rows, VARIANTS))
    assert "### Fewer scans: mean mm over a, and median s" in text
    assert "| balanced | CT, inflated and deflated CBCT | 33.0 | 0.60 | 0.60 | 1.20 | 0.30 |" in text
    assert "| two-scans | CT, deflated CBCT | 45.0 | 0.90 | 0.60 | 2.50 | 0.50 |" in text
    assert "one-scan" not in text
    assert "Fewer scans" not in page(ROWS, points_of(ROWS, VARIANTS))
    assert "Fewer scans" not in page([ROWS[5], none], points_of([ROWS[5], none], VARIANTS))


@pytest.mark.parametrize("crowd", [1, 6, 20])
def test_no_number_lies_on_another_or_on_a_mark(crowd: int) -> None:
    """Marks all within a few points of each other, in a panel as wide as the chart's."""
    marks = 150 + np.random.default_rng(crowd).normal(0, 6, (crowd, 2))
    spots = places(marks, np.array([0.0, 0.0, 300.0, 300.0]))
    for n, spot in enumerate(spots):
        others = np.delete(spots, n, axis=0)
        assert (np.abs(others - spot) > 2 * NUMBER).any(axis=1).all()
        assert (np.abs(marks - spot) > NUMBER + MARK).any(axis=1).all()
        assert (spot > NUMBER).all()
        assert (spot < 300 - NUMBER).all()


def test_without_matplotlib_nothing_is_run(monkeypatch: pytest.MonkeyPatch) -> None:
    require_matplotlib()
    monkeypatch.setattr("vatsloc.study.chart.draw.find_spec", lambda _name: None)
    with pytest.raises(CaseError, match="matplotlib is not installed"):
        require_matplotlib()


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_the_page_draws_every_point_and_asks_nothing_of_the_network(tmp_path: Path) -> None:
    html = tmp_path / "chart.html"
    rows = [*ROWS, replace(ROWS[0], variant="</script>", case="a")]
    html.write_text(interactive(rows, VARIANTS), encoding="utf-8")
    document, logged, network = visit(html, tmp_path)
    assert "CONSOLE" not in logged
    assert not asked_by_the_page(network)
    drawn = re.findall(r'data-variant="([^"]*)"', document)
    assert sorted(drawn) == sorted(p.variant for p in points_of(rows, VARIANTS))
    assert document.count('stroke="#009E73"') == 2 + 5  # the paper's errors, phase 1 and chain
    shown = re.search(r'<script type="application/json" id="data">(.*?)</script>', html.read_text(), re.DOTALL)
    assert shown is not None
    assert set(json.loads(shown[1])["sets"]) == {"all cases", "a", "b"}
