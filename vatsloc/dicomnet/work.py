"""What is computed for a patient, as functions, so that a node can be given others."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from vatsloc.errors import CaseError, InputRefused, NoAnswer, VatslocError

EXITS: dict[int, type[VatslocError]] = {2: CaseError, 3: InputRefused, 4: NoAnswer}


@dataclass(frozen=True)
class Work:
    """gas: ml beside the lungs by side in a cone-beam CT, None where that cannot be told; prepare: of a case folder,
    whole or not yet, into a state folder, False where nothing is prepared; answer: of a case folder, with that state if
    there is one, into a results folder. The last two raise VatslocError."""

    gas: Callable[[Path], dict[str, float] | None]
    prepare: Callable[[Path, Path], bool]
    answer: Callable[[Path, Path, Path], None]


def real_work(preset: str) -> Work:
    """The program itself, in processes of its own, so that no fault of one case ends the node."""
    return Work(
        gas_of,
        lambda case, state: prepare_case(case, state, preset),
        lambda case, state, out: localize_case(case, state, out, preset),
    )


def gas_of(slices: Path) -> dict[str, float] | None:
    """Gas beside the lungs of a cone-beam CT, ml by side; None where its spine or its field of view is not found."""
    from vatsloc.formats.images import read_volume
    from vatsloc.imaging.side import gas_ml, seen_in

    try:
        return {str(side): ml for side, ml in gas_ml(seen_in(read_volume(slices))).items()}
    except InputRefused:
        return None


def prepare_case(case: Path, state: Path, preset: str) -> bool:
    """`vatsloc prepare`; its talk goes to a log beside the state. Raises the error that its exit code stands for."""
    _run(["prepare", str(case), "--out", str(state), "--preset", preset], state.parent)
    return True


def localize_case(case: Path, state: Path, out: Path, preset: str) -> None:
    """`vatsloc localize`, from a state where it is there; its talk goes to a log beside the result.

    Raises the error that its exit code stands for, with its last words.
    """
    ready = ["--state", str(state)] if state.is_dir() else []
    _run(["localize", str(case), "--out", str(out), "--preset", preset, *ready], out.parent)


def _run(arguments: list[str], folder: Path) -> None:
    log = folder / f"{arguments[0]}.log"
    with log.open("wb") as talk:
        command = [sys.executable, "-m", "vatsloc", *arguments]
        ended = subprocess.run(command, stdout=talk, stderr=talk, env=os.environ, check=False)
    if ended.returncode not in (0, 5):
        words = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        said = (
            words[-1].removeprefix("vatsloc: ") if words else f"{arguments[0]} ended by {ended.returncode} in silence."
        )
        raise EXITS.get(ended.returncode, NoAnswer)(said)
