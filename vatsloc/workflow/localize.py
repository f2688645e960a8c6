"""The whole method in one screen. Ref: Alvarez 2021.

`prepare` reads off each image what registrations need: lungs, airways, spines, fields of view. `change_of_pose` is
phase 1, from the CT to the inflated cone-beam CT. `pneumothorax` is phase 2, from the inflated to the deflated one.
`locate_nodule` carries the nodule through both and says how uncertain it is. `checked` compares the result with both
scans by keypoints that nothing before it has used. Whatever of this needs no deflated scan may be known from before,
from `before_collapse` in vatsloc/workflow/state.py.
"""

from __future__ import annotations

from vatsloc.case import Case
from vatsloc.workflow.localization import Localization, checked, locate_nodule
from vatsloc.workflow.pneumothorax import pneumothorax
from vatsloc.workflow.pose import change_of_pose
from vatsloc.workflow.prepare import prepare
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import Stages
from vatsloc.workflow.state import State


def localize(case: Case, settings: Settings, stages: Stages, state: State | None = None) -> Localization:
    """Find the nodule of a case in its deflated cone-beam CT. state: what the images from before the collapse told.

    Raises InputRefused for images that do not show what they should, NotConverged when a solver has no answer.
    """
    known, pose, left = (None, None, None) if state is None else (state.prepared, state.pose, state.left_over)
    prepared = prepare(case, stages, known)
    pose = pose or change_of_pose(case, prepared, settings, stages)
    collapse = pneumothorax(case, prepared, pose, settings, stages)
    found = locate_nodule(case, prepared, pose, collapse, settings, stages)
    return checked(case, found, settings, stages, left)
