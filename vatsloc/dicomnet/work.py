"""What is computed for a patient, as functions, so that a node can be given others."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import vatsloc.workflow
from vatsloc.errors import CaseError, InputRefused, NoAnswer, VatslocError

EXITS: dict[int, type[VatslocError]] = {2: CaseError, 3: InputRefused, 4: NoAnswer}
LOG = "localize.log"


@dataclass(frozen=True)
class Work:
    """gas: ml beside the lungs by side in a cone-beam CT, None where that cannot be told; prepare: of a case folder,
    whole or not yet, into a state folder, False where nothing is prepared; answer: of a case folder, with that state if
    there is one, into a results folder. The last two raise VatslocError."""

    gas: Callable[[Path], dict[str, float] | None]
    prepare: Callable[[Path, Path], bool]
    answer: Callable[[Path, Path, Path], None]


def real_work(preset: str) -> Work:
    """The program itself; answers are computed in a process of their own, so that no fault of one ends the node."""
    return Work(gas_of, prepare_if_available, lambda case, state, out: localize_case(case, state, out, preset))


def gas_of(slices: Path) -> dict[str, float] | None:
    """Gas beside the lungs of a cone-beam CT, ml by side; None where its spine or its field of view is not found."""
    from vatsloc.formats.images import read_volume
    from vatsloc.imaging.cbct import prepare_cbct
    from vatsloc.imaging.side import gas_ml
    from vatsloc.imaging.spine import segment_spine

    try:
        prepared = prepare_cbct(read_volume(slices))
        return {
            str(side): ml
            for side, ml in gas_ml(prepared, segment_spine(prepared.volume, prepared.field.usable)).items()
        }
    except InputRefused:
        return None


def prepare_if_available(case: Path, state: Path) -> bool:
    """Prepare what has come of a case, where this program can do that ahead of the deflated scan."""
    prepare: Callable[[Path, Path], None] | None = getattr(vatsloc.workflow, "prepare_case", None)
    if prepare is None:
        return False
    prepare(case, state)
    return True


def localize_case(case: Path, state: Path, out: Path, preset: str) -> None:
    """`vatsloc localize` in a process of its own; its talk goes to a log beside the result.

    Raises the error that its exit code stands for, with its last words.
    """
    ready = ["--state", str(state)] if state.is_dir() else []
    command = [sys.executable, "-m", "vatsloc", "localize", str(case), "--out", str(out), "--preset", preset, *ready]
    log = out.parent / LOG
    with log.open("wb") as talk:
        ended = subprocess.run(command, stdout=talk, stderr=talk, env=os.environ, check=False)
    if ended.returncode not in (0, 5):
        words = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        said = words[-1].removeprefix("vatsloc: ") if words else f"localize ended by {ended.returncode} without a word."
        raise EXITS.get(ended.returncode, NoAnswer)(said)
