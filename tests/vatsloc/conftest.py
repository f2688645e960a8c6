"""Fixtures of the DICOM node's test files."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.vatsloc import node_scene as scene
from vatsloc.dicomnet.nodule import NoduleFiles


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Path]]:
    """Series folders of two patients, by patient and scan."""
    folder = tmp_path_factory.mktemp("scans")
    return {patient: scene.write_patient(folder, patient) for patient in ("A-1", "B-2")}


@pytest.fixture
def nodules(tmp_path: Path) -> NoduleFiles:
    """Nodule files of both patients."""
    return scene.nodule_files(tmp_path / "nodules", "A-1", "B-2")
