"""From the CT of a case to a forecast on disk: `vatsloc foresee`, before surgery."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from registration.volume import Mask
from vatsloc.case import CaseBefore, read_case_before
from vatsloc.formats.folder import PROGRAM, whole_folder
from vatsloc.formats.markups import PointList, write_points
from vatsloc.frames import flip_points
from vatsloc.report.data import LUNG, SURFACE, Nodule, Outline, Picture
from vatsloc.report.render import write_forecast
from vatsloc.report.words import WORDS
from vatsloc.results import REPORT
from vatsloc.workflow.forecast import Forecast, calibrated_motions, forecast, middle_of
from vatsloc.workflow.prepare import prepare_lungs
from vatsloc.workflow.stages import Say, Stages, quiet

FORECAST_FILE, NODULE_FILE = "foresee.json", "nodule_foreseen_ct.mrk.json"
FILES = (FORECAST_FILE, NODULE_FILE, REPORT)
IS_FORECAST = (
    "This is a forecast before surgery: what phantoms' lungs did, carried over to this one. No image of the collapsed "
    "lung has been seen; localize with one once it is there."
)


def foresee_case(folder: Path, out: Path, say: Say = quiet) -> dict[str, Any]:
    """Forecast where the nodule of the case in `folder` goes, write it to `out`, whole or not at all; return the JSON.

    Raises the errors of reading the CT and of its lungs; `out` is then untouched.
    """
    stages = Stages(say)
    with whole_folder(out, FILES, is_forecast) as partial, stages.named():
        with stages.stage("read"):
            case = read_case_before(folder, ("ct",))
        for sentence in case.warnings:
            stages.warn(sentence)
        lungs = prepare_lungs(case, stages)
        lung = lungs.of(case.side)
        middle = middle_of(lung)
        motions = calibrated_motions("deflated")
        found = forecast(case.nodule.centre_ras, middle, case.side, motions, case.pleural_gas)
        stages.warn(IS_FORECAST)
        told = _told(case, found, stages)
        with stages.stage("report"):
            nodule = Nodule(found.centre, found.axes * found.semi_axes_mm[:, None])
            write_forecast(partial / REPORT, case.folder.resolve().name, told, _picture(case, lung, found), nodule)
        write_points(partial / NODULE_FILE, PointList(found.centre[None], ("nodule",), ("forecast, not measured",)))
        (partial / FORECAST_FILE).write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    return told


def is_forecast(folder: Path) -> bool:
    """Whether a folder holds a forecast of this program."""
    try:
        told = json.loads((folder / FORECAST_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(told, dict) and told.get("program") == PROGRAM


def _picture(case: CaseBefore, lung: Mask, found: Forecast) -> Picture:
    """The CT with what has been seen so far outlined, through the forecast."""
    lines = [Outline(WORDS["forecast_lung"], LUNG, lung)]
    if case.nodule.mask is not None:
        lines.append(Outline(WORDS["forecast_nodule"], SURFACE, case.nodule.mask))
    title, says = WORDS["forecast_picture"], WORDS["forecast_picture_says"]
    return Picture(title, says, case.ct, found.centre, tuple(lines))


def _told(case: CaseBefore, found: Forecast, stages: Stages) -> dict[str, Any]:
    return {
        "program": PROGRAM,
        "nodule_lps": flip_points(found.centre).tolist(),
        "nodule_ellipsoid95_mm": found.semi_axes_mm.tolist(),
        "nodule_ellipsoid95_axes_lps": flip_points(found.axes).tolist(),
        "frame": "ct",
        "nodule_ct_lps": flip_points(case.nodule.centre_ras).tolist(),
        "moves_mm": float(np.linalg.norm(found.centre - case.nodule.centre_ras)),
        "side": case.side,
        "pleural_gas": case.pleural_gas,
        "persons": found.persons,
        "warnings": list(stages.warnings),
    }
