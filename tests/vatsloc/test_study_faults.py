"""The fault study: faults by value, and a page that counts what was noticed."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.testing import assert_allclose

from registration.verification import LeftOver
from vatsloc.study.bench import check as bench
from vatsloc.study.bench.check import bench_check, beside_truth, table
from vatsloc.study.stability.faults import FAULTS, LOBE_MM, LOBE_SHARE, page, score
from vatsloc.workflow.check import Checks
from vatsloc.workflow.gates import at_most

NODES = np.random.default_rng(3).normal(size=(400, 3)) * [40, 50, 60] + [10, 20, 30]
BEFORE = NODES + np.array([0.0, 30.0, 5.0])


@pytest.mark.parametrize("mm", [5, 10, 15])
def test_a_shift_moves_every_node_alike(mm: int) -> None:
    moved = FAULTS[f"shift {mm} mm"](BEFORE, NODES, np.random.default_rng(0)) - NODES
    assert_allclose(moved, np.broadcast_to(moved[0], moved.shape), atol=1e-12)
    assert np.linalg.norm(moved[0]) == pytest.approx(mm)


def test_a_turn_keeps_shape_and_middle() -> None:
    moved = FAULTS["turn 5 degrees"](BEFORE, NODES, np.random.default_rng(0))
    assert_allclose(moved.mean(axis=0), NODES.mean(axis=0), atol=1e-9)
    assert_allclose(np.linalg.norm(moved[0] - moved[1]), np.linalg.norm(NODES[0] - NODES[1]))
    assert np.linalg.norm(moved - NODES, axis=1).max() > 3


def test_a_lobe_is_a_part_and_shuffled_nodes_are_the_same_ones() -> None:
    off = np.linalg.norm(FAULTS["one lobe off 10 mm"](BEFORE, NODES, np.random.default_rng(0)) - NODES, axis=1)
    assert (off > 0).mean() == pytest.approx(LOBE_SHARE, abs=0.01)
    assert off.max() == pytest.approx(LOBE_MM)
    mixed = FAULTS["nodes in another order"](BEFORE, NODES, np.random.default_rng(0))
    assert_allclose(np.sort(mixed, axis=0), np.sort(NODES, axis=0))
    assert np.linalg.norm(mixed - NODES, axis=1).mean() > 10


def test_an_exchange_of_sides_mirrors_and_a_stale_state_is_the_one_before() -> None:
    mirrored = FAULTS["left and right exchanged"](BEFORE, NODES, np.random.default_rng(0))
    middle = NODES.mean(axis=0)
    assert_allclose((mirrored - middle) * [-1, 1, 1], NODES - middle, atol=1e-9)
    assert_allclose(FAULTS["stale state: not collapsed"](BEFORE, NODES, np.random.default_rng(0)), BEFORE)


def answer(**parts: object) -> Any:
    """Stands in for a localization that carries a point by +5 mm along R in each phase."""
    maps = SimpleNamespace(inf_from_ct=lambda x: x + np.array([5.0, 0, 0]))
    return cast(Any, SimpleNamespace(pose=maps, def_from_ct=lambda x: x + np.array([10.0, 0, 0]), **parts))


def test_a_run_is_scored_against_its_truth() -> None:
    ct = np.zeros((2, 3))
    truth: Any = SimpleNamespace(
        landmarks=SimpleNamespace(ct=ct, deflated=ct + np.array([10.0, 2.0, 0.0])),
        nodule=SimpleNamespace(nodule_deflated_ras=np.array([0.0, 4.0, 0.0])),
    )
    gates = {"check": at_most(5.0, 4.0, "x"), "surface": at_most(1.0, 2.0, "y")}
    row = score(answer(nodule_def=np.zeros(3), gates=gates), truth)
    assert row == {"landmarks, mm": 2.0, "nodule, mm": 4.0, "wrong": True, "noticed by": "check"}
    truth.nodule.nodule_deflated_ras = None
    assert not score(answer(nodule_def=np.zeros(3), gates=gates), truth)["wrong"]


def test_what_is_left_stands_beside_the_true_error_of_its_own_part() -> None:
    ct = np.random.default_rng(5).uniform(0, 50, (500, 3))
    dense = np.stack([ct, ct + np.array([5.0, -1.0, 0]), ct + np.array([10.0, 0, -3.0])], axis=1)
    told = (LeftOver(dense[:40, 1], np.tile([0.0, 1.0, 0], (40, 1)), 80), LeftOver(dense[:9, 2], np.zeros((9, 3)), 10))
    one, chain = beside_truth(answer(checks=Checks(*told)), dense)
    assert (one["part"], one["looked for"], one["recognized"]) == ("phase 1", 80, 40)
    assert one["left over"] == one["true error"] == "1.00 / 1.00"
    assert one["difference of both vectors"] == "0.00 / 0.00"
    assert (chain["left over"], chain["true error"]) == ("0.00 / 0.00", "3.00 / 3.00")
    assert (one["medians apart"], chain["medians apart"]) == (0.0, 3.0)
    assert beside_truth(answer(checks=None), dense) == []
    assert beside_truth(answer(checks=Checks(*told)), None) == []


def test_cases_are_run_and_their_check_compared_with_their_own_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    ct = np.random.default_rng(6).uniform(0, 50, (200, 3))
    away = {"a": 0.4, "b": 2.0}  # of the chain's error, mm
    dense = {
        name: np.stack([ct, ct + np.array([5.0, 0, 0]), ct + np.array([10.0, mm, 0])], axis=1)
        for name, mm in away.items()
    }

    def run(case: str, settings: str, _stages: Any) -> Any:
        assert settings == "settings"
        return answer(checks=Checks(None, LeftOver(dense[case][:50, 2], np.zeros((50, 3)), 60)))

    monkeypatch.setattr(bench, "read_case", lambda folder: folder.name)
    monkeypatch.setattr(bench, "localize", run)
    monkeypatch.setattr(bench, "read_truth", lambda folder: SimpleNamespace(dense=dense.get(folder.name)))
    folders = [Path(name) for name in away]
    result = bench_check(folders, cast(Any, "settings"))
    assert [(row["case"], row["part"], row["medians apart"]) for row in result["rows"]] == [
        ("a", "chain", 0.4),
        ("b", "chain", 2.0),
    ]
    assert result["agree"] == 1
    assert "Medians agree within 0.5 mm in 1 of 2 rows." in table(result)
    monkeypatch.setattr(bench, "read_truth", lambda _folder: SimpleNamespace(dense=None))
    assert table(bench_check(folders[:1], cast(Any, "settings"))) == "No case has dense truth."


def test_the_page_counts_noticed_silent_and_false_alarms() -> None:
    def row(wrong: bool, noticed: str) -> dict[str, Any]:
        return {
            "case": "c",
            "fault": "f",
            "landmarks, mm": 1.0,
            "nodule, mm": "",
            "wrong": wrong,
            "noticed by": noticed,
        }

    rows = [row(True, "check, surface"), row(True, "surface"), row(True, ""), row(False, ""), row(False, "fissures")]
    text = page(rows, [])
    assert "Of 5 runs 3 were wrong: **2 noticed** (1 by the stage `check`), **1 silent**" in text
    assert "Of the 2 right ones 1 were marked" in text
    assert "beside the truth" not in text
