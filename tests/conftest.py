"""Fixtures every test folder shares."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before numpy is imported

SHARED = Path(os.environ.get("VATSLOC_SHARED", Path(__file__).resolve().parents[2] / "shared"))


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder with the shared twin cases and lungs; tests that need it are skipped where it is absent."""
    if not (SHARED / "cases").is_dir():
        pytest.skip("the shared cases are not here")
    return SHARED
