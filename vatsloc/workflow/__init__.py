"""The two-phase localization: change of pose, then pneumothorax.

`vatsloc.workflow.localize` is the method in one screen; `run_case` runs it from a case folder to a results folder. Each
stage has a module: prepare, pose (phase 1), observe, model_selection and residual (phase 2), then uncertainty, quality
(gates) and check. `Settings` hold every constant that a user may change, `Stages` log a run. Names are imported on
first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vatsloc.lazy import on_first_use

if TYPE_CHECKING:
    from vatsloc.workflow.localization import Localization
    from vatsloc.workflow.model_selection import CollapseModel
    from vatsloc.workflow.pose import ChangeOfPose, change_of_pose
    from vatsloc.workflow.run import run_case
    from vatsloc.workflow.settings import Settings, load_settings, settings_of
    from vatsloc.workflow.stages import Stages

__all__ = [
    "ChangeOfPose",
    "CollapseModel",
    "Localization",
    "Settings",
    "Stages",
    "change_of_pose",
    "load_settings",
    "run_case",
    "settings_of",
]

__getattr__ = on_first_use(
    {
        "vatsloc.workflow.localization": ("Localization",),
        "vatsloc.workflow.model_selection": ("CollapseModel",),
        "vatsloc.workflow.pose": ("ChangeOfPose", "change_of_pose"),
        "vatsloc.workflow.run": ("run_case",),
        "vatsloc.workflow.settings": ("Settings", "load_settings", "settings_of"),
        "vatsloc.workflow.stages": ("Stages",),
    }
)
