"""Rows of the chart: errors and seconds of what each variant needs, on a case that moves as it is told."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from poro.fit import FitStatus
from poro.mesh import TetMesh
from registration.maps.rigid import RigidTransform
from registration.volume import Mask
from vatsloc.errors import InputRefused
from vatsloc.evaluation.tre import RunMaps
from vatsloc.study.chart import chart
from vatsloc.study.chart.chart import Row, measure_case
from vatsloc.study.chart.variants import chosen_variants
from vatsloc.study.cohort import scored
from vatsloc.workflow.choices import weigh
from vatsloc.workflow.stages import Stages

MESH = TetMesh(60.0 * np.vstack([np.zeros(3), np.eye(3)]) - 10, np.array([[0, 1, 2, 3]]))
CT = np.array([[2.0, 3.0, 4.0], [5.0, 1.0, 8.0]])
MOVED = np.array([1.0, 2, 0])
STILL = RigidTransform.identity()


def took(stages: Stages, **seconds: float) -> None:
    """Stages by name and what each took; processors take ten times as long."""
    stages.seconds |= {name.replace("_", " "): s for name, s in seconds.items()}
    stages.cpu_seconds |= {name: 10 * s for name, s in stages.seconds.items()}


def read(stages: Stages, **seconds: float) -> Any:
    took(stages, **seconds)
    return SimpleNamespace(lung_ct=SimpleNamespace(inside=None, ras_from_ijk=None))


def pose(_case: Any, _prepared: Any, settings: Any, stages: Stages, _register: Any) -> Any:
    took(stages, spine_CT_to_inflated=0.5, rest=3.5)
    shift = np.array([0.5, 0, 0]) if settings.registration.on else np.zeros(3)
    return SimpleNamespace(
        inf_from_ct_rigid=STILL, inf_from_ct=lambda points: points + shift, mesh_inf=MESH, mesh_ct=MESH
    )


def observe(_case: Any, _prepared: Any, _pose: Any, _settings: Any, stages: Stages) -> Any:
    took(stages, spine_inflated_to_deflated=0.25)
    return SimpleNamespace(def_from_inf_rigid=STILL)


def select(_gravity: Any, _prepared: Any, _observed: Any, settings: Any, stages: Stages) -> Any:
    took(stages, fit=6.75)
    stages.choose(weigh("residual registration", 0.5, 1.0, "seen"))
    return FitStatus.CONVERGED if settings.model.hilum else FitStatus.CONTACT


def modelled(_prepared: Any, _pose: Any, _observed: Any, model: Any, _settings: Any, _stages: Stages) -> Any:
    after = TetMesh(MESH.points + np.array([0, 1.0, 0]), MESH.tets)
    return SimpleNamespace(fit=SimpleNamespace(status=model), def_from_inf_rigid=STILL, mesh_after=after)


def refined(_case: Any, _prepared: Any, _pose: Any, collapse: Any, _settings: Any, stages: Stages) -> Any:
    took(stages, block_refinement=1.0)
    collapse.mesh_after = TetMesh(collapse.mesh_after.points + np.array([0, 0.5, 0]), MESH.tets)
    return collapse


def told(stages: Stages, seconds: float, off: float) -> RunMaps:
    """A run whose chain is off by some mm along y."""
    took(stages, localize=seconds)
    along = np.array([0, off, 0])
    return RunMaps(STILL, STILL, STILL, STILL, STILL, lambda points: points + MOVED - along)


def without_inflated(_case: Any, _settings: Any, before: Stages, after: Stages) -> RunMaps:
    took(before, lungs=2.0)
    return told(after, 9.0, 0.25)


def truth() -> Any:
    """Tissue moves by (1, 0, 0) and then by (0, 2, 0); both phases above find half of it."""
    inflated, deflated = CT + np.eye(3)[0], CT + MOVED
    everywhere = Mask(np.ones((3, 3, 3), dtype=bool), np.diag([40.0, 40, 40, 1]))
    return SimpleNamespace(
        landmarks=SimpleNamespace(ct=CT, inflated=inflated, deflated=deflated),
        nodule=SimpleNamespace(nodule_deflated_ras=deflated[0]),
        dense=np.stack([CT, inflated, deflated], axis=1),
        fields_of_view={"inflated": everywhere, "deflated": everywhere},
    )


NAMES = ("rigid", "ffd-16", "balanced", "alone", "no-hilum", "two-scans", "one-scan")


@pytest.fixture
def rows(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> tuple[Row, ...]:
    """Rows of `NAMES`."""
    case = SimpleNamespace(nodule=SimpleNamespace(centre_ras=CT[0]), gravity_ras=None, cbct_inflated="seen")
    stand_ins: dict[str, Any] = {
        "read_case": lambda _folder: case,
        "read_truth": lambda _folder: truth(),
        "prepare_before": lambda _case, _scan, stages: read(stages, read=1.0, lungs=1.5, inflated=0.25),
        "prepare": lambda _case, stages, _before: read(stages, deflated=0.25),
        "change_of_pose": pose,
        "observe": observe,
        "modelled": modelled,
        "in_pieces": lambda _prepared, pose, collapse, _settings, _stages: (pose, collapse),
        "refined": refined,
        "without_inflated": without_inflated,
        "foreseen": lambda _case, _prepared, stages: told(stages, 1.5, 4.0),
    }
    for name, stand_in in stand_ins.items():
        monkeypatch.setattr(chart, name, stand_in)
    monkeypatch.setattr(scored, "stuff", lambda *_mesh: None)
    monkeypatch.setattr(scored, "depth_below_pleura", lambda _mesh, points: np.array([4.0, 14.0])[: len(points)])
    chosen = {name: replace(variant, select=select) for name, variant in chosen_variants(NAMES).items()}
    found = {row.variant: row for row in measure_case(tmp_path / "case", chosen)}
    return tuple(found[name] for name in NAMES)


def test_a_case_s_rows_hold_the_errors_and_the_seconds_of_what_each_variant_needs(rows: tuple[Row, ...]) -> None:
    rigid, pose_only, balanced, alone, failed, _, _ = rows
    assert (rigid.phase1_mean, rigid.phase2_mean) == (1, 2)
    assert rigid.chain_mean == pytest.approx(math.sqrt(5))
    assert (rigid.phase1_seconds, rigid.phase2_seconds) == (0.5, 0.25)
    assert rigid.tissue_mean == pytest.approx(math.sqrt(5))
    assert (pose_only.phase1_mean, pose_only.phase1_seconds) == (0.5, 4)  # without reading and preparing
    assert math.isnan(pose_only.chain_mean)
    assert (balanced.phase1_mean, balanced.phase2_mean, balanced.phase2_seconds) == (0.5, 0.5, 8)
    assert balanced.chain_mean == pytest.approx(math.hypot(1, 0.5))
    assert balanced.nodule_mm == pytest.approx(math.hypot(1, 0.5))
    assert balanced.pleura_mean == pytest.approx(math.hypot(1, 0.5))
    assert balanced.chain_seconds == pytest.approx(15, abs=0.1)
    assert balanced.after_seconds == pytest.approx(8.25)  # the deflated scan and phase 2
    assert balanced.left_out == "residual registration"
    assert (alone.phase2_mean, alone.phase2_seconds) == (1, 7)  # without blocks
    assert (rigid.phase2_cpu, balanced.phase2_cpu) == (2.5, 80)
    assert failed.failed == "the contact of the collapsing lung did not settle"


def test_fewer_scans_have_a_chain_and_what_the_last_of_them_waits(rows: tuple[Row, ...]) -> None:
    *_, two, one = rows
    assert (two.chain_mean, two.nodule_mm, two.pleura_mean) == (0.25, 0.25, 0.25)
    assert (two.after_seconds, two.after_cpu) == (9, 90)
    assert two.chain_seconds == pytest.approx(12, abs=0.1)  # reading and the CT's lungs before
    assert math.isnan(two.phase1_mean)
    assert (one.chain_mean, one.after_seconds) == (4, 1.5)


def test_a_case_without_an_inflated_scan_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(chart, "read_case", lambda _folder: SimpleNamespace(cbct_inflated=None))
    with pytest.raises(InputRefused, match="no inflated CBCT"):
        next(measure_case(tmp_path, chosen_variants(["two-scans"])))
