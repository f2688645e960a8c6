"""Every end of a run is one of the program's own: whatever is raised inside a stage, by exit code and sentence."""

from __future__ import annotations

import errno
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from poro.mesh import stuff
from vatsloc import cli
from vatsloc.errors import CaseError, GateFailed, InputRefused, NotConverged, as_ours
from vatsloc.workflow import run as workflow_run
from vatsloc.workflow.stages import DEFLATED, Stages


def refused_by_numerics() -> None:
    stuff(np.zeros((4, 4, 4), dtype=bool), np.eye(4), 5.0)


def singular() -> None:
    np.linalg.inv(np.zeros((3, 3)))


def raising(error: BaseException) -> Callable[[], None]:
    def block() -> None:
        raise error

    return block


UNFORESEEN = "ended in an error that was not foreseen"
KINDS = {
    "our refusal": (raising(InputRefused("No spine found.")), 3, "deflated CBCT: No spine found."),
    "our refusal that names the image": (raising(InputRefused("The deflated CBCT is dark.")), 3, ": The deflated CBCT"),
    "case": (raising(CaseError("wrong side")), 2, "wrong side"),
    "no convergence": (raising(NotConverged("did not settle")), 4, "did not settle"),
    "numerics refuse": (refused_by_numerics, 3, "cannot work with these images: mask must be a non-empty 3-D array"),
    "a solver's RuntimeError": (raising(RuntimeError("multigrid stopped")), 4, "has no answer: multigrid stopped; try"),
    "singular equations": (singular, 4, "has no answer: Singular matrix"),
    "a library's ValueError": (lambda: np.ones(3) + np.ones(4), 4, f"{UNFORESEEN} (ValueError: operands"),
    "IndexError": (raising(IndexError("index 3 is out of bounds")), 4, f"{UNFORESEEN} (IndexError: index 3"),
    "KeyError": (raising(KeyError("x")), 4, f"{UNFORESEEN} (KeyError: 'x')"),
    "ZeroDivisionError": (raising(ZeroDivisionError()), 4, f"{UNFORESEEN} (ZeroDivisionError: no message)"),
    "AssertionError": (raising(AssertionError()), 4, UNFORESEEN),
    "RecursionError": (raising(RecursionError("too deep")), 4, UNFORESEEN),
    "out of memory": (lambda: np.empty(2**56), 4, "ran out of memory (Unable to allocate"),
    "full disk": (raising(OSError(errno.ENOSPC, "No space", "lung.vtu")), 2, "no space left on the disk (lung.vtu)"),
    "quota": (raising(OSError(errno.EDQUOT, "Quota", None)), 2, "no space left on the disk; free some"),
    "permission": (raising(PermissionError(errno.EACCES, "Permission denied", "x")), 2, "Permission denied (x); check"),
    "OSError of a library": (raising(OSError("truncated")), 4, f"{UNFORESEEN} (OSError: truncated)"),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("inside", [True, False], ids=["inside a stage", "after a stage"])
def test_whatever_a_stage_raises_ends_by_a_code_and_a_sentence_and_leaves_nothing(
    kind: str, inside: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    block, code, sentence = KINDS[kind]

    def localize(_case: object, _settings: object, stages: Stages, *_rest: object) -> None:
        with stages.stage("deflated surface", DEFLATED):
            if inside:
                block()
        block()

    file = SimpleNamespace(images=SimpleNamespace(cbct_inflated="inflated.nii.gz"))
    monkeypatch.setattr(workflow_run, "read_case_file", lambda _folder: file)
    monkeypatch.setattr(workflow_run, "read_case", lambda _folder: SimpleNamespace(warnings=()))
    monkeypatch.setattr(workflow_run, "localize", localize)
    with pytest.raises(SystemExit) as stop:
        cli.main(["localize", "case", "--out", str(tmp_path / "r")])
    said = capsys.readouterr().err
    assert stop.value.code == code
    assert sentence.removeprefix("deflated CBCT: " if not inside else "") in said
    assert "Traceback" not in said
    last = said.strip().splitlines()[-1]
    assert last.startswith("vatsloc: ")
    if "stage '" in last:
        begins = (
            "The stage 'deflated surface' (deflated CBCT) " if inside else "What follows the stage 'deflated surface' "
        )
        assert last.startswith(f"vatsloc: {begins}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("place", [["--debug", "localize"], ["localize", "--debug"]])
def test_debug_shows_the_traceback_wherever_it_stands(place: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main([*place, "nowhere", "--out", "r"])
    said = capsys.readouterr().err
    assert stop.value.code == 2
    assert "Traceback (most recent call last)" in said
    assert said.strip().splitlines()[-1].startswith("vatsloc: nowhere holds no case.toml")


def test_a_gate_that_failed_keeps_its_code() -> None:
    failed = GateFailed("do not trust it")
    assert as_ours(failed) is failed
    assert failed.exit_code == 5


def test_the_image_that_a_stage_was_last_on_is_named() -> None:
    stages = Stages()

    def spines() -> None:
        with stages.stage("spines"):
            stages.on("CT")
            stages.on("inflated CBCT")
            raise InputRefused("too dark")

    with pytest.raises(InputRefused, match=r"^inflated CBCT: too dark"):
        spines()
    with stages.stage("fit"):
        pass
    with pytest.raises(InputRefused, match=r"^no answer$"), stages.named():
        raise InputRefused("no answer")


FILLING = """
import sys
from pathlib import Path
import numpy as np
from registration.volume import Volume
from vatsloc.formats.folder import whole_folder
from vatsloc.formats.nifti import write_volume
from vatsloc.workflow.stages import Stages
from vatsloc import cli, errors
noise = np.random.default_rng(0).normal(0, 300, (90, 90, 90)).astype(np.float32)
stages = Stages()
try:
    with whole_folder(Path(sys.argv[1])) as partial, stages.stage("write"):
        write_volume(partial / "ct.nii.gz", Volume(noise, np.eye(4)))
except errors.VatslocError as error:
    print(error)
    sys.exit(error.exit_code)
"""


def test_a_disk_that_fills_while_writing_leaves_no_half_result(tmp_path: Path) -> None:
    """A real one: the largest file that the process may write is 100 kB."""

    def small_files() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))

    command = [sys.executable, "-B", "-c", FILLING, str(tmp_path / "r")]
    where = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    done = subprocess.run(command, preexec_fn=small_files, capture_output=True, text=True, env=where, check=False)
    assert done.returncode == 2, done.stderr
    assert done.stdout.startswith("The stage 'write' found no space left on the disk")
    assert list(tmp_path.iterdir()) == []
