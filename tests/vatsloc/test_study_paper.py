"""The paper's experiments: settings of the variants, what is kept of a run, tables and tests by value."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vatsloc.errors import InputRefused
from vatsloc.study.cohort import scored
from vatsloc.study.cohort.scored import Tissue
from vatsloc.study.paper import paper
from vatsloc.study.paper.draw import page
from vatsloc.study.paper.paper import CaseRuns, Run, read_runs, run_paper, settings_for


def runs(case: str = "one") -> CaseRuns:
    """C halves the errors of B, and B those of A; the diaphragm changes nothing; the paper's C has no answer."""
    errors = np.linspace(4.0, 8.0, 9)
    theta = (2e-8, 0.5, 12.0)
    found = [Run("", name, tuple(4 * errors)) for name in paper.BEFORE]
    found += [
        Run("vatsloc", name, tuple(scale * errors), 1.25, theta)
        for name, scale in (("A", 2.0), ("B", 1.0), ("C", 0.5), (paper.STILL, 0.5))
    ]
    found.append(Run("paper's model", "C", failed="the contact did not settle"))
    return CaseRuns(case, tuple(found))


def test_variants_switch_off_what_the_paper_leaves_out() -> None:
    a, b, c = (settings_for(v, "vatsloc") for v in ("A", "B", "C"))
    assert not a.registration.on
    assert b.registration.on
    assert not a.model.hilum
    assert not b.model.hilum
    assert c.model.hilum
    still = settings_for(paper.STILL, "paper's model")
    assert not still.model.diaphragm
    assert still.model.cost == "plain"
    assert not still.keypoints.on
    assert not still.residual.on


def test_the_page_holds_means_tests_and_parameters() -> None:
    lines = {line.split(" | ")[0]: line for line in page([runs()]).splitlines()}
    errors = next(line for line in page([runs()]).splitlines() if line.startswith("| one"))
    assert "24.00 ± 5.48" in errors
    assert "12.00 ± 2.74 | 6.00 ± 1.37 | 3.00 ± 0.68 | 3.00 ± 0.68 | 1.25 |" in errors
    assert "- one, paper's model, C: the contact did not settle" in lines
    tests = [line for line in page([runs()]).splitlines() if line.startswith("| one")]
    # Nine pairs that all fall: two-sided exact p = 2 / 2**9.
    assert tests[3] == "| one | 3.9e-03 (C) | 3.9e-03 (B) | 3.9e-03 (C) | 1.0e+00 (C, diaphragm still) |"
    assert tests[4].endswith("| 2e-08 | 0.5 | 12 |")


def test_what_was_run_is_kept_and_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = runs("kept")
    (tmp_path / "kept.json").write_text(json.dumps(asdict(kept)), encoding="utf-8")
    monkeypatch.setattr(paper, "measure_case", lambda folder: pytest.fail(f"{folder} is run again"))
    (tmp_path / "cases" / "kept").mkdir(parents=True)
    assert run_paper([tmp_path / "cases" / "kept"], tmp_path) == [kept]


def test_a_case_that_is_refused_has_no_answer_and_stops_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise InputRefused("too little is seen")

    for name in ("read_case", "read_truth"):
        monkeypatch.setattr(paper, name, lambda folder: folder)
    monkeypatch.setattr(paper, "prepare", refuse)
    found = paper.measure_case(tmp_path / "dark")
    assert {run.failed for run in found.runs} == {"too little is seen"}
    assert len(found.runs) == len(paper.VARIANTS) * len(paper.KINDS)
    assert "- dark, vatsloc, C: too little is seen" in page([found])


def test_landmarks_without_truth_stay_unknown(tmp_path: Path) -> None:
    case = CaseRuns("x", (Run("vatsloc", "C", (1.0, None)),))
    (tmp_path / "x.json").write_text(json.dumps(asdict(case)), encoding="utf-8")
    found = read_runs(tmp_path / "x.json").run("vatsloc", "C")
    assert found is not None
    np.testing.assert_array_equal(found.errors, [1.0, np.nan])


def test_tissue_is_told_by_depth_and_only_where_both_scans_show_it(monkeypatch: pytest.MonkeyPatch) -> None:
    ct = np.arange(18.0).reshape(6, 3)
    off = np.array([1.0, 3.0, 5.0, 7.0, 50.0, 9.0])  # mm that each point is off by
    deflated = ct + np.stack([off, 0 * off, 0 * off], axis=1)
    seen = [True, True, True, True, False, True]
    truth: Any = SimpleNamespace(
        dense=np.stack([ct, ct + 100, deflated], axis=1), fields_of_view={"inflated": "i", "deflated": "d"}
    )
    shown = {"i": [True] * 6, "d": seen}
    monkeypatch.setattr(scored, "seen_in", lambda view, _points: np.array(shown[view]))
    monkeypatch.setattr(scored, "stuff", lambda *_mesh: None)
    depths = {0: -1.0, 1: 4.9, 2: 5.0, 3: 30.0, 5: 12.0}
    monkeypatch.setattr(
        scored, "depth_below_pleura", lambda _mesh, points: np.array([depths[int(x) // 3] for x in points[:, 0]])
    )
    prepared: Any = SimpleNamespace(lung_ct=SimpleNamespace(inside=None, ras_from_ijk=None))
    maps: Any = SimpleNamespace(def_from_ct=lambda points: points)
    tissue = Tissue.of(prepared, truth)
    found = paper._by_depth(tissue, maps)
    assert found[0] == pytest.approx((2.0, 2.9))  # what lies outside the lung counts as its rim
    assert [mm[0] for mm in found] == [2.0, 5.0, 9.0, None, 7.0]
    assert len(tissue.errors_mm(maps)) == 5
    truth.dense = None
    assert paper._by_depth(Tissue.of(prepared, truth), maps) == ()


def test_the_page_tells_tissue_by_depth(tmp_path: Path) -> None:
    classes = ((2.0, 2.9), (5.0, 5.0), (9.0, 9.0), (None, None), (7.0, 7.25))
    case = CaseRuns("one", (Run("vatsloc", "C", (1.0, 2.0), theta=(1.0, 2.0, 3.0), tissue_mm=classes),))
    (tmp_path / "one.json").write_text(json.dumps(asdict(case)), encoding="utf-8")
    assert read_runs(tmp_path / "one.json") == case
    lines = [line for line in page([case]).splitlines() if line.startswith("| one")]
    assert lines[1] == "| one | " + 5 * " | " + "2.00 / 2.90 | 5.00 / 5.00 | 9.00 / 9.00 |  | 7.00 / 7.25 |"
