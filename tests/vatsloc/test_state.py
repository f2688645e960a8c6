"""A run in steps: prepared after the CT, again after the inflated scan, and gone on from after the deflated one."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests import made_once
from vatsloc.case import CaseBefore, read_case, read_case_before
from vatsloc.errors import CaseError, InputRefused
from vatsloc.results import OUTPUT_FILES
from vatsloc.workflow.pose import ChangeOfPose
from vatsloc.workflow.prepare import PreparedBefore
from vatsloc.workflow.run import run_case
from vatsloc.workflow.settings import Settings, load_settings, settings_of
from vatsloc.workflow.state import key_of, prepare_case, read_state, write_state

TIMED = {"seconds", "peak_mb", "peak_mb_by_stage"}
FAST = settings_of(made_once.PRESET, made_once.EVERY_PART)


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_once.bare_case(tmp_path_factory)


@pytest.fixture(scope="module")
def states(case: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, list[str]]:
    """State after the CT alone, after both scans that come before the collapse, and what was said on the way there.

    Prepared from a case without landmarks and truth.
    """
    growing = without_truth(case, tmp_path_factory.mktemp("growing") / "demo")
    for scan in ("cbct_inflated", "cbct_deflated"):
        (growing / f"{scan}.nii.gz").unlink()
    after_ct, said = growing.parent / "ct", list[str]()
    assert prepare_case(growing, after_ct, FAST)["scans"] == ["ct"]
    after_both = growing.parent / "both"
    shutil.copytree(after_ct, after_both)
    shutil.copy(case / "cbct_inflated.nii.gz", growing)
    assert prepare_case(growing, after_both, FAST, said.append)["scans"] == ["ct", "cbct_inflated"]
    return after_ct, after_both, said


def without_truth(case: Path, folder: Path) -> Path:
    """A copy of a case without its landmarks and its truth."""
    return Path(shutil.copytree(case, folder, ignore=shutil.ignore_patterns("landmarks_*", "truth")))


def contents(result: Path) -> dict[str, Any]:
    """Every file of a result but what tells time and place."""
    found: dict[str, Any] = {name: (result / name).read_bytes() for name in OUTPUT_FILES}
    run = json.loads(found.pop("run.json"))
    for name in ("report.html", "scene_with_scans.mrml", "inputs.json"):
        del found[name]
    return {**found, "run": {key: value for key, value in run.items() if key not in TIMED}}


def test_a_run_from_either_state_is_the_plain_run_to_the_last_bit(
    case: Path, states: tuple[Path, Path, list[str]], tmp_path_factory: pytest.TempPathFactory, tmp_path: Path
) -> None:
    """The run from the first state sees neither landmarks nor truth, from its beginning on, the plain run nonsense."""
    plain = contents(made_once.demo_run(tmp_path_factory) / "result")
    bare = without_truth(case, tmp_path / "bare")
    for number, (folder, state) in enumerate(zip((bare, case), states[:2], strict=True)):
        said = list[str]()
        run_case(folder, tmp_path / str(number), FAST, said.append, state)
        assert "CT lungs ..." not in said
        assert ("free-form deformation ..." in said) == (state == states[0])
        found = contents(tmp_path / str(number))
        assert [name for name in plain if found[name] != plain[name]] == []
        inputs = json.loads((tmp_path / str(number) / "inputs.json").read_text(encoding="utf-8"))
        assert (tmp_path / str(number) / inputs["case"]).resolve() == folder.resolve()


def test_what_was_prepared_after_the_ct_is_not_done_again(states: tuple[Path, Path, list[str]]) -> None:
    said = states[2]
    assert "CT lungs ..." not in said
    assert "free-form deformation ..." in said


def test_a_state_comes_back_as_it_was_written(case: Path, states: tuple[Path, Path, list[str]], tmp_path: Path) -> None:
    here = read_case(case)
    state = read_state(states[1], here, FAST)
    assert isinstance(state.prepared, PreparedBefore)
    assert isinstance(state.pose, ChangeOfPose)
    assert [choice.part for choice in state.log.choices] == ["first registration"]
    write_state(tmp_path, state, key_of(here, FAST, state.scans))
    again = read_state(tmp_path, here, FAST)
    assert isinstance(again.pose, ChangeOfPose)
    np.testing.assert_array_equal(again.pose.points_inf, state.pose.points_inf)
    assert again.prepared.lung_ct.inside.strides == state.prepared.lung_ct.inside.strides


def shifted(case: CaseBefore, image: str) -> CaseBefore:
    """With one voxel of an image changed by 1 HU."""
    volume = getattr(case, image)
    hu = volume.hu.copy()
    hu[3, 4, 5] += 1
    return replace(case, **{image: replace(volume, hu=hu)})


@pytest.mark.parametrize("image", ["ct", "cbct_inflated"])
def test_a_state_of_another_scan_is_refused(case: Path, states: tuple[Path, Path, list[str]], image: str) -> None:
    other = shifted(read_case(case), image)
    with pytest.raises(CaseError, match=r"was prepared with another .*CT than this run has; run vatsloc prepare again"):
        read_state(states[1], other, FAST)


@pytest.mark.parametrize(
    ("settings", "changed", "sentence"),
    [
        (load_settings("balanced", None), {}, "another preset or other settings"),
        (load_settings("fast", None), {}, "another preset or other settings"),
        (FAST, {"side": "left"}, "another side"),
    ],
)
def test_a_state_of_other_settings_or_another_side_is_refused(
    case: Path, states: tuple[Path, Path, list[str]], settings: Settings, changed: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(CaseError, match=sentence):
        read_state(states[0], replace(read_case(case), **changed), settings)


def test_a_state_of_the_deflated_scans_own_belongs_to_any(case: Path, states: tuple[Path, Path, list[str]]) -> None:
    read_state(states[1], shifted(read_case(case), "cbct_deflated"), FAST)


def test_a_state_of_another_program_is_refused(
    case: Path, states: tuple[Path, Path, list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vatsloc.workflow.state.source_digest", lambda: "other")
    with pytest.raises(CaseError, match="another version of the program"):
        read_state(states[0], read_case(case), FAST)


def test_what_is_no_state_is_refused_by_its_name(
    case: Path, states: tuple[Path, Path, list[str]], tmp_path: Path
) -> None:
    with pytest.raises(CaseError, match="nowhere holds no state; make one by vatsloc prepare"):
        run_case(case, tmp_path / "out", FAST, state=Path("nowhere"))
    assert not (tmp_path / "out").exists()
    torn = tmp_path / "torn"
    shutil.copytree(states[0], torn)
    whole = (torn / "arrays.npz").read_bytes()
    (torn / "arrays.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CaseError, match=r"torn is damaged .*; run vatsloc prepare again"):
        read_state(torn, read_case(case), FAST)
    with pytest.raises(CaseError, match="holds files that vatsloc did not write"):
        prepare_case(case, case, FAST)


def test_a_stale_state_is_made_anew(case: Path, states: tuple[Path, Path, list[str]], tmp_path: Path) -> None:
    bare, old, said = tmp_path / "bare", tmp_path / "old", list[str]()
    shutil.copytree(case, bare)
    (bare / "cbct_inflated.nii.gz").unlink()
    shutil.copytree(states[0], old)
    other = settings_of("fast", {"mesh": {"edge_mm": 12.0}, **made_once.EVERY_PART})
    prepare_case(bare, old, other, said.append)
    assert any("another preset or other settings" in sentence and "done now" in sentence for sentence in said)
    assert "CT lungs ..." in said
    read_state(old, read_case(case), other)


def test_before_the_collapse_the_nodule_alone_tells_the_side(
    case: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "case"
    shutil.copytree(case, folder)
    toml = (folder / "case.toml").read_text(encoding="utf-8").splitlines()
    kept = [line for line in toml if not line.startswith(("side", "cbct_deflated"))]
    (folder / "case.toml").write_text("\n".join(kept), encoding="utf-8")
    known = read_case_before(folder)
    assert (known.side, known.side_told_by) == (read_case(case).side, "nodule")
    monkeypatch.setattr("vatsloc.case.nodule_side", lambda *_: None)
    with pytest.raises(InputRefused, match='add side = "right"'):
        read_case_before(folder)


def test_localize_says_which_scan_is_left_out_of_the_case_file(case: Path, tmp_path: Path) -> None:
    folder = tmp_path / "case"
    shutil.copytree(case, folder)
    text = (folder / "case.toml").read_text(encoding="utf-8")
    (folder / "case.toml").write_text(text.replace('cbct_deflated = "cbct_deflated.nii.gz"', "", 1), encoding="utf-8")
    with pytest.raises(CaseError, match=r"case.toml: \[images\] cbct_deflated is missing; add it"):
        read_case(folder)
