"""Which scan is which, whose nodule it is, and where answers go: the rules, without a network."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.vatsloc import node_scene as scene
from tests.vatsloc.dicom_scene import Ids, write_series
from tests.vatsloc.finding_scene import scan
from vatsloc.cli import main
from vatsloc.dicomnet.arrival import Arrived, Patience, Scan, arrival
from vatsloc.dicomnet.nodule import NoduleFiles
from vatsloc.dicomnet.roles import roles
from vatsloc.dicomnet.sending import Target, target_of
from vatsloc.dicomnet.store import Store
from vatsloc.dicomnet.work import gas_of, localize_case, prepare_case
from vatsloc.errors import CaseError


def made(name: str, time: str, kind: str = "cone-beam CT", **changes: object) -> Scan:
    values = {"study": "s", "frame": "f", "n": 100, "side_mm": 240.0, "description": name, "gas_ml": None}
    return Scan(folder=Path(name), kind=kind, time=time, **{**values, **changes})  # type: ignore[arg-type]


CT = made("ct", "20261101", "CT")
A, B = made("a", "20261129101000"), made("b", "20261129102000")
LITTLE, MUCH = {"right": 20.0, "left": 5.0}, {"right": 600.0, "left": 5.0}


def test_time_tells_the_inflated_from_the_deflated_scan() -> None:
    for scans in ([CT, A, B], [B, CT, A]):
        found = roles(scans)
        assert (found.ct, found.inflated, found.deflated, found.warnings) == (CT, A, (B,), ())


def test_clear_pleural_gas_overrules_time_and_says_so() -> None:
    first, second = made("a", A.time, gas_ml=MUCH), made("b", B.time, gas_ml=LITTLE)
    found = roles([CT, first, second])
    assert (found.inflated, found.deflated) == (second, (first,))
    assert found.warnings == ("Pleural gas says that the later cone-beam CT shows the inflated lung; it is taken so.",)


def test_pleural_gas_tells_where_no_time_is_stated() -> None:
    first, second = made("a", "", gas_ml=MUCH), made("b", "", gas_ml=LITTLE)
    assert roles([first, second]).inflated == second
    assert roles([made("a", "", gas_ml=LITTLE), made("b", "", gas_ml=MUCH)]).deflated[0].description == "b"


@pytest.mark.parametrize("gas", [None, LITTLE])
def test_without_time_and_gas_nothing_is_answered(gas: dict[str, float] | None) -> None:
    found = roles([CT, made("a", "", gas_ml=gas), made("b", "", gas_ml=gas)])
    assert (found.inflated, found.deflated) == (None, ())
    assert found.warnings[0].startswith("Neither time nor pleural gas tells")


def test_each_later_scan_is_a_deflated_one_of_its_own() -> None:
    third = made("c", "20261129110000", frame="other")
    found = roles([CT, A, B, third])
    assert (found.inflated, found.deflated) == (A, (B, third))
    assert len(found.warnings) == 1
    assert '"c" has another frame of reference than the inflated scan' in found.warnings[0]


def test_cone_beam_cts_of_an_earlier_operation_are_left_aside() -> None:
    old = made("old", "20200101", study="before")
    found = roles([CT, old, A, B])
    assert (found.inflated, found.deflated) == (A, (B,))
    assert "1 cone-beam CTs are of another study" in found.warnings[0]


def test_the_ct_of_most_slices_is_taken() -> None:
    thin = made("thin", "20261101", "CT", n=300)
    assert roles([thin, CT]).ct == thin
    assert "the one of 300 slices" in roles([thin, CT]).warnings[0]


def test_one_scan_alone_is_the_inflated_one_so_far() -> None:
    assert (roles([A]).inflated, roles([A]).deflated, roles([A]).ct, roles([]).ct) == (A, (), None, None)


@pytest.mark.parametrize(
    ("role", "modality", "kind"), [("ct", "CT", "CT"), ("deflated", "CT", "cone-beam CT"), ("ct", "XA", "cone-beam CT")]
)
def test_field_of_view_and_modality_tell_the_kind(role: str, modality: str, kind: str, tmp_path: Path) -> None:
    folder = write_series(
        tmp_path / "series", scene.volume(role), Ids(modality=modality, time="093000", date="20261128")
    )
    store = Store(tmp_path / "cases")
    for file in folder.iterdir():
        assert store.receive(file.read_bytes(), "one")
    (series,) = store.patients()[0].glob("series/*")
    now = Patience(settle_s=0.0, timeout_s=60.0)
    assert arrival(series, store, now).state is Arrived.RECEIVING  # the association is still there
    store.released("one")
    found = arrival(series, store, now)
    assert found.scan is not None
    assert (found.state, found.scan.kind, found.scan.time) == (Arrived.WHOLE, kind, "20261128093000")
    assert (found.scan.n, found.scan.frame) == (scene.volume(role).hu.shape[2], Ids().frame)
    assert arrival(series, Store(tmp_path / "cases"), now).scan == found.scan  # as kept on disk


def test_a_nodule_is_tied_to_its_patient(tmp_path: Path) -> None:
    file = tmp_path / "nodule.nii.gz"
    with pytest.raises(CaseError, match="does not exist; correct --nodule"):
        NoduleFiles(file)
    file.write_bytes(b"x")
    with pytest.raises(CaseError, match="does not say whose nodule it is; give --ct, or --patient"):
        NoduleFiles(file)
    assert NoduleFiles(file, "A").of("A") == file
    assert NoduleFiles(file, "A").of("B") is None
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "A.mrk.json").write_text("{}")
    (folder / "A.2.nii.gz").write_bytes(b"x")
    assert NoduleFiles(folder).of("A") == folder / "A.mrk.json"
    assert NoduleFiles(folder).of("A.2") == folder / "A.2.nii.gz"
    (folder / "A.nrrd").write_bytes(b"x")
    with pytest.raises(CaseError, match="holds 2 files for patient A; keep one"):
        NoduleFiles(folder).of("A")


def test_a_nodule_in_dicom_says_itself_whose_it_is(tmp_path: Path) -> None:
    folder = write_series(tmp_path / "series", scan(), Ids(patient="A"))
    file = next(folder.iterdir())
    assert NoduleFiles(file).of("A") == file
    assert NoduleFiles(file).of("B") is None
    with pytest.raises(CaseError, match="is about patient A, not B; take it away"):
        NoduleFiles(file, "B").of("B")


def test_targets_are_understood_or_refused() -> None:
    assert target_of("pacs.example:104") == Target("pacs.example", 104, "ANY-SCP")
    assert target_of("PACS@10.0.0.1:11112") == Target("10.0.0.1", 11112, "PACS")
    for text in ("pacs", "pacs:x", ":104", "pacs:0", "pacs:70000", "A" * 17 + "@pacs:104"):
        with pytest.raises(CaseError, match="is no node"):
            target_of(text)


def test_the_real_work_raises_what_localize_says(tmp_path: Path) -> None:
    case = tmp_path / "case"
    case.mkdir()
    with pytest.raises(CaseError, match=r"holds no case\.toml; name a case folder"):
        localize_case(case, tmp_path / "state", tmp_path / "result", "fast")
    assert not (tmp_path / "result").exists()
    with pytest.raises(CaseError, match=r"holds no case\.toml; name a case folder"):
        prepare_case(case, tmp_path / "state", "fast")
    assert (tmp_path / "prepare.log").exists()


def test_gas_of_an_image_without_a_spine_is_not_known(tmp_path: Path) -> None:
    assert gas_of(write_series(tmp_path / "series", scan(), Ids())) is None


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--send", "nowhere"], '--send "nowhere" is no node'),
        (["--nodule", "absent.nii.gz"], "absent.nii.gz does not exist; correct --nodule"),
        (["--nodule", __file__], "does not say whose nodule it is"),
        (["--preset", "quick"], "quick"),
    ],
)
def test_the_command_refuses_wrong_options_before_it_listens(
    options: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["listen", "--port", "0", "--cases", str(tmp_path / "cases"), *options])
    assert ended.value.code == 2
    assert says in capsys.readouterr().err
    assert not (tmp_path / "cases").exists()
