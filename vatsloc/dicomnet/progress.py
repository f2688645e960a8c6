"""Take each patient one step further: which series are whole, what they are, prepare, answer, send. All on disk.

CASES/PATIENT/before/case.toml, state/       CT and inflated scan, and what was prepared of them
CASES/PATIENT/answers/SCAN/case.toml         the case of one deflated scan
CASES/PATIENT/answers/SCAN/result/           its result; outcome.json and sent.json say how far it is
CASES/PATIENT/status.json                    all of this in words
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from vatsloc.dicomnet.arrival import Arrival, Arrived, Patience, Scan, arrival, keep
from vatsloc.dicomnet.nodule import POINTS, NoduleFiles
from vatsloc.dicomnet.roles import Roles, roles
from vatsloc.dicomnet.sending import Target, send
from vatsloc.dicomnet.store import Store, read_patient
from vatsloc.dicomnet.work import Work
from vatsloc.dicomout.export import SEG_FILE, SR_FILE
from vatsloc.errors import CaseError, VatslocError, as_ours
from vatsloc.formats.casefile import FILE_NAME
from vatsloc.formats.folder import is_result, write_whole

LONGEST_WAIT_S = 60.0
PREPARED = "prepared.txt"
"""The case file that a state was made of."""


@dataclass
class Progress:
    """Everything that a step needs. target: where answers are sent to, None to keep them; title: our own; publish: told
    of each new result and whose it is."""

    store: Store
    nodules: NoduleFiles | None
    work: Work
    patience: Patience
    say: Callable[[str], None]
    target: Target | None = None
    title: str = "VATSLOC"
    publish: Callable[[Path, str], None] = lambda result, patient_id: None
    _told: dict[str, str] = field(default_factory=dict)
    _waits: dict[Path, tuple[float, float]] = field(default_factory=dict)
    _tried: set[Path] = field(default_factory=set)

    def step(self) -> None:
        """Look at every patient once; what goes wrong with one is said and stops no other."""
        for folder in self.store.patients():
            try:
                self._patient(folder)
            except Exception as error:
                self._tell(f"{folder.name}", f"{folder.name}: {as_ours(error, 'What follows the arrival')}")

    def _patient(self, folder: Path) -> None:
        arrivals = {
            series: arrival(series, self.store, self.patience) for series in sorted((folder / "series").iterdir())
        }
        for series, found in arrivals.items():
            self._tell_arrival(folder, series, found)
        whole = [self._with_gas(found.scan) for found in arrivals.values() if found.scan is not None]
        known = roles(whole)
        for n, sentence in enumerate(known.warnings):
            self._tell(f"{folder.name} warning {n}", f"{folder.name}: {sentence}")
        says = self._answers(folder, known)
        _write_status(folder, arrivals, known, says)

    def _answers(self, folder: Path, known: Roles) -> dict[str, str]:
        """Prepare, answer and send what can be; a sentence for each deflated scan, or on what is missing."""
        patient = read_patient(folder)
        if known.ct is None or patient is None:
            return {}
        nodule = None if self.nodules is None else self.nodules.of(patient.patient_id)
        if nodule is None:
            sentence = f"no nodule is known of patient {patient.patient_id}; give one by --nodule."
            self._tell(f"{folder.name} nodule", f"{folder.name}: {sentence}")
            return {"nodule": sentence}
        if not known.deflated:
            self._prepare(folder / "before", known, nodule)
        return {
            scan.folder.name: self._answer(
                folder / "answers" / scan.folder.name, folder / "before", known, scan, nodule
            )
            for scan in known.deflated
        }

    def _prepare(self, before: Path, known: Roles, nodule: Path) -> None:
        """Once for the CT alone, again with the inflated scan; what did not succeed is tried again after a restart."""
        text = _case_text(before, _before(known), nodule)
        if text in (_text(before / PREPARED), self._told.get(f"{before} tried")):
            return
        self._told[f"{before} tried"] = text
        _write_case(before, text, nodule)
        start = time.monotonic()
        try:
            if self.work.prepare(before, before / "state"):
                write_whole(before / PREPARED, text)
                self.say(f"{before.parent.name}: prepared in {time.monotonic() - start:.0f} s")
        except VatslocError as error:
            self._tell(str(before), f"{before.parent.name}: nothing prepared: {error}")

    def _state(self, before: Path, known: Roles, nodule: Path) -> Path:
        """The state of these very scans; a path where nothing is, where there is none."""
        fits = _text(before / PREPARED) == _case_text(before, _before(known), nodule)
        return before / "state" if fits else before / "no-state"

    def _answer(self, folder: Path, before: Path, known: Roles, scan: Scan, nodule: Path) -> str:
        assert known.ct is not None
        assert known.inflated is not None
        outcome = _read(folder / "outcome.json")
        result = folder / "result"
        images = {"ct": known.ct, "cbct_inflated": known.inflated, "cbct_deflated": scan}
        text = _case_text(folder, images, nodule)
        if outcome.get("state") == "failed" and folder in self._tried and _text(folder / FILE_NAME) == text:
            return f"failed: {outcome['says']}"
        if outcome.get("state") != "answered" or not is_result(result):
            self._tried.add(folder)
            _write_case(folder, text, nodule)
            start = time.monotonic()
            self.say(f"{folder.parents[1].name}: answering")
            try:
                self._localize(folder, self._state(before, known, nodule), result)
                if not is_result(result):
                    raise CaseError(
                        f"{result} was not written; run it by hand: vatsloc localize {folder} --out {result}."
                    )
            except VatslocError as error:
                _note(folder / "outcome.json", {"state": "failed", "says": str(error)})
                self.say(f"{folder.parents[1].name}: no answer: {error}")
                return f"failed: {error}"
            seconds = round(time.monotonic() - start, 1)
            _note(folder / "outcome.json", {"state": "answered", "seconds": seconds})
            self.say(f"{folder.parents[1].name}: answered in {seconds:.0f} s, {result}")
            patient = read_patient(folder.parents[1])
            self.publish(result, "" if patient is None else patient.patient_id)
        return self._send(folder, result)

    def _localize(self, case: Path, state: Path, result: Path) -> None:
        """Answer from a state; where that is refused, as after an update of the program, from the scans alone."""
        try:
            self.work.answer(case, state, result)
        except CaseError as error:
            if not state.is_dir():
                raise
            self.say(f"{case.parents[1].name}: not from what was prepared ({error}), so from the scans alone")
            shutil.rmtree(state)
            self.work.answer(case, state, result)

    def _send(self, folder: Path, result: Path) -> str:
        """Send once, again and again with longer and longer waits until the node takes it."""
        files = [result / name for name in (SEG_FILE, SR_FILE) if (result / name).is_file()]
        if not files:
            sentence = f"answered, but {result} holds no DICOM objects; its warnings in run.json say why."
            self._tell(str(folder), f"{folder.parents[1].name}: {sentence}")
            return sentence
        if self.target is None:
            return "answered"
        if _read(folder / "sent.json").get("to") == str(self.target):
            return f"answered, sent to {self.target}"
        due, wait = self._waits.get(folder, (0.0, 1.0))
        if time.monotonic() < due:
            return f"answered, not sent yet; {self.target} is tried again"
        try:
            send(files, self.target, self.title)
        except VatslocError as error:
            self._waits[folder] = (time.monotonic() + wait, min(2 * wait, LONGEST_WAIT_S))
            self._tell(f"{folder} send", f"{folder.parents[1].name}: not sent, tried again from time to time: {error}")
            return f"answered, not sent: {error}"
        _note(folder / "sent.json", {"to": str(self.target), "at": time.strftime("%Y-%m-%dT%H:%M:%S")})
        self.say(f"{folder.parents[1].name}: sent to {self.target}")
        return f"answered, sent to {self.target}"

    def _with_gas(self, scan: Scan) -> Scan:
        """With the gas beside its lungs, looked for once."""
        marker = scan.folder / "gas.txt"
        if scan.kind == "CT" or scan.gas_ml is not None or marker.exists():
            return scan
        scan = replace(scan, gas_ml=self.work.gas(scan.folder / "slices"))
        keep(scan)
        write_whole(marker, "looked for\n")
        return scan

    def _tell_arrival(self, folder: Path, series: Path, found: Arrival) -> None:
        if found.state is Arrived.WHOLE and found.scan is not None:
            scan = found.scan
            self._tell(f"{series}", f"{folder.name}: {scan.kind} of {scan.n} images, {scan.description or series.name}")
        elif found.state is Arrived.INCOMPLETE:
            self._tell(
                f"{series}", f"{folder.name}: series {series.name} given up after {found.n} images: {found.says}"
            )

    def _tell(self, about: str, sentence: str) -> None:
        """Say a sentence about something unless it was the last one said about it."""
        if self._told.get(about) != sentence:
            self._told[about] = sentence
            self.say(sentence)


def _case_text(folder: Path, images: dict[str, Scan], nodule: Path) -> str:
    """case.toml, with paths relative to its folder, so that all cases can be moved together."""
    lines = [f"{name} = {json.dumps(os.path.relpath(scan.folder / 'slices', folder))}" for name, scan in images.items()]
    kind = "point" if nodule.name.lower().endswith(POINTS) else "mask"
    return "\n".join(["[images]", *lines, "", "[nodule]", f"{kind} = {json.dumps(nodule.name)}", ""])


def _before(known: Roles) -> dict[str, Scan]:
    """The scans that need no deflated one, by their names in case.toml."""
    return {n: s for n, s in (("ct", known.ct), ("cbct_inflated", known.inflated)) if s is not None}


def _text(file: Path) -> str:
    return file.read_text(encoding="utf-8") if file.is_file() else ""


def _write_case(folder: Path, text: str, nodule: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(nodule, folder / nodule.name)
    write_whole(folder / FILE_NAME, text)


def _note(path: Path, said: dict[str, Any]) -> None:
    write_whole(path, json.dumps(said, indent=1) + "\n")


def _read(path: Path) -> dict[str, Any]:
    try:
        told: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return told


def _write_status(folder: Path, arrivals: dict[Path, Arrival], known: Roles, answers: dict[str, str]) -> None:
    """status.json, written where it changes."""
    role = {scan.folder: name for name, scan in (("CT", known.ct), ("inflated", known.inflated)) if scan is not None}
    role |= {scan.folder: "deflated" for scan in known.deflated}
    series = {
        path.name: {"images": found.n, "state": found.state.value, "role": role.get(path), "says": found.says}
        for path, found in arrivals.items()
    }
    status = {"series": series, "warnings": list(known.warnings), "answers": answers}
    if _read(folder / "status.json") != status:
        _note(folder / "status.json", status)
