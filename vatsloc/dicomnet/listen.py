"""Run a DICOM node until it is told to stop."""

from __future__ import annotations

import fcntl
import os
import secrets
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

from vatsloc.dicomnet.arrival import Patience
from vatsloc.dicomnet.nodule import NoduleFiles
from vatsloc.dicomnet.progress import Progress
from vatsloc.dicomnet.sending import Target
from vatsloc.dicomnet.server import serving
from vatsloc.dicomnet.store import Refused, Store
from vatsloc.dicomnet.work import Work
from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.dicom.series import find_series

STEP_S = 0.5


@dataclass(frozen=True)
class Node:
    """A DICOM node. port: 0 for any; title: its own; allow: titles of callers, all where empty; publish: told of each
    new result and whose it is."""

    cases: Path
    port: int
    title: str = "VATSLOC"
    allow: tuple[str, ...] = ()
    target: Target | None = None
    patience: Patience = field(default_factory=Patience)
    publish: Callable[[Path, str], None] = lambda result, patient_id: None


def listen(
    node: Node,
    nodules: NoduleFiles | None,
    work: Work,
    say: Callable[[str], None],
    stop: threading.Event | None = None,
    ready: Callable[[int], None] = lambda port: None,
) -> None:
    """Serve until `stop` is set. ready: called with the port once associations are taken.

    Raises CaseError where the port cannot be opened, another node serves the same folder, or pynetdicom is missing.
    """
    require_pynetdicom()
    stop = stop or threading.Event()
    with ExitStack() as opened:
        opened.enter_context(_alone(node.cases))
        store = Store(node.cases)
        store.clear_partial()
        progress = Progress(store, nodules, work, node.patience, say, node.target, node.title, node.publish)
        timeout = node.patience.timeout_s
        port = opened.enter_context(serving(store, node.port, node.title, node.allow, say, timeout))
        say(f"{node.title} listens on port {port}, cases in {node.cases}")
        ready(port)
        while not stop.wait(STEP_S):
            progress.step()


@contextmanager
def _alone(cases: Path) -> Iterator[None]:
    """Hold the folder for this process; the lock dies with it, even by kill -9."""
    cases.mkdir(parents=True, exist_ok=True)
    lock = os.open(cases, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise CaseError(
            f"{cases} is served by another vatsloc listen; stop that one, or give another --cases."
        ) from error
    else:
        yield
    finally:
        os.close(lock)


def import_series(cases: Path, folder: Path) -> str:
    """Take a series of a folder as if it had been pushed; returns its patient's ID. Raises InputRefused where it is no
    DICOM series or does not say whose it is."""
    store = Store(cases)
    series = find_series(folder)
    name = f"import-{secrets.token_hex(4)}"
    for header in series.images:
        try:
            store.receive(header.file.read_bytes(), name)
        except Refused as refused:
            raise InputRefused(f"{header.file} cannot be taken: {refused}; give another --ct.") from refused
    store.released(name)
    return series.images[0].text("PatientID").strip()


def require_pynetdicom() -> None:
    """Raise CaseError where the extra is not installed."""
    missing = [name for name in ("pynetdicom", "highdicom") if find_spec(name) is None]
    if missing:
        raise CaseError(f'vatsloc listen needs {" and ".join(missing)}; install it by: pip install "vatsloc[dicom]".')
