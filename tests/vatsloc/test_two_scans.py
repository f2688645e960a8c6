"""Two scans: the CT stands in for an inflated scan that was not taken."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests import made_once
from tests.vatsloc import run_scene as known
from vatsloc.case import read_case
from vatsloc.evaluation import evaluate_case
from vatsloc.results import output_files
from vatsloc.workflow.run import run_case
from vatsloc.workflow.settings import Settings, load_settings
from vatsloc.workflow.stages import Stages
from vatsloc.workflow.stand_in import stand_in
from vatsloc.workflow.state import before_collapse


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo without its inflated scan and without the landmarks in it."""
    folder = Path(shutil.copytree(made_once.demo_case(tmp_path_factory), tmp_path_factory.mktemp("two") / "demo"))
    for path in (*folder.glob("*inflated*"), *folder.glob("truth/*inflated*")):
        path.unlink()
    lines = (folder / "case.toml").read_text(encoding="utf-8").splitlines()
    (folder / "case.toml").write_text("\n".join(line for line in lines if not line.startswith("cbct_inflated")))
    return folder


@pytest.fixture(scope="module")
def result(case: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("two-result") / "demo"
    answers: list[dict[str, Any]] = []
    run_case(case, out, load_settings("fast", None), answered=answers.append)
    assert answers == [json.loads((out / "answer.json").read_text(encoding="utf-8"))]
    return out


def test_a_run_of_two_scans_says_so_and_writes_nothing_about_the_third(result: Path) -> None:
    assert sorted(path.name for path in result.iterdir()) == sorted(output_files(inflated=False))
    assert not [path.name for path in result.iterdir() if "inflated" in path.name]
    run = json.loads((result / "run.json").read_text(encoding="utf-8"))
    assert run["scans"] == ["ct", "cbct_deflated"]
    assert any("No inflated CBCT was taken" in warning for warning in run["warnings"])
    assert run["check"]["phase1"] is None
    assert run["cbct_preparation"]["inflated"] is None
    assert {"spine_ct_deflated", "check", "recognized"} <= set(run["gates"])
    assert not {"overlap", "spine_ct_inflated", "check_phase1"} & set(run["gates"])
    assert set(run["fields"]) == {"deflated_from_ct", "ct_from_deflated"}
    assert "No inflated CBCT was taken" in (result / "report.html").read_text(encoding="utf-8")


def test_it_finds_the_lung_s_tissue_by_keypoints_between_the_ct_and_the_collapsed_lung(
    case: Path, result: Path, tmp_path: Path
) -> None:
    copy = tmp_path / "scored"
    shutil.copytree(result, copy)
    scores = evaluate_case(case, copy)
    assert scores["rigid_ct_deflated"]["mean"] > 20
    assert scores["chain"]["mean"] < 1.5
    assert scores["nodule_deflated_mm"] < 3
    assert scores["nodule_in_ellipsoid95"]
    assert (scores["phase1"]["n"], scores["phase1"]["mean"], scores["nodule_inflated_mm"]) == (0, None, None)


def test_the_ct_alone_is_prepared_once_and_the_inflated_lung_expected_from_it(case: Path) -> None:
    here, fast, stages = read_case(case), load_settings("fast", None), Stages()
    state = before_collapse(here, fast, stages)
    assert state.complete is None
    before, pose = stand_in(here, state.prepared, fast, stages)
    assert pose.rigid is None
    assert_allclose(pose.inf_from_ct_rigid.matrix, np.eye(4))
    ratio = pose.mesh_inf.volumes.sum() / pose.mesh_ct.volumes.sum()
    assert 0.8 < ratio < 0.95
    lung = pose.lung_inf
    deep = before.inflated.volume.hu[lung.inside]
    ct = here.ct.hu[state.prepared.lung_ct.inside]
    assert np.median(deep) + 1000 == pytest.approx((np.median(ct) + 1000) / ratio, rel=0.05)
    assert before.inflated.field.usable.inside.all()


def test_without_an_inflated_scan_the_ellipsoid_is_wider() -> None:
    from vatsloc.workflow.uncertainty import WITHOUT_INFLATED, covariance

    scene = known.scene()
    points = known.NODULE_INF[None], known.NODULE_DEF[None]
    three = covariance(scene.pose, scene.collapse, *points)
    two = covariance(scene.with_pose(rigid=None).pose, scene.collapse, *points)
    assert_allclose(two, WITHOUT_INFLATED**2 * three)
    assert Settings().output.field_mm == 3.0
