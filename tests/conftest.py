"""Fixtures every test folder shares."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

for threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(threads, "1")  # before numpy is imported; two workers share two cores

LONGEST = (
    "vatsloc/test_localize.py",  # makes the run that others read
    "registration/test_aligned_matching.py",
    "phantoms/test_case.py",
    "vatsloc/test_state.py",
    "vatsloc/test_two_scans.py",
    "registration/test_ffd.py",
)
"""Test files that take longest, first in turn: else one process might be left with one of them at the end. What reads
the shared run comes after the file that makes it, so that neither process waits for the other."""
SHARED = Path(os.environ.get("VATSLOC_SHARED", Path(__file__).resolve().parents[2] / "shared"))


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder with the shared twin cases and lungs; tests that need it are skipped where it is absent."""
    if not (SHARED / "cases").is_dir():
        pytest.skip("the shared cases are not here")
    return SHARED


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first, all others in the order they were found."""
    turn = {name: n for n, name in enumerate(LONGEST)}
    items.sort(key=lambda item: turn.get("/".join(item.path.parts[-2:]), len(turn)))
