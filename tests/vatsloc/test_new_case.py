"""`vatsloc new`, and the side of a case that does not state it: told by the nodule and by pleural gas."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from registration.volume import Volume
from tests.vatsloc.imaging_thorax import CENTRES, cone_beam, thorax
from vatsloc.case import read_case
from vatsloc.cli import main
from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.markups import PointList, read_points, write_points
from vatsloc.formats.nifti import write_volume
from vatsloc.imaging.side import PleuralGas, nodule_side, told_side
from vatsloc.new_case import nodule_source
from vatsloc.workflow.prepare import prepare
from vatsloc.workflow.stages import Stages

RADIUS = 110.0


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A thorax whose right lung has collapsed, and the deflated scan as a C-arm may export it."""
    folder = tmp_path_factory.mktemp("scans of J. Doe")
    ct, collapsed = thorax().volume, thorax(scale_right=0.7, seed=2).volume
    inflated, deflated = (cone_beam(v, (30.0, 0.0), RADIUS, (0.0, 0.0)) for v in (thorax(seed=1).volume, collapsed))
    grey = Volume(np.clip(deflated.hu + 1024, 0, 4095).astype(np.float32), deflated.ras_from_ijk)
    volumes = {"ct": ct, "inflated": inflated, "deflated": deflated, "grey": grey}
    for name, volume in volumes.items():
        write_volume(folder / f"{name}.nii.gz", volume)
    return {name: folder / f"{name}.nii.gz" for name in volumes}


def new(
    capsys: pytest.CaptureFixture[str], case: Path, images: dict[str, Path], *more: str, deflated: str = "deflated"
) -> tuple[int, str, str]:
    arguments = ["new", case, "--ct", images["ct"], "--inflated", images["inflated"], "--deflated", images[deflated]]
    try:
        main([str(a) for a in [*arguments, *more]])
    except SystemExit as stop:
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        return int(stop.code or 0), out, err
    raise AssertionError("main ends by SystemExit")


def lps(side: str) -> str:
    x, y, z = CENTRES[side] * [-1, -1, 1]
    return f"{x},{y},{z}"


def test_a_new_case_links_its_files_says_what_they_show_and_is_read_back(
    images: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "case"
    code, out, _ = new(capsys, folder, images, "--nodule", lps("right"), "--lps", deflated="grey")
    assert code == 0
    assert (folder / "ct.nii.gz").is_symlink()
    assert (folder / "ct.nii.gz").resolve() == images["ct"].resolve()
    assert tomllib.loads((folder / "case.toml").read_text()) == {
        "side": "right",
        "images": {name: f"{name}.nii.gz" for name in ("ct", "cbct_inflated", "cbct_deflated")},
        "nodule": {"point": "nodule_ct.mrk.json"},
    }
    np.testing.assert_allclose(read_points(folder / "nodule_ct.mrk.json").ras[0], CENTRES["right"])
    case = read_case(folder)
    assert (case.side, case.side_told_by) == ("right", "case.toml")
    lines = out.splitlines()
    assert lines[0] == f"{folder}: files linked, case.toml written"
    assert lines[1].startswith("ct: 120 x 88 x 100 voxels of 2.5 x 2.5 x 2.5 mm, stored RAS, air -")
    assert "HU = 1.0" in lines[3]
    assert "for it is not in HU" in lines[3]
    assert lines[4] == "nodule: 70.0 10.0 -10.0 RAS mm, by point"
    assert lines[5] == "side: right, told by the nodule (pleural gas: right)"
    assert lines[6].startswith("overlap of the fields of view: ct and cbct_inflated 100 %")
    assert lines[7].startswith("warning: cbct_deflated.nii.gz is not in HU")

    before = (folder / "case.toml").read_text()
    code, out, err = new(capsys, folder, images, "--nodule", lps("left"), "--lps")
    assert (code, out) == (2, "")
    assert "holds files that vatsloc did not write; give an empty or a new folder" in err
    assert (folder / "case.toml").read_text() == before


def test_files_are_copied_where_asked_and_a_header_takes_its_data_along(
    images: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    volume = thorax().volume
    (tmp_path / "scan.raw").write_bytes(volume.hu.astype("<i2").tobytes(order="F"))
    sx, sy, sz = volume.ras_from_ijk[:3, 3] * [-1, -1, 1]
    (tmp_path / "scan.mhd").write_text(
        "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\n"
        f"TransformMatrix = -1 0 0 0 -1 0 0 0 1\nOffset = {sx} {sy} {sz}\nElementSpacing = 2.5 2.5 2.5\n"
        "DimSize = 120 88 100\nElementType = MET_SHORT\nElementDataFile = scan.raw\n"
    )
    folder = tmp_path / "case"
    code, out, err = new(
        capsys, folder, {**images, "ct": tmp_path / "scan.mhd"}, "--nodule", "70,10,-10", "--copy", "--json"
    )
    assert code == 0, err
    told = json.loads(out)
    assert told["files"] == "copied"
    assert told["images"]["ct"]["voxels"] == [120, 88, 100]
    assert told["images"]["ct"]["tissue_hu"] == pytest.approx(40, abs=10)
    assert told["images"]["cbct_deflated"]["calibration"] is None
    assert told["pleural_gas_ml"]["deflated"]["right"] > 400
    assert sorted(p.name for p in (folder / "ct").iterdir()) == ["scan.mhd", "scan.raw"]
    assert not any(p.is_symlink() for p in folder.rglob("*"))


def test_a_nodule_in_the_other_lung_than_the_gas_is_refused_and_nothing_is_left(
    images: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = new(capsys, tmp_path / "case", images, "--nodule", lps("left"), "--lps")
    assert (code, out) == (3, "")
    assert "pleural gas on the right side and 8 ml on the left one, the operated one by nodule; correct" in err
    assert list(tmp_path.iterdir()) == []


def test_errors_name_the_file_that_was_given(
    images: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flat = tmp_path / "flat.nii.gz"
    write_volume(flat, Volume(np.full((20, 20, 20), 7.0, dtype=np.float32), np.eye(4)))
    for given, code, sentence in (
        ({"ct": flat}, 3, f"{flat} is 7 everywhere"),
        ({"inflated": tmp_path / "no.nii"}, 2, f"{tmp_path / 'no.nii'} does not exist; correct the path"),
    ):
        ended, out, err = new(capsys, tmp_path / "case", {**images, **given}, "--nodule", "70,10,-10")
        assert (ended, out) == (code, "")
        assert sentence in err
    assert list(tmp_path.iterdir()) == [flat]


def test_a_point_is_read_in_either_frame(tmp_path: Path) -> None:
    np.testing.assert_allclose(nodule_source("-12.5, 30,40", lps=True), [12.5, -30.0, 40.0])
    np.testing.assert_allclose(nodule_source("-12.5,30,40", lps=False), [-12.5, 30.0, 40.0])
    for text in ("1,2", "1,5,2,5,3,5", "nodule.nii.gz", "a,b,c", "nan,1,2", ""):
        with pytest.raises(CaseError, match="neither a file that is there nor three numbers"):
            nodule_source(text, lps=False)
    (tmp_path / "n.mrk.json").write_text("{}")
    with pytest.raises(CaseError, match="a file states its own frame"):
        nodule_source(str(tmp_path / "n.mrk.json"), lps=True)


def test_the_nodule_tells_the_side_else_the_gas_else_the_user_is_asked() -> None:
    ct, collapsed = thorax().volume, thorax(scale_right=0.7, seed=2).volume
    inflated, deflated = (cone_beam(v, (30.0, 0.0), RADIUS, (0.0, 0.0)) for v in (thorax(seed=1).volume, collapsed))
    assert nodule_side(ct, None, CENTRES["left"]) == "left"
    between = np.array([0.0, 40.0, -10.0])
    assert nodule_side(ct, None, between) is None
    told = told_side(ct, None, between, inflated, deflated)
    assert (told.side, told.by) == ("right", "pleural gas")
    with pytest.raises(InputRefused, match=r'add side = "right" or side = "left" to case\.toml'):
        told_side(ct, None, between, inflated, inflated)


def test_scans_in_which_gas_tells_the_side_are_prepared_once(
    images: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = {"ct": "ct", "cbct_inflated": "inflated", "cbct_deflated": "deflated"}
    toml = "[images]\n" + "".join(f'{name} = "{images[file]}"\n' for name, file in names.items())
    (tmp_path / "case.toml").write_text(toml + '[nodule]\npoint = "nodule.mrk.json"\n')
    write_points(tmp_path / "nodule.mrk.json", PointList(CENTRES["right"][None], ("nodule",), ("",)))
    monkeypatch.setattr("vatsloc.imaging.side.nodule_side", lambda *_: None)
    case = read_case(tmp_path)
    stages = Stages()
    expected = prepare(replace(case, seen=None), Stages())

    def again(*_: object) -> None:
        raise AssertionError("prepared a second time")

    monkeypatch.setattr("vatsloc.workflow.prepare.prepare_cbct", again)
    found = prepare(case, stages)
    assert (case.side, case.side_told_by) == ("right", "pleural gas")
    assert "pleural gas had to tell the side" in stages.skipped["CBCT preparation"]
    for one, other in ((found.inflated, expected.inflated), (found.deflated, expected.deflated)):
        np.testing.assert_array_equal(one.volume.hu, other.volume.hu)
    assert found.gas == expected.gas


@pytest.mark.parametrize(
    ("before", "after", "side"),
    [
        ((0, 0), (500, 0), "right"),
        ((0, 0), (20, 300), "left"),
        ((0, 0), (80, 0), None),  # too little
        ((0, 0), (300, 100), None),  # on both sides
        ((400, 0), (500, 0), None),  # there before the collapse
    ],
)
def test_gas_tells_the_side_only_where_it_is_clear(
    before: tuple[float, float], after: tuple[float, float], side: str | None
) -> None:
    gas = PleuralGas(
        dict(zip(("right", "left"), before, strict=True)), dict(zip(("right", "left"), after, strict=True))
    )
    assert gas.side == side
    gas.require(side or "left", "case.toml")  # raises nothing
    if side is not None:
        with pytest.raises(InputRefused, match="ml of pleural gas on the"):
            gas.require("left" if side == "right" else "right", "case.toml")
