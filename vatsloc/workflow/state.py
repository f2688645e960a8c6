"""All that a run knows before the deflated scan is taken, on disk: made by `vatsloc prepare`, taken up by `localize`.

A state belongs to the images, the settings and the program that it was made with; with any others it is refused.
"""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from registration.images.resample import coarsen
from registration.verification import LeftOver
from registration.volume import Array
from vatsloc.case import CaseBefore, read_case_before
from vatsloc.errors import CaseError
from vatsloc.formats.folder import PROGRAM, whole_folder
from vatsloc.formats.trees import digest, flattened, restored
from vatsloc.results import source_digest, versions
from vatsloc.workflow.check import CHECK, VOXEL_MM, compare
from vatsloc.workflow.pose import ChangeOfPose, change_of_pose
from vatsloc.workflow.prepare import PreparedBefore, PreparedCt, prepare_before, prepare_ct
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import INFLATED as INFLATED_CBCT
from vatsloc.workflow.stages import Log, Say, Stages, quiet

STATE_FILE, ARRAYS_FILE = "state.json", "arrays.npz"
CT, INFLATED = "ct", "cbct_inflated"
CALLED = {
    CT: "another CT",
    INFLATED: "another inflated CBCT",
    "nodule": "another nodule",
    "side": "another side",
    "hints": "other hints",
    "settings": "another preset or other settings",
    "program": "another version of the program",
}


@dataclass(frozen=True)
class State:
    """prepared: the CT, and the inflated scan where it was there, which then has its change of pose; left_over: what
    this leaves over by the run's check, None before that; log: what the stages said.
    """

    prepared: PreparedCt
    pose: ChangeOfPose | None
    left_over: LeftOver | None
    log: Log

    @property
    def complete(self) -> tuple[PreparedBefore, ChangeOfPose] | None:
        """What the second phase starts from; None where the inflated scan was not there."""
        if isinstance(self.prepared, PreparedBefore) and self.pose is not None:
            return self.prepared, self.pose
        return None

    @property
    def scans(self) -> tuple[str, ...]:
        """The scans that it was made of."""
        return (CT, INFLATED) if isinstance(self.prepared, PreparedBefore) else (CT,)


def before_collapse(case: CaseBefore, settings: Settings, stages: Stages, known: State | None = None) -> State:
    """All stages that need no deflated scan, but for those whose outcome is known. Raises as `localize`."""
    if known is not None and known.pose is not None:
        return known
    ct = known.prepared if known is not None else prepare_ct(case, stages)
    if case.cbct_inflated is None:
        return State(ct, None, None, stages.log())
    prepared = prepare_before(case, case.cbct_inflated, stages, ct)
    return State(prepared, change_of_pose(case, prepared, settings, stages), None, stages.log())


def begin_check(case: CaseBefore, known: State, stages: Stages) -> None:
    """Begin the comparison of the CT with the inflated scan, beside what follows."""
    if known.complete is not None and known.left_over is None:
        stages.begin(CHECK, INFLATED_CBCT, partial(_left_over, case, *known.complete))


def with_check(case: CaseBefore, known: State, stages: Stages) -> State:
    """With what is left over of the change of pose, where there was one."""
    if known.complete is None or known.left_over is not None:
        return known
    with stages.stage(CHECK, INFLATED_CBCT):
        return replace(known, left_over=stages.done(partial(_left_over, case, *known.complete)), log=stages.log())


def _left_over(case: CaseBefore, prepared: PreparedBefore, pose: ChangeOfPose) -> LeftOver:
    return compare(coarsen(case.ct, VOXEL_MM), prepared.inflated, pose.lung_inf, pose.inf_from_ct)


def prepare_case(folder: Path, out: Path, settings: Settings, say: Say = quiet) -> dict[str, Any]:
    """Write the state of the case in `folder` to `out`, whole or not at all; return what it was made of.

    A state of the CT alone that is there already is gone on from. Raises the errors of reading and of the stages.
    """
    stages = Stages(say)
    with whole_folder(out, (STATE_FILE, ARRAYS_FILE), is_state) as partial, stages.named():
        with stages.stage("read"):
            case = read_case_before(folder)
        for sentence in case.warnings:
            say(f"warning: {sentence}")
        known = _earlier(out, case, settings, say)
        if known is not None:
            stages.resume(known.log)
        with stages.beside():
            known = with_check(case, before_collapse(case, settings, stages, known), stages)
        with stages.stage("write"):
            write_state(partial, known, key_of(case, settings, known.scans))
    return {"state": str(out), "scans": list(known.scans), "seconds": stages.total_seconds}


def key_of(case: CaseBefore, settings: Settings, scans: tuple[str, ...]) -> dict[str, str]:
    """Digests of all that shapes a state made of `scans`."""
    images = {name: digest(getattr(case, name)) for name in scans}
    hints = case.hints.spine_ct_ras, case.hints.spine_cbct_inflated_ras, case.hints.lung_mask_ct
    return {
        **images,
        "nodule": digest(case.nodule),
        "side": case.side,
        "hints": digest(hints),
        "settings": digest(settings.model_dump()),
        "program": digest([source_digest(), versions()]),
    }


def write_state(folder: Path, state: State, key: dict[str, str]) -> None:
    """Write a state into an existing folder."""
    plain, arrays = flattened(state)
    stored = {f"a{number}": _stored(array) for number, array in enumerate(arrays)}
    layout = [[list(array.shape), array.dtype.str, _order(array).tolist()] for array in arrays]
    np.savez(folder / ARRAYS_FILE, allow_pickle=False, **stored)
    text = json.dumps({"program": PROGRAM, "key": key, "layout": layout, "state": plain})
    (folder / STATE_FILE).write_text(text + "\n", encoding="utf-8")


def read_state(folder: Path, case: CaseBefore, settings: Settings) -> State:
    """The state in `folder`. Raises CaseError where there is none, or one of other inputs, settings or programs."""
    told = _json(folder)
    if told is None:
        raise CaseError(f"{folder} holds no state; make one by vatsloc prepare CASE --out {folder}.")
    made = told["key"]
    here = key_of(case, settings, tuple(name for name in (CT, INFLATED) if name in made))
    other = [CALLED[name] for name, value in here.items() if made.get(name) != value]
    if other:
        raise CaseError(
            f"{folder} was prepared with {' and '.join(other)} than this run has; run vatsloc prepare again."
        )
    try:
        with (folder / ARRAYS_FILE).open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = [_laid_out(file[f"a{number}"], *layout) for number, layout in enumerate(told["layout"])]
        state = restored(told["state"], arrays)
        if not isinstance(state, State):
            raise ValueError("it holds something else")
    except (OSError, ValueError, KeyError, TypeError, IndexError, zipfile.BadZipFile) as error:
        raise CaseError(f"{folder} is damaged ({error}); run vatsloc prepare again.") from error
    return state


def is_state(folder: Path) -> bool:
    """Whether a folder holds a state of this program."""
    return _json(folder) is not None


def _json(folder: Path) -> dict[str, Any] | None:
    try:
        told = json.loads((folder / STATE_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    is_ours = isinstance(told, dict) and told.get("program") == PROGRAM and {"key", "layout", "state"} <= set(told)
    return told if is_ours and isinstance(told["key"], dict) else None


def _earlier(out: Path, case: CaseBefore, settings: Settings, say: Say) -> State | None:
    """A state that is there and still holds; None where there is none."""
    if not is_state(out):
        return None
    try:
        return read_state(out, case, settings)
    except CaseError as why:
        say(f"{why} That is done now.")
        return None


def _order(array: Array) -> Array:
    """Axes from the one whose neighbours lie farthest apart in memory to the nearest ones."""
    return np.argsort([-abs(stride) for stride in array.strides], kind="stable")


def _stored(array: Array) -> Array:
    """In the order of memory, booleans as bits."""
    there = np.ascontiguousarray(array.transpose(_order(array)))
    return np.packbits(there) if array.dtype == bool else there


def _laid_out(stored: Array, shape: list[int], dtype: str, order: list[int]) -> Array:
    """The array as it lay in memory: sums over it then add up in the same order."""
    there = tuple(shape[axis] for axis in order)
    if np.dtype(dtype) == bool:
        stored = np.unpackbits(stored, count=int(np.prod(there))).astype(bool).reshape(there)
    return stored.reshape(there).transpose(np.argsort(order))
