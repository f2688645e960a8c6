"""The DICOM node on loopback, with dcmtk as scanner and archive: what has come in whole is answered and sent."""

from __future__ import annotations

import socket
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import highdicom as hd
import pydicom
import pytest

from tests.vatsloc import node_scene as scene
from tests.vatsloc.dcmtk import archive, free_port, needs_dcmtk, push
from tests.vatsloc.dicom_scene import Ids, write_series
from tests.vatsloc.finding_scene import scan
from vatsloc.dicomnet.listen import import_series
from vatsloc.dicomnet.nodule import NoduleFiles
from vatsloc.dicomnet.sending import Target
from vatsloc.dicomnet.server import confirm_the_next_at_once
from vatsloc.dicomnet.store import patient_folder
from vatsloc.dicomout.export import SEG_FILE
from vatsloc.errors import CaseError, InputRefused

pytestmark = needs_dcmtk


def test_three_series_pushed_come_back_as_segmentation_and_report(
    tmp_path: Path, scans: dict[str, dict[str, Path]], nodules: NoduleFiles
) -> None:
    port = free_port()
    with (
        archive(tmp_path / "archive", port) as received,
        scene.running(tmp_path / "cases", nodules, target=Target("127.0.0.1", port, "ARCHIVE")) as node,
    ):
        for role in ("deflated", "ct", "inflated"):  # the order of arrival tells nothing
            assert push(node.port, scans["A-1"][role]) == 0
        node.wait_said("sent to ARCHIVE")
        files = sorted(received.iterdir())
    assert len(files) == 2
    by_modality = {pydicom.dcmread(file).Modality: file for file in files}
    seg, report = hd.seg.segread(by_modality["SEG"]), hd.sr.srread(by_modality["SR"])
    source = [pydicom.dcmread(file) for file in scans["A-1"]["deflated"].iterdir()]
    assert {seg.PatientID, report.PatientID} == {"A-1"}
    assert seg.FrameOfReferenceUID == source[0].FrameOfReferenceUID
    assert seg.ReferencedSeriesSequence[0].SeriesInstanceUID == source[0].SeriesInstanceUID
    own = {str(ds.SOPInstanceUID) for ds in source}
    frames = seg.PerFrameFunctionalGroupsSequence
    named = {str(f.DerivationImageSequence[0].SourceImageSequence[0].ReferencedSOPInstanceUID) for f in frames}
    assert named <= own
    told = scene.status(node, "A-1")
    assert sorted((s["role"], s["state"]) for s in told["series"].values()) == [
        ("CT", "whole"),
        ("deflated", "whole"),
        ("inflated", "whole"),
    ]
    assert list(told["answers"].values()) == [f"answered, sent to ARCHIVE@127.0.0.1:{port}"]


def test_two_patients_pushed_at_once_in_one_association_are_kept_apart(
    tmp_path: Path, scans: dict[str, dict[str, Path]], nodules: NoduleFiles
) -> None:
    mixed = tmp_path / "mixed"
    mixed.mkdir()
    files = [file for patient in scans.values() for folder in patient.values() for file in folder.iterdir()]
    for n, file in enumerate(sorted(files, key=lambda f: f.name)):  # names interleave patients and series
        (mixed / f"{n:04d}.dcm").symlink_to(file)
    with scene.running(tmp_path / "cases", nodules) as node:
        assert push(node.port, mixed) == 0
        node.wait(lambda: len(node.results()) == 2)
    for patient, other in (("A-1", "B-2"), ("B-2", "A-1")):
        folder = node.cases / patient_folder(patient)
        ids = {pydicom.dcmread(file, stop_before_pixels=True).PatientID for file in folder.rglob("slices/*.dcm")}
        assert ids == {patient}
        (result,) = folder.glob("answers/*/result")
        assert pydicom.dcmread(result / SEG_FILE).PatientID == patient
        assert (result.parent / f"{patient}.nii.gz").read_bytes() == b"nodule of " + patient.encode()
        assert not list(folder.rglob(f"{other}.nii.gz"))


def test_an_archive_that_is_down_gets_the_answer_when_it_is_up_also_after_a_restart(
    tmp_path: Path, scans: dict[str, dict[str, Path]], nodules: NoduleFiles
) -> None:
    port = free_port()
    target = Target("127.0.0.1", port, "ARCHIVE")
    with scene.running(tmp_path / "cases", nodules, target=target) as node:
        assert push(node.port, *scans["A-1"].values()) == 0
        node.wait_said(f"not sent, tried again from time to time: ARCHIVE@127.0.0.1:{port} does not answer")
    with scene.running(tmp_path / "cases", nodules, target=target) as node:
        node.wait_said("not sent")
        with archive(tmp_path / "archive", port) as received:
            node.wait_said("sent to ARCHIVE")
            assert len(list(received.iterdir())) == 2
            assert not any("answering" in sentence for sentence in node.said)
    with (
        archive(tmp_path / "archive2", port) as received,
        scene.running(node.cases, nodules, target=target) as node,
    ):
        node.wait(lambda: (node.cases / patient_folder("A-1") / "status.json").exists())
        time.sleep(2.0)
        assert list(received.iterdir()) == []  # once is enough


def test_one_answer_that_fails_is_said_and_stops_no_other_and_is_tried_after_a_restart(
    tmp_path: Path, scans: dict[str, dict[str, Path]], nodules: NoduleFiles
) -> None:
    def picky(case: Path, state: Path, out: Path) -> None:
        if (case / "A-1.nii.gz").exists():
            raise InputRefused("The deflated CBCT shows no lung; give another one.")
        scene.fast_answer(case, state, out)

    with scene.running(tmp_path / "cases", nodules, replace(scene.FAST_WORK, answer=picky)) as node:
        assert push(node.port, *scans["A-1"].values(), *scans["B-2"].values()) == 0
        node.wait(lambda: len(node.results()) == 1)
        node.wait_said("no answer: The deflated CBCT shows no lung; give another one.")
        time.sleep(1.5)
        assert sum("no answer" in sentence for sentence in node.said) == 1
    with scene.running(tmp_path / "cases", nodules) as node:
        node.wait(lambda: len(node.results()) == 2)


def test_a_patient_without_a_nodule_is_said_and_not_answered_with_another_s(
    tmp_path: Path, scans: dict[str, dict[str, Path]]
) -> None:
    one = tmp_path / "nodule.nii.gz"
    one.write_bytes(b"nodule of A-1")
    with scene.running(tmp_path / "cases", NoduleFiles(one, "A-1")) as node:
        assert push(node.port, *scans["B-2"].values(), *scans["A-1"].values()) == 0
        node.wait_said("no nodule is known of patient B-2; give one by --nodule.")
        node.wait(lambda: len(node.results()) == 1)
        assert node.results()[0].parents[2].name == patient_folder("A-1")


def test_scans_are_prepared_before_the_deflated_one_comes(
    tmp_path: Path, scans: dict[str, dict[str, Path]], nodules: NoduleFiles
) -> None:
    seen: list[str] = []
    with_state: list[bool] = []

    def prepare(case: Path, state: Path) -> bool:
        seen.append((case / "case.toml").read_text())
        state.mkdir(exist_ok=True)
        return True

    def answer(case: Path, state: Path, out: Path) -> None:
        with_state.append(state.is_dir())
        if state.is_dir():
            raise CaseError("the state is of another version of the program; prepare it again.")
        scene.fast_answer(case, state, out)

    work = replace(scene.FAST_WORK, prepare=prepare, answer=answer)
    with scene.running(tmp_path / "cases", nodules, work) as node:
        assert push(node.port, scans["A-1"]["ct"]) == 0
        node.wait_said("prepared in")
        assert push(node.port, scans["A-1"]["inflated"]) == 0
        node.wait_said("prepared in", times=2)
    assert ["cbct_inflated" in text for text in seen] == [False, True]
    assert not any("cbct_deflated" in text for text in seen)
    with scene.running(tmp_path / "cases", nodules, work) as node:  # what was prepared is known after a restart
        assert push(node.port, scans["A-1"]["deflated"]) == 0
        node.wait(lambda: len(node.results()) == 1)
        node.wait_said("not from what was prepared (the state is of another version of the program")
    assert with_state == [True, False]  # a state that is refused costs no answer
    assert len(seen) == 2


def test_a_ct_that_is_here_already_is_taken_as_if_pushed(tmp_path: Path, scans: dict[str, dict[str, Path]]) -> None:
    assert import_series(tmp_path / "cases", scans["A-1"]["ct"]) == "A-1"
    nodule = tmp_path / "nodule.nii.gz"
    nodule.write_bytes(b"x")
    with scene.running(tmp_path / "cases", NoduleFiles(nodule, "A-1")) as node:
        assert push(node.port, scans["A-1"]["inflated"], scans["A-1"]["deflated"]) == 0
        node.wait(lambda: len(node.results()) == 1)
    anonymous = write_series(tmp_path / "anonymous", scan(), Ids(patient=""))
    with pytest.raises(InputRefused, match="it states no PatientID; give another --ct"):
        import_series(tmp_path / "cases", anonymous)


def test_after_an_answer_the_next_message_is_confirmed_at_once_and_a_lost_connection_is_no_error() -> None:
    """Otherwise each image of a sender that gathers small writes costs 40 ms."""
    calls: list[tuple[int, int, int]] = []
    stand_in = SimpleNamespace(setsockopt=lambda *call: calls.append(call))
    closed = socket.socket()
    closed.close()
    for connection in (SimpleNamespace(socket=stand_in), SimpleNamespace(socket=closed), None):
        confirm_the_next_at_once(SimpleNamespace(assoc=SimpleNamespace(dul=SimpleNamespace(socket=connection))))
    assert calls == [(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)]
