"""What takes long to make and is only read: made by the first test that asks, for all test files and processes."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

PRESET = "fast"
EVERY_PART = {"leave_out": {"residual_mm": -1.0}}
"""Settings with which the preset leaves out no registration, so that every gate is there."""
"""Of the shared run."""


def made_once(session: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """Folder `name` of a test session, filled by `make`, which gets the empty folder. Nobody may write to it later."""
    root = session.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent  # a process has a folder of its own in the session's
    folder = root / "made_once" / name
    folder.parent.mkdir(exist_ok=True)
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            partial = folder.with_suffix(".partial")
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir()
            make(partial)
            partial.rename(folder)
    return folder


class OpenedFiles:
    """Names of the files that Python opens while `on`. Python keeps an audit hook until it ends."""

    def __init__(self) -> None:
        self.names: set[str] = set()
        self.on = True
        sys.addaudithook(self._note)

    def _note(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self.on and event == "open" and isinstance(arguments[0], str | bytes):
            self.names.add(os.fsdecode(arguments[0]))


def demo_case(session: pytest.TempPathFactory) -> Path:
    """Case folder of the phantom demo, with landmarks and truth."""

    def make(folder: Path) -> None:
        from vatsloc.synthetic.case import write_phantom

        write_phantom("demo", folder / "case")

    return made_once(session, "demo", make) / "case"


def bare_case(session: pytest.TempPathFactory) -> Path:
    """The same case with nonsense for landmarks and truth: who reads them stumbles."""

    def make(folder: Path) -> None:
        shutil.copytree(demo_case(session), folder / "case")
        for path in (*folder.glob("case/landmarks_*"), *folder.glob("case/truth/*")):
            path.write_bytes(b"nonsense")

    return made_once(session, "bare", make) / "case"


def demo_run(session: pytest.TempPathFactory) -> Path:
    """Folder of `result`, what a run of `bare_case` with preset fast and EVERY_PART wrote, and `opened.json`, what that
    opened.
    """
    case = bare_case(session)

    def make(folder: Path) -> None:
        from vatsloc.workflow.run import run_case
        from vatsloc.workflow.settings import settings_of

        opened = OpenedFiles()
        run_case(case, folder / "result", settings_of(PRESET, EVERY_PART))
        opened.on = False
        (folder / "opened.json").write_text(json.dumps(sorted(opened.names)), encoding="utf-8")

    return made_once(session, "run", make)
