"""Fixtures of vatsloc's test files: most are of the DICOM node's."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.vatsloc import node_scene as scene
from vatsloc import cli, listen_command
from vatsloc.dicomnet.nodule import NoduleFiles


@pytest.fixture(scope="session", autouse=True)
def started() -> Iterator[list[str]]:
    """Notes instead of the processes that compile kernels beside a command: both processors are at work on tests."""
    notes: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        for commands in (cli, listen_command):
            patch.setattr(commands, "compile_beside", lambda: notes.append("compile"))
        yield notes


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Path]]:
    """Series folders of two patients, by patient and scan."""
    folder = tmp_path_factory.mktemp("scans")
    return {patient: scene.write_patient(folder, patient) for patient in ("A-1", "B-2")}


@pytest.fixture
def nodules(tmp_path: Path) -> NoduleFiles:
    """Nodule files of both patients."""
    return scene.nodule_files(tmp_path / "nodules", "A-1", "B-2")
