"""A results folder appears whole or not at all.

It is filled as a hidden folder beside the target, held by an exclusive lock, and renamed when complete. The lock dies
with its process, even by kill -9, so the next run can tell a leftover from a run at work and remove it.
"""

from __future__ import annotations

import fcntl
import glob
import json
import os
import secrets
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from vatsloc.errors import CaseError

RUN_FILE = "run.json"
PROGRAM = "vatsloc"
_UNLOCKED_GRACE_S = 60.0


@contextmanager
def whole_folder(
    target: Path, expected: Sequence[str] = (RUN_FILE,), replaceable: Callable[[Path], bool] | None = None
) -> Iterator[Path]:
    """Give a temporary folder that becomes `target` when the block ends well and vanishes when it raises.

    What is at `target` is replaced only then, and only where `replaceable` (by default `is_result`) knows it. Raises
    CaseError when something else is there, RuntimeError when the block left out a file of `expected`.
    """
    target = target.resolve()
    target.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(target)
    replaceable = replaceable or is_result
    _check_replaceable(target, replaceable)
    partial, lock = _locked_folder(target)
    try:
        yield partial
        missing = [name for name in expected if not (partial / name).is_file()]
        if missing:
            raise RuntimeError(f"{', '.join(missing)} not written, so {target} is not made")
        _check_replaceable(target, replaceable)
        _swap(partial, target)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    finally:
        os.close(lock)


def remove_leftovers(target: Path) -> None:
    """Remove what killed runs left beside `target`; a result that was being replaced when killed is put back."""
    for old in _beside(target, "replaced"):
        if target.exists():
            shutil.rmtree(old, ignore_errors=True)
        else:
            old.rename(target)
    for partial in _beside(target, "partial"):
        if not _locked(partial):
            shutil.rmtree(partial, ignore_errors=True)
    for new in _beside(target, "new"):
        if time.time() - new.stat().st_mtime > _UNLOCKED_GRACE_S:
            shutil.rmtree(new, ignore_errors=True)


def is_result(folder: Path) -> bool:
    """Whether a folder holds a result of this program."""
    try:
        run = json.loads((folder / RUN_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(run, dict) and run.get("program") == PROGRAM


def write_whole(path: Path, text: str) -> None:
    """Write one text file whole or not at all."""
    partial = path.with_name(f".{path.name}.partial-{secrets.token_hex(4)}")
    try:
        partial.write_text(text, encoding="utf-8")
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _locked_folder(target: Path) -> tuple[Path, int]:
    """New folder "partial" and the descriptor that holds its lock; it gets this name only once it is locked."""
    token = secrets.token_hex(4)
    new, partial = (target.parent / f".{target.name}.{word}-{token}" for word in ("new", "partial"))
    new.mkdir()
    lock = os.open(new, os.O_RDONLY)
    fcntl.flock(lock, fcntl.LOCK_EX)
    new.rename(partial)
    return partial, lock


def _locked(folder: Path) -> bool:
    try:
        lock = os.open(folder, os.O_RDONLY)
    except FileNotFoundError:
        return True  # its run has just finished
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(lock)
    return False


def _beside(target: Path, word: str) -> list[Path]:
    return sorted(target.parent.glob(f".{glob.escape(target.name)}.{word}-*"))


def _check_replaceable(target: Path, replaceable: Callable[[Path], bool]) -> None:
    if target.is_dir():
        if any(target.iterdir()) and not replaceable(target):
            raise CaseError(f"{target} holds files that {PROGRAM} did not write; give an empty or a new folder.")
    elif target.exists():
        raise CaseError(f"{target} is a file; give the name of a folder.")


def _swap(partial: Path, target: Path) -> None:
    """Two renames, since no portable call exchanges folders; a run killed between them is mended by the next one."""
    if not target.exists():
        partial.rename(target)
        return
    replaced = target.parent / f".{target.name}.replaced-{secrets.token_hex(4)}"
    target.rename(replaced)
    try:
        partial.rename(target)
    except BaseException:
        replaced.rename(target)
        raise
    shutil.rmtree(replaced, ignore_errors=True)
