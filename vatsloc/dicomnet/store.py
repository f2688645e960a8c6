"""What has been received, on disk: nothing is acknowledged before it is there, and no two patients share a folder.

CASES/PATIENT/patient.json             who it is
CASES/PATIENT/series/SERIES/slices/    the images of one series and nothing else
CASES/PATIENT/series/SERIES/open-*     an association that has sent some of it and was not released since
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import secrets
import threading
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path

import pydicom
from pydicom.dataset import Dataset

from vatsloc.errors import FULL_DISK
from vatsloc.formats.folder import write_whole

OUT_OF_RESOURCES, DUPLICATE, NOT_UNDERSTOOD, MIXED = 0xA700, 0x0111, 0xC000, 0xC001
"""DICOM status codes of a refused image (PS3.7, annex C; PS3.4, B.2.3)."""
_NEEDED = ("PatientID", "StudyInstanceUID", "SeriesInstanceUID", "SOPInstanceUID", "FrameOfReferenceUID")


class Refused(Exception):
    """An image that is not taken. status: DICOM's code; the message says why."""

    def __init__(self, status: int, says: str) -> None:
        super().__init__(says)
        self.status = status


@dataclass(frozen=True)
class Patient:
    """Who a patient is, as the first image said; name and birth_date "" where it did not."""

    patient_id: str
    name: str
    birth_date: str

    def contradicts(self, other: Patient) -> bool:
        """Whether the two cannot be one person. Names are compared without case and empty parts."""
        names = {_plain_name(p.name) for p in (self, other)} - {""}
        dates = {p.birth_date for p in (self, other)} - {""}
        return self.patient_id != other.patient_id or len(names) > 1 or len(dates) > 1


class Store:
    """The folder of all patients. Safe to use from the threads of several associations."""

    def __init__(self, cases: Path) -> None:
        self.cases = cases
        self.active: set[str] = set()
        self.token = secrets.token_hex(4)  # tells associations of this run from those of earlier ones
        self._lock = threading.Lock()
        cases.mkdir(parents=True, exist_ok=True)
        self._owner = {series.name: series.parents[1].name for series in cases.glob("*/series/*")}

    def patients(self) -> list[Path]:
        """Folders of the patients, by name."""
        return sorted(file.parent for file in self.cases.glob("*/patient.json"))

    def clear_partial(self) -> None:
        """Remove what a killed node had not finished writing, and so had not acknowledged."""
        for partial in self.cases.glob("*/series/*/partial-*"):
            partial.unlink(missing_ok=True)

    def receive(self, image: bytes, association: str) -> bool:
        """Keep one image, given as a whole DICOM file; False where the very same is there already.

        Raises Refused for one without identity, of another patient or frame of reference than its series or its patient
        ID, or for which the disk has no room.
        """
        header = _header(image)
        patient = Patient(_text(header, "PatientID"), _text(header, "PatientName"), _text(header, "PatientBirthDate"))
        try:
            with self._lock:
                folder = self._series(header, patient)
                (folder / f"open-{association}").touch()
                self.active.add(association)
            return _keep(folder, _short(_text(header, "SOPInstanceUID")), image)
        except OSError as error:
            if error.errno in FULL_DISK:
                raise Refused(OUT_OF_RESOURCES, "no space left on the disk of the receiver") from error
            raise Refused(OUT_OF_RESOURCES, f"the receiver cannot write ({error.strerror})") from error

    def released(self, association: str) -> None:
        """An association ended as it should: the series that it sent are no longer open, whatever broke off before."""
        for mark in self.cases.glob(f"*/series/*/open-{association}"):
            for stale in mark.parent.glob("open-*"):
                if stale == mark or stale.name.removeprefix("open-") not in self.active:
                    stale.unlink(missing_ok=True)
        self.active.discard(association)

    def ended(self, association: str) -> None:
        """An association is over, released or not; what it left open stays marked."""
        self.active.discard(association)

    def _series(self, header: Dataset, patient: Patient) -> Path:
        """The folder of an image's series, made and checked."""
        owner, series = patient_folder(patient.patient_id), _short(_text(header, "SeriesInstanceUID"))
        if self._owner.get(series, owner) != owner:
            raise Refused(MIXED, f"its series is that of another patient ({self._owner[series]})")
        folder = self.cases / owner
        known = read_patient(folder)
        if known is None:
            folder.mkdir(exist_ok=True)
            write_whole(folder / "patient.json", json.dumps(asdict(patient)) + "\n")
        elif known.contradicts(patient):
            raise Refused(MIXED, "its patient ID is here with another name or birth date")
        folder = folder / "series" / series
        frame = _text(header, "FrameOfReferenceUID")
        if not (folder / "frame.txt").exists():
            (folder / "slices").mkdir(parents=True, exist_ok=True)
            write_whole(folder / "frame.txt", frame)
            self._owner[series] = owner
        elif (folder / "frame.txt").read_text(encoding="utf-8") != frame:
            raise Refused(MIXED, "its frame of reference is not that of the other images of its series")
        return folder


def read_patient(folder: Path) -> Patient | None:
    """Who a patient's folder is about, None where it says nothing."""
    try:
        return Patient(**json.loads((folder / "patient.json").read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def patient_folder(patient_id: str) -> str:
    """A name for the patient's folder: readable, fit for any file system, and never that of another ID."""
    return f"{re.sub(r'[^A-Za-z0-9_-]', '_', patient_id)[:40]}-{_short(patient_id)[:8]}"


def _keep(folder: Path, name: str, image: bytes) -> bool:
    file = folder / "slices" / f"{name}.dcm"
    if file.exists():
        if file.read_bytes() == image:
            return False
        raise Refused(DUPLICATE, "another image with the same SOPInstanceUID is here already")
    partial = folder / f"partial-{secrets.token_hex(6)}"
    try:
        with partial.open("wb") as stream:
            stream.write(image)
            stream.flush()
            os.fsync(stream.fileno())
        partial.replace(file)
    finally:
        partial.unlink(missing_ok=True)
    return True


def _header(image: bytes) -> Dataset:
    try:
        header = pydicom.dcmread(BytesIO(image), stop_before_pixels=True)
        missing = [name for name in _NEEDED if not _text(header, name)]
    except Exception as error:  # whatever pydicom makes of a damaged header
        raise Refused(
            NOT_UNDERSTOOD, f"unreadable header ({str(error).splitlines()[0] if str(error) else '?'})"
        ) from error
    if missing:
        raise Refused(NOT_UNDERSTOOD, f"it states no {', '.join(missing)}")
    return header


def _text(header: Dataset, name: str) -> str:
    return str(header.get(name) or "").strip()


def _plain_name(name: str) -> str:
    return " ".join(part for part in re.split(r"[\^=\s]+", name.casefold()) if part)


def _short(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:20]
