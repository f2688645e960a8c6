"""dcmtk's programs as scanner and archive."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


def _found(name: str) -> str | None:
    """Where a program of dcmtk is. pynetdicom puts others of the same names beside Python, which are passed over."""
    own = Path(sys.executable).parent
    places = [place for place in os.environ.get("PATH", "").split(os.pathsep) if place and Path(place) != own]
    return shutil.which(name, path=os.pathsep.join(places))


def program(name: str) -> str:
    """The path of a program of dcmtk."""
    found = _found(name)
    assert found is not None, f"{name} of dcmtk is not installed"
    return found


needs_dcmtk = pytest.mark.skipif(_found("storescu") is None, reason="dcmtk is not installed")


def push(port: int, *paths: Path, title: str = "SCANNER", options: tuple[str, ...] = ()) -> int:
    """Exit code of dcmtk's storescu."""
    command = [
        program("storescu"),
        "-aet",
        title,
        "-aec",
        "VATSLOC",
        *options,
        "+sd",
        "127.0.0.1",
        str(port),
        *map(str, paths),
    ]
    return subprocess.run(command, capture_output=True, timeout=120, check=False).returncode


def free_port() -> int:
    """A port that nobody listens on at the moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def archive(folder: Path, port: int) -> Iterator[Path]:
    """dcmtk's storescp, which keeps what it is sent."""
    folder.mkdir(exist_ok=True)
    command = [program("storescp"), "-od", str(folder), "-aet", "ARCHIVE", "+xa", str(port)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            end = time.monotonic() + 20
            while subprocess.run(
                [program("echoscu"), "127.0.0.1", str(port)], capture_output=True, check=False
            ).returncode:
                assert time.monotonic() < end
                time.sleep(0.1)
            yield folder
        finally:
            process.terminate()
