"""Which nodule is a patient's: a file is never taken for a patient that nothing ties it to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from vatsloc.errors import CaseError
from vatsloc.formats.dicom.header import read_header

SUFFIXES = (".nii.gz", ".nii", ".seg.nrrd", ".nrrd", ".nhdr", ".mha", ".mhd", ".dcm", ".mrk.json", ".json", ".fcsv")
POINTS = (".mrk.json", ".json", ".fcsv")


@dataclass(frozen=True)
class NoduleFiles:
    """path: a file, or a folder with a file for each patient, named by patient ID; patient_id: whom a single file is
    about, "" for a DICOM file, which says so itself."""

    path: Path
    patient_id: str = ""

    def __post_init__(self) -> None:
        if not self.path.exists():
            raise CaseError(f"{self.path} does not exist; correct --nodule.")
        if self.path.is_file() and not (self.patient_id or _stated(self.path)):
            raise CaseError(
                f"{self.path} does not say whose nodule it is; give --ct, or --patient with the patient's ID, or a "
                "folder in which files are named by patient ID."
            )

    def of(self, patient_id: str) -> Path | None:
        """The nodule of a patient, None where there is none. Raises CaseError where a file says it is another's."""
        if self.path.is_file():
            mine = patient_id == (self.patient_id or _stated(self.path))
            found = [self.path] if mine else []
        else:
            found = [f for f in sorted(self.path.iterdir()) if _stem(f.name) == patient_id]
        if len(found) > 1:
            raise CaseError(f"{self.path} holds {len(found)} files for patient {patient_id}; keep one.")
        for file in found:
            if _stated(file) not in ("", patient_id):
                raise CaseError(f"{file} is about patient {_stated(file)}, not {patient_id}; take it away.")
        return found[0] if found else None


def _stem(name: str) -> str:
    suffix = next((s for s in SUFFIXES if name.lower().endswith(s)), None)
    return name if suffix is None else name[: -len(suffix)]


def _stated(file: Path) -> str:
    """Patient ID of a DICOM file, "" for others."""
    header = read_header(file)
    return "" if header is None else header.text("PatientID").strip()
