"""The answer as DICOM: a segmentation and a measurement report about the deflated scan, for any viewer or archive.

Needs the extra `dicom`. Names are imported on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vatsloc.lazy import on_first_use

if TYPE_CHECKING:
    from vatsloc.dicomout.export import dicom_of_run, export_result
    from vatsloc.dicomout.finding import Finding, finding_of, read_finding
    from vatsloc.dicomout.measurements import measurement_report
    from vatsloc.dicomout.segmentation import segmentation

__all__ = [
    "Finding",
    "dicom_of_run",
    "export_result",
    "finding_of",
    "measurement_report",
    "read_finding",
    "segmentation",
]

__getattr__ = on_first_use(
    {
        "vatsloc.dicomout.export": ("dicom_of_run", "export_result"),
        "vatsloc.dicomout.finding": ("Finding", "finding_of", "read_finding"),
        "vatsloc.dicomout.measurements": ("measurement_report",),
        "vatsloc.dicomout.segmentation": ("segmentation",),
    }
)
