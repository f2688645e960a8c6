"""From a result to DICOM files beside it, or in a folder of their own."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from pydicom.dataset import Dataset

from vatsloc.case import sha256
from vatsloc.dicomout.finding import Finding, finding_of, read_finding
from vatsloc.errors import CaseError, InputRefused, VatslocError
from vatsloc.formats.casefile import FILE_NAME, read_case_file
from vatsloc.formats.dicom.source import SourceSeries, is_dicom, read_source
from vatsloc.formats.folder import whole_folder
from vatsloc.results import INPUTS, ResultData, case_of, read_run

SEG_FILE, SR_FILE = "nodule_seg.dcm", "measurements_sr.dcm"


def export_result(result: Path, out: Path, series: Path | None = None) -> list[Path]:
    """Write Segmentation and report of a results folder into `out`; returns the files.

    series: of the deflated scan, where its case has it elsewhere or in another format. Without it the case folder that
    run.json names is asked. Raises CaseError where there is no series, InputRefused where it is not that of the result.
    """
    require_highdicom()
    finding = read_finding(result)
    source = read_source(series) if series is not None else _source_of(result)
    objects = dicom_objects(finding, source)
    with whole_folder(out, tuple(objects), _only_ours) as partial:
        write_objects(partial, objects)
    return [out / name for name in objects]


def dicom_of_run(case: Path, result: ResultData) -> tuple[dict[str, Dataset], str]:
    """Objects of a run in memory by file name, and why there are none ("" also where the deflated scan is no DICOM)."""
    images = read_case_file(case).images
    path = case / (images.cbct_deflated or "")
    if images.cbct_deflated is None or not is_dicom(path):
        return {}, ""
    try:
        require_highdicom()
        return dicom_objects(finding_of(result), read_source(path, images.cbct_deflated_series)), ""
    except VatslocError as error:
        return {}, str(error)


def dicom_objects(finding: Finding, source: SourceSeries) -> dict[str, Dataset]:
    """Segmentation and report by file name."""
    from vatsloc.dicomout.measurements import measurement_report
    from vatsloc.dicomout.segmentation import segmentation

    seg = segmentation(finding, source)
    return {SEG_FILE: seg, SR_FILE: measurement_report(finding, source, seg)}


def write_objects(folder: Path, objects: dict[str, Dataset]) -> None:
    """Write objects as DICOM files with preamble and file meta information."""
    for name, dataset in objects.items():
        dataset.save_as(folder / name, enforce_file_format=True)


def require_highdicom() -> None:
    """Raise CaseError where the extra is not installed."""
    if find_spec("highdicom") is None:
        raise CaseError('DICOM output needs highdicom; install it by: pip install "vatsloc[dicom]".')


def _source_of(result: Path) -> SourceSeries:
    """The deflated series of the case that a result names, if it is still the one that the run read."""
    ask = "give the DICOM series of the deflated scan by --series"
    case = case_of(result)
    if case is None:
        raise CaseError(f"{result} does not name its case ({INPUTS}); {ask}.")
    if not (case / FILE_NAME).is_file():
        raise CaseError(f"the case of {result}, {case}, is not there any more; {ask}.")
    images = read_case_file(case).images
    if images.cbct_deflated is None:
        raise CaseError(f"{case / FILE_NAME} names no deflated scan any more; {ask}.")
    path = case / images.cbct_deflated
    if not path.exists():
        raise CaseError(f"{path}, the deflated scan of {result}, is not there any more; {ask}.")
    if not is_dicom(path):
        raise CaseError(f"{path}, the deflated scan of {result}, is no DICOM; {ask}.")
    if sha256(path) != read_run(result)["input_sha256"]["cbct_deflated"]:
        raise InputRefused(f"{path} has changed since {result} was made; run localize again, or {ask}.")
    return read_source(path, images.cbct_deflated_series)


def _only_ours(folder: Path) -> bool:
    """Whether a folder holds an earlier export and nothing else."""
    return {file.name for file in folder.iterdir()} <= {SEG_FILE, SR_FILE}
