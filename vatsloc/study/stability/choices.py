"""What each choice of a run is worth: how far the nodule moves when it is made the other way, case by case."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from registration.volume import Array
from vatsloc.case import Case, read_case
from vatsloc.study.cohort.scored import run_maps
from vatsloc.study.tables import markdown
from vatsloc.workflow.choices import Choice
from vatsloc.workflow.model_selection import STRAIN
from vatsloc.workflow.observe import Observed, observe
from vatsloc.workflow.parted import in_pieces
from vatsloc.workflow.pneumothorax import RESIDUAL, Collapse, collapse, refined
from vatsloc.workflow.pose import FIRST, ChangeOfPose, change_of_pose
from vatsloc.workflow.prepare import Prepared, prepare
from vatsloc.workflow.settings import settings_of
from vatsloc.workflow.stages import Say, Stages, quiet

LIMITS = {
    FIRST: "first_registration_mm",
    STRAIN: "strained_share",
    RESIDUAL: "residual_mm",
}
"""By part, the setting that decides on it."""
KEEP, LEAVE = -1.0, inf


@dataclass(frozen=True)
class Tried:
    """A choice that a run made on a case, and how far the nodule lies, mm, when it is made the other way."""

    case: str
    choice: Choice
    moved_mm: float


@dataclass(frozen=True)
class _Scene:
    """A case, prepared once."""

    case: Case
    prepared: Prepared
    over: Mapping[str, Any]

    def run(self, limits: Mapping[str, float], pose: ChangeOfPose | None, seen: Observed | None) -> _Run:
        """Both phases of `auto` under other limits, with pieces and blocks; pose, seen: where they are those of another
        run.
        """
        settings, stages = settings_of("auto", self.over, {"leave_out": limits}), Stages()
        pose = pose or change_of_pose(self.case, self.prepared, settings, stages)
        seen = seen or observe(self.case, self.prepared, pose, settings, stages)
        found = collapse(self.case, self.prepared, pose, seen, settings, stages)
        cut, found = in_pieces(self.prepared, pose, found, settings, stages)
        found = refined(self.case, self.prepared, cut, found, settings, stages)
        return _Run(self.case, pose, seen, cut, found, tuple(stages.choices))


@dataclass(frozen=True)
class _Run:
    """pose, cut: the change of pose on the whole lung's mesh, and on that of its pieces."""

    case: Case
    pose: ChangeOfPose
    seen: Observed
    cut: ChangeOfPose
    found: Collapse
    choices: tuple[Choice, ...]

    @property
    def nodule(self) -> Array:
        """(3,) RAS mm in the deflated CBCT."""
        maps = run_maps(self.cut, self.found)
        return np.asarray(maps.def_from_ct(self.case.nodule.centre_ras[None])[0])


def try_choices(
    folder: Path, parts: Sequence[str] = tuple(LIMITS), over: Mapping[str, Any] | None = None
) -> list[Tried]:
    """Run a case by `auto`, and again for each of the `parts` that it chose about with that choice turned over.

    over: tables of settings that differ from the preset's.
    """
    case = read_case(folder)
    scene = _Scene(case, prepare(case, Stages()), over or {})
    own = scene.run({}, None, None)
    tried = []
    for choice in (choice for choice in own.choices if choice.part in parts):
        same = (None, None) if choice.part == FIRST else (own.pose, own.seen)
        other = scene.run({LIMITS[choice.part]: LEAVE if choice.kept else KEEP}, *same)
        tried.append(Tried(folder.resolve().name, choice, float(np.linalg.norm(other.nodule - own.nodule))))
    return tried


def study_choices(folders: Sequence[Path], out: Path, say: Say = quiet) -> list[Tried]:
    """Every choice on every case; writes the table `choices.md` into `out`, case by case."""
    out.mkdir(parents=True, exist_ok=True)
    tried: list[Tried] = []
    for folder in folders:
        say(f"{folder.resolve().name} ...")
        tried += try_choices(folder)
        (out / "choices.md").write_text(table(tried) + "\n", encoding="utf-8")
    return tried


def table(tried: Sequence[Tried]) -> str:
    """Markdown, a row per choice."""
    return markdown(
        [
            {
                "part": t.choice.part,
                "case": t.case,
                "": "kept" if t.choice.kept else "left out",
                "value": t.choice.value,
                "limit": t.choice.limit,
                "nodule the other way, mm": t.moved_mm,
            }
            for t in sorted(tried, key=lambda t: (t.choice.part, t.choice.kept, t.case))
        ]
    )
