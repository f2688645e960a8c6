"""What the DICOM node takes, with dcmtk as the scanner: only what is whole, allowed and of one patient."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pydicom
import pytest

from tests.vatsloc import node_scene as scene
from tests.vatsloc.dcmtk import needs_dcmtk, program, push
from tests.vatsloc.dicom_scene import write_series
from tests.vatsloc.finding_scene import scan
from vatsloc.dicomnet import store as store_module
from vatsloc.dicomnet.nodule import NoduleFiles
from vatsloc.dicomnet.server import serving
from vatsloc.dicomnet.store import Store, patient_folder
from vatsloc.dicomout.export import SEG_FILE
from vatsloc.errors import CaseError

pytestmark = needs_dcmtk


def test_titles_that_are_not_allowed_are_refused(
    tmp_path: Path, scans: dict[str, dict[str, Path]], nodules: NoduleFiles
) -> None:
    with scene.running(tmp_path / "cases", nodules, allow=("C-ARM", "CT1")) as node:
        assert push(node.port, scans["A-1"]["ct"], title="STRANGER") != 0
        node.wait_said("association refused: STRANGER at 127.0.0.1 is not among the titles of --allow")
        assert node.cases.is_dir()
        assert list(node.cases.iterdir()) == []
        assert push(node.port, scans["A-1"]["ct"], title="CT1") == 0
        node.wait_said("CT of 8 images")


def test_a_series_with_a_gap_waits_is_given_up_and_taken_up_again(
    tmp_path: Path, scans: dict[str, dict[str, Path]], nodules: NoduleFiles
) -> None:
    part, rest = tmp_path / "part", tmp_path / "rest"
    part.mkdir()
    rest.mkdir()
    for file in scans["A-1"]["deflated"].iterdir():
        where = rest if int(pydicom.dcmread(file).InstanceNumber) in (11, 12) else part
        (where / file.name).symlink_to(file)
    with scene.running(tmp_path / "cases", nodules) as node:
        for series in (scans["A-1"]["ct"], scans["A-1"]["inflated"], part):
            assert push(node.port, series) == 0
        node.wait(lambda: "waiting for the rest" in json.dumps(scene.status(node, "A-1")))
        assert node.results() == []
        node.wait_said("given up after 32 images")
        (said,) = [s for s in node.said if "given up" in s]
        assert "misses slices between" in said
        assert node.results() == []
        assert push(node.port, rest) == 0
        node.wait(lambda: len(node.results()) == 1)


def test_a_sender_that_breaks_off_at_the_end_is_not_answered_until_it_sends_again(
    tmp_path: Path, scans: dict[str, dict[str, Path]], nodules: NoduleFiles
) -> None:
    """The slices that came are even, so nothing but the abort tells that the last ones are missing."""
    part = tmp_path / "part"
    part.mkdir()
    for file in scans["A-1"]["deflated"].iterdir():
        if int(pydicom.dcmread(file).InstanceNumber) <= 20:
            (part / file.name).symlink_to(file)
    with scene.running(tmp_path / "cases", nodules) as node:
        assert push(node.port, scans["A-1"]["ct"], scans["A-1"]["inflated"]) == 0
        push(node.port, part, options=("--abort",))
        node.wait_said("broke off")
        node.wait_said("given up after 20 images: the sender broke off after 20 images; push the series again.")
        assert node.results() == []
        assert push(node.port, scans["A-1"]["deflated"]) == 0  # 20 of them for the second time
        node.wait(lambda: len(node.results()) == 1)
    assert pydicom.dcmread(node.results()[0] / SEG_FILE).ReferencedSeriesSequence[0].ReferencedInstanceSequence[33]


def test_a_series_of_fewer_images_than_it_states_waits(tmp_path: Path, nodules: NoduleFiles) -> None:
    folder = write_series(tmp_path / "plain", scan(), scene.ids("A-1", "deflated"))
    stated = scene.reworded(folder, tmp_path / "stated", NumberOfSeriesRelatedInstances="40")
    with scene.running(tmp_path / "cases", nodules) as node:
        assert push(node.port, stated) == 0
        node.wait_said("given up after 34 images: 34 images of 40 have arrived; push the series again.")


def test_duplicates_change_nothing_and_an_impostor_is_refused(
    tmp_path: Path, scans: dict[str, dict[str, Path]], nodules: NoduleFiles
) -> None:
    answered = []

    def count(case: Path, state: Path, out: Path) -> None:
        answered.append(case)
        scene.fast_answer(case, state, out)

    work = replace(scene.FAST_WORK, answer=count)
    with scene.running(tmp_path / "cases", nodules, work) as node:
        for series in scans["A-1"].values():
            assert push(node.port, series) == 0
        node.wait(lambda: len(node.results()) == 1)
        before = {file: file.read_bytes() for file in node.cases.rglob("slices/*.dcm")}
        assert push(node.port, scans["A-1"]["deflated"]) == 0
        changed = scene.reworded(scans["A-1"]["deflated"], tmp_path / "changed", RescaleIntercept="-24")
        push(node.port, changed)
        node.wait_said("another image with the same SOPInstanceUID is here already")
        time.sleep(3 * scene.FAST.settle_s)
        assert {file: file.read_bytes() for file in node.cases.rglob("slices/*.dcm")} == before
    assert len(answered) == 1


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"PatientBirthDate": "19700101"}, "its patient ID is here with another name or birth date"),
        ({"PatientName": "Somebody^Else"}, "its patient ID is here with another name or birth date"),
        ({"PatientID": "B-2"}, "its series is that of another patient"),
        ({"FrameOfReferenceUID": "1.2.3"}, "its frame of reference is not that of the other images of its series"),
        ({"PatientID": ""}, "it states no PatientID"),
        ({"FrameOfReferenceUID": ""}, "it states no FrameOfReferenceUID"),
    ],
)
def test_what_cannot_belong_together_is_refused(
    changes: dict[str, str], says: str, tmp_path: Path, scans: dict[str, dict[str, Path]], nodules: NoduleFiles
) -> None:
    other = scene.reworded(scans["A-1"]["ct"], tmp_path / "other", **changes)
    with scene.running(tmp_path / "cases", nodules) as node:
        assert push(node.port, scans["A-1"]["ct"]) == 0
        assert push(node.port, other) != 0
        node.wait_said(says)
        assert sum(1 for _ in node.cases.rglob("slices/*.dcm")) == 8


def test_one_name_written_in_two_ways_is_one_patient() -> None:
    one = store_module.Patient("A-1", "Doe^Jane^^", "19600101")
    assert not one.contradicts(store_module.Patient("A-1", "DOE JANE", ""))
    assert one.contradicts(store_module.Patient("A-1", "Doe^Jane", "19600102"))
    assert one.contradicts(store_module.Patient("A-2", "Doe^Jane", "19600101"))


def test_ids_that_look_alike_as_folders_are_not_one() -> None:
    names = [patient_folder(i) for i in ("A/1", "A 1", "A_1", "../1", "x" * 100, "x" * 101)]
    assert len(set(names)) == 6
    assert all("/" not in name and "." not in name for name in names)


def test_a_full_disk_is_told_to_the_sender_and_loses_nothing(
    tmp_path: Path, scans: dict[str, dict[str, Path]], nodules: NoduleFiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    with scene.running(tmp_path / "cases", nodules) as node:
        assert push(node.port, scans["A-1"]["ct"]) == 0

        def full(_: int) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        with monkeypatch.context() as patched:
            patched.setattr(store_module.os, "fsync", full)
            assert push(node.port, scans["A-1"]["inflated"]) != 0
            node.wait_said("no space left on the disk of the receiver")
        assert list(node.cases.rglob("partial-*")) == []
        assert sum(1 for _ in node.cases.rglob("slices/*.dcm")) == 8
        for role in ("inflated", "deflated"):
            assert push(node.port, scans["A-1"][role]) == 0
        node.wait(lambda: len(node.results()) == 1)


class Process:
    """A node in a process of its own."""

    def __init__(self, cases: Path, nodules: NoduleFiles, seconds: float) -> None:
        command = [sys.executable, "-m", "tests.vatsloc.node_scene", str(cases), str(nodules.path), str(seconds)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=scene.ROOT)
        self.port = int(self.until("PORT ").split()[-1])

    def until(self, text: str) -> str:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if text in line:
                return line
        raise AssertionError(f"the node ended without saying {text}")

    def kill(self) -> None:
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()


def test_kill_and_restart_lose_nothing(tmp_path: Path, scans: dict[str, dict[str, Path]], nodules: NoduleFiles) -> None:
    """Killed in the middle of a series, then in the middle of an answer."""
    cases = tmp_path / "cases"
    first = Process(cases, nodules, 0.0)
    try:
        assert push(first.port, scans["A-1"]["ct"], scans["A-1"]["inflated"]) == 0
        sender = subprocess.Popen(
            [
                program("storescu"),
                "-aec",
                "VATSLOC",
                "+sd",
                "127.0.0.1",
                str(first.port),
                str(scans["A-1"]["deflated"]),
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        end = time.monotonic() + 30
        while sum(1 for _ in cases.rglob("slices/*.dcm")) <= 8 + 31 + 5:  # CT, inflated, some of the deflated
            assert time.monotonic() < end
    finally:
        first.kill()
    sender.wait(30)
    kept = {file.name for file in cases.rglob("slices/*.dcm")}
    second = Process(cases, nodules, 600.0)
    try:
        assert kept <= {file.name for file in cases.rglob("slices/*.dcm")}
        assert len(kept) < 8 + 31 + 34
        second.until("given up after")  # the half series is known as half, and waits
        assert list(cases.glob("*/answers/*")) == []
        assert push(second.port, scans["A-1"]["deflated"]) == 0
        second.until("answering")
    finally:
        second.kill()
    assert list(cases.glob("*/answers/*/result")) == []
    third = Process(cases, nodules, 0.0)
    try:
        third.until("answered in")
    finally:
        third.kill()
    (result,) = cases.glob("*/answers/*/result")
    assert pydicom.dcmread(result / SEG_FILE).PatientID == "A-1"


def test_two_nodes_do_not_share_a_folder_or_a_port(tmp_path: Path, nodules: NoduleFiles) -> None:
    with scene.running(tmp_path / "cases", nodules) as node:
        with (
            pytest.raises(CaseError, match="is served by another vatsloc listen"),
            scene.running(tmp_path / "cases", nodules),
        ):
            pass
        with (
            pytest.raises(CaseError, match=f"port {node.port} cannot be opened"),
            serving(Store(tmp_path / "more"), node.port, "X", (), print, 5.0),
        ):
            pass
