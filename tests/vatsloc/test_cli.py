"""Exit codes and sentences of the command line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

from phantoms.recipes import SPECS
from registration.volume import Volume
from tests import made_once
from vatsloc.cli import main
from vatsloc.formats.images import read_volume
from vatsloc.formats.nifti import write_volume


@pytest.fixture(scope="module")
def phantom(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_once.demo_case(tmp_path_factory)


@pytest.fixture
def case(phantom: Path, tmp_path: Path) -> Path:
    """A copy that a test may spoil."""
    return Path(shutil.copytree(phantom, tmp_path / "case"))


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as stop:
        main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    assert "Traceback" not in err
    return int(stop.value.code or 0), out, err


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["localize", "nowhere", "--out", "r"], "nowhere holds no case.toml"),
        (
            ["localize", "nowhere", "--out", "r", "--preset", "best"],
            '"best" is no preset; choose one of fast, balanced',
        ),
        (["localize", "nowhere", "--out", "r", "--settings", "no.toml"], "no.toml is not there"),
        (["evaluate", "nowhere", "r"], "r is not a result of localize"),
        (["phantom", "nobody", "--out", "p"], f'"nobody" is no phantom; choose one of {", ".join(SPECS)}'),
        (["frobnicate"], "No such command"),
    ],
)
def test_wrong_usage_exits_with_2(
    arguments: list[str],
    sentence: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = run(capsys, *arguments)
    assert code == 2
    assert out == ""
    assert sentence in err
    assert list(tmp_path.iterdir()) == []


def test_unknown_setting_exits_with_2(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text("[mesh]\nedgemm = 5\n")
    code, _, err = run(capsys, "localize", "x", "--out", tmp_path / "r", "--settings", tmp_path / "s.toml")
    assert code == 2
    assert "mesh.edgemm" in err


def test_missing_landmark_file_does_not_stop_localize(case: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (case / "landmarks_ct.mrk.json").unlink()
    (case / "cbct_deflated.nii.gz").unlink()
    code, _, err = run(capsys, "localize", case, "--out", case.parent / "r")
    assert code == 2
    assert "cbct_deflated.nii.gz" in err
    assert "landmarks" not in err


def test_nan_is_refused_with_3(case: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = read_volume(case / "cbct_inflated.nii.gz")
    hu = image.hu.copy()
    hu[3, 4, 5] = np.nan
    nib.save(nib.Nifti1Image(hu, image.ras_from_ijk), case / "cbct_inflated.nii.gz")
    code, _, err = run(capsys, "localize", case, "--out", case.parent / "r")
    assert code == 3
    assert "cbct_inflated.nii.gz" in err
    assert not (case.parent / "r").exists()


def test_ct_without_lung_is_refused_with_3(case: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = read_volume(case / "ct.nii.gz")
    hu = np.where((image.hu < -400) & _body(image), 40.0, image.hu).astype(np.float32)
    write_volume(case / "ct.nii.gz", Volume(hu, image.ras_from_ijk))
    code, _, err = run(capsys, "localize", case, "--out", case.parent / "r")
    assert code == 3
    assert "lung" in err
    assert not (case.parent / "r").exists()


@pytest.mark.parametrize("gravity", [True, False])
def test_swapped_side_is_refused(case: Path, gravity: bool, capsys: pytest.CaptureFixture[str]) -> None:
    text = (case / "case.toml").read_text().replace('side = "right"', 'side = "left"')
    if not gravity:
        text = "\n".join(line for line in text.splitlines() if not line.startswith("gravity_cbct"))
    (case / "case.toml").write_text(text)
    code, _, err = run(capsys, "localize", case, "--out", case.parent / "r")
    assert code == (2 if gravity else 3)
    assert "left" in err


def test_images_that_do_not_overlap_are_refused_with_3(case: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = read_volume(case / "cbct_deflated.nii.gz")
    affine = image.ras_from_ijk.copy()
    affine[:3, 3] += [0.0, 0.0, 900.0]
    write_volume(case / "cbct_deflated.nii.gz", Volume(image.hu, affine))
    code, _, err = run(capsys, "localize", case, "--out", case.parent / "r")
    assert code == 3
    assert "overlap" in err


def test_phantom_prints_its_folder(tmp_path: Path, phantom: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "p").mkdir()
    (tmp_path / "p" / "mine.txt").write_text("keep")
    code, out, err = run(capsys, "phantom", "demo", "--out", tmp_path / "p")
    assert code == 2
    assert out == ""
    assert "did not write" in err
    assert (tmp_path / "p" / "mine.txt").read_text() == "keep"
    info = json.loads((phantom / "truth" / "info.json").read_text())
    assert info["n_landmarks"] == 48


def _body(image: Volume) -> np.ndarray:
    """Everything but the air around the patient: what is not connected to the image's border slice by slice."""
    from scipy import ndimage

    labels, _ = ndimage.label(image.hu < -400)
    outside = np.unique(
        np.concatenate([labels[0].ravel(), labels[-1].ravel(), labels[:, 0].ravel(), labels[:, -1].ravel()])
    )
    return ~np.isin(labels, outside[outside > 0])
