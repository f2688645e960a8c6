"""report.html: one file that shows where the nodule is, how uncertain that is, and what the run did.

`report_data` collects what is shown, `render` makes the page of it, `with_scores` adds the errors of an evaluation.
Names are imported on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vatsloc.lazy import on_first_use

if TYPE_CHECKING:
    from vatsloc.report.collect import report_data
    from vatsloc.report.data import Outline, Picture, ReportData, TreSection
    from vatsloc.report.render import render, with_scores

__all__ = ["Outline", "Picture", "ReportData", "TreSection", "render", "report_data", "with_scores"]

__getattr__ = on_first_use(
    {
        "vatsloc.report.collect": ("report_data",),
        "vatsloc.report.data": ("Outline", "Picture", "ReportData", "TreSection"),
        "vatsloc.report.render": ("render", "with_scores"),
    }
)
