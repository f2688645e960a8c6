"""Finds a lung nodule in the collapsed lung: CT and two cone-beam CTs in, position and uncertainty out.

`read_case` reads a case folder, `localize` runs the method on it in memory, `run_case` from folder to results folder,
`evaluate_case` scores a result with landmarks. Below stand the rooms `vatsloc.formats` (files), `vatsloc.imaging` (what
images show), `vatsloc.workflow` (the method), `vatsloc.evaluation`, `vatsloc.report`, `vatsloc.synthetic` (cases with
known truth) and `vatsloc.study` (measurements of the product); on top, `vatsloc.cli`. Names are imported on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vatsloc.lazy import on_first_use

if TYPE_CHECKING:
    from vatsloc.case import Case, read_case
    from vatsloc.errors import VatslocError
    from vatsloc.evaluation import evaluate_case
    from vatsloc.workflow.localization import Localization
    from vatsloc.workflow.localize import localize
    from vatsloc.workflow.run import run_case
    from vatsloc.workflow.settings import Settings, load_settings
    from vatsloc.workflow.stages import Stages

__all__ = [
    "Case",
    "Localization",
    "Settings",
    "Stages",
    "VatslocError",
    "evaluate_case",
    "load_settings",
    "localize",
    "read_case",
    "run_case",
]

__getattr__ = on_first_use(
    {
        "vatsloc.case": ("Case", "read_case"),
        "vatsloc.errors": ("VatslocError",),
        "vatsloc.evaluation": ("evaluate_case",),
        "vatsloc.workflow.localization": ("Localization",),
        "vatsloc.workflow.localize": ("localize",),
        "vatsloc.workflow.run": ("run_case",),
        "vatsloc.workflow.settings": ("Settings", "load_settings"),
        "vatsloc.workflow.stages": ("Stages",),
    }
)
