"""A DICOM node with fast work, and three scans of a patient that are told apart as real ones are."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pydicom

from registration.volume import Volume
from tests.vatsloc import finding_scene as scene
from tests.vatsloc.dicom_scene import Ids, write_series
from vatsloc.dicomnet import store as store_module
from vatsloc.dicomnet.arrival import Patience
from vatsloc.dicomnet.listen import Node, listen
from vatsloc.dicomnet.nodule import NoduleFiles
from vatsloc.dicomnet.sending import Target
from vatsloc.dicomnet.store import patient_folder
from vatsloc.dicomnet.work import Work
from vatsloc.dicomout.export import dicom_of_run, write_objects
from vatsloc.formats.casefile import read_case_file
from vatsloc.formats.folder import whole_folder
from vatsloc.results import write_inputs, write_results

FAST = Patience(settle_s=0.4, timeout_s=3.0)
ROOT = Path(__file__).parents[2]


def ids(patient: str, role: str) -> Ids:
    """Identity of one of a patient's scans; the CT is of another study and frame of reference."""
    n = {"ct": 1, "inflated": 2, "deflated": 3}[role]
    who = 1000 + sum(ord(c) * 7**k for k, c in enumerate(patient))
    root = f"1.2.826.0.1.3680043.8.498.{who}"
    study, frame = (f"{root}.1", f"{root}.11") if role == "ct" else (f"{root}.2", f"{root}.12")
    return Ids(patient, f"Name^{patient}", study, frame, f"{root}.3.{n}", n, role, f"1{n}0000")


def volume(role: str) -> Volume:
    if role == "ct":  # coarse, but as wide as a chest
        return Volume(np.full((12, 12, 8), -500, np.float32), np.diag([-30.0, -30.0, 20.0, 1.0]))
    scan = scene.scan()
    return (
        scan
        if role == "deflated"
        else Volume(scan.hu[:, :, 3:] + np.float32(10), scan.grid.box([0, 0, 3], scan.grid.shape).ras_from_ijk)
    )


def write_patient(folder: Path, patient: str) -> dict[str, Path]:
    """The three series of a patient, by role."""
    return {
        role: write_series(folder / f"{patient}-{role}", volume(role), ids(patient, role))
        for role in ("ct", "inflated", "deflated")
    }


def fast_answer(case: Path, state: Path, out: Path) -> None:
    """A result in no time, with DICOM objects made of the scan that the case names as the deflated one."""
    images = read_case_file(case).images
    data = scene.result(digest=scene.digest(case / images.cbct_deflated))
    objects, why = dicom_of_run(case, data)
    assert why == ""
    with whole_folder(out) as partial:
        write_results(partial, data)
        write_inputs(partial, case, out)
        write_objects(partial, objects)


FAST_WORK = Work(gas=lambda slices: None, prepare=lambda case, state: False, answer=fast_answer)


@dataclass
class Running:
    """A node at work. said: its sentences so far."""

    port: int
    cases: Path
    said: list[str] = field(default_factory=list)

    def wait(self, what: Callable[[], object], seconds: float = 60.0) -> None:
        """Until something is so."""
        end = time.monotonic() + seconds
        while not what():
            assert time.monotonic() < end, "\n".join(self.said)
            time.sleep(0.05)

    def wait_said(self, text: str, times: int = 1, seconds: float = 60.0) -> None:
        self.wait(lambda: sum(text in sentence for sentence in list(self.said)) >= times, seconds)

    def results(self) -> list[Path]:
        return sorted(self.cases.glob("*/answers/*/result"))


@contextmanager
def running(
    cases: Path,
    nodule: NoduleFiles | None,
    work: Work = FAST_WORK,
    target: Target | None = None,
    allow: tuple[str, ...] = (),
    patience: Patience = FAST,
) -> Iterator[Running]:
    """A node in a thread of this process."""
    stop, up = threading.Event(), threading.Event()
    node = Running(0, cases)
    broken: list[BaseException] = []

    def ready(port: int) -> None:
        node.port = port
        up.set()

    def serve() -> None:
        try:
            listen(
                Node(cases, 0, allow=allow, target=target, patience=patience),
                nodule,
                work,
                node.said.append,
                stop,
                ready,
            )
        except BaseException as error:
            broken.append(error)
            up.set()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        assert up.wait(30)
        if broken:
            raise broken[0]
        yield node
    finally:
        stop.set()
        thread.join(30)
    assert not thread.is_alive()
    assert broken == []


def status(node: Running, patient: str) -> dict:
    """What the node says of a patient on disk, as soon as it says something."""
    file = node.cases / patient_folder(patient) / "status.json"
    node.wait(file.exists)
    found: dict = json.loads(file.read_text())
    return found


def nodule_files(folder: Path, *patients: str) -> NoduleFiles:
    """A folder with a nodule for each patient; the fast work never opens it."""
    folder.mkdir(exist_ok=True)
    for patient in patients:
        (folder / f"{patient}.nii.gz").write_bytes(b"nodule of " + patient.encode())
    return NoduleFiles(folder)


def reworded(folder: Path, into: Path, **changes: str) -> Path:
    """A copy of a series with some attributes changed in every image."""
    into.mkdir()
    for file in folder.iterdir():
        ds = pydicom.dcmread(file)
        for name, value in changes.items():
            setattr(ds, name, value)
        ds.save_as(into / file.name)
    return into


def main() -> None:
    """A node in a process of its own: CASES NODULES SECONDS, the seconds that an answer takes.

    Its disk is slow, so that it can be killed in the middle of a series.
    """
    cases, nodules, seconds = Path(sys.argv[1]), NoduleFiles(Path(sys.argv[2])), float(sys.argv[3])

    def slow(case: Path, state: Path, out: Path) -> None:
        time.sleep(seconds)
        fast_answer(case, state, out)

    def slow_sync(descriptor: int) -> None:
        time.sleep(0.04)

    store_module.os = SimpleNamespace(fsync=slow_sync)  # type: ignore[assignment]

    def say(sentence: str) -> None:
        print(sentence, flush=True)

    listen(
        Node(cases, 0, patience=FAST), nodules, replace(FAST_WORK, answer=slow), say, ready=lambda p: say(f"PORT {p}")
    )


if __name__ == "__main__":
    main()
