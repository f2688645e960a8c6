"""The pages under docs/ say nothing that does not work: code runs, settings are known, commands are understood."""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

from tests.vatsloc.test_results import result
from vatsloc.cli import app
from vatsloc.formats.casefile import CaseFile
from vatsloc.phantom_command import ByOption
from vatsloc.results import OUTPUT_FILES, write_results
from vatsloc.workflow.settings import Settings

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted((ROOT / "docs").glob("*.md"))
BLOCK = re.compile(r"^```(\w+)(?: (\w+))?\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(page: Path, language: str, kind: str | None = None) -> list[str]:
    """Blocks of a page in one language, those of the kind "first" first."""
    found = [(word, text) for name, word, text in BLOCK.findall(page.read_text(encoding="utf-8")) if name == language]
    chosen = [(word, text) for word, text in found if kind is None or word == kind]
    return [text for _, text in sorted(chosen, key=lambda pair: pair[0] != "first")]


def run(page: Path) -> dict[str, Any]:
    """Names that a page's Python leaves behind, run in the current folder."""
    names: dict[str, Any] = {}
    for number, text in enumerate(blocks(page, "python"), 1):
        exec(compile(text, f"{page.name}, block {number}", "exec"), names)
    return names


def test_formats_page_sends_a_point_where_the_field_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = result()
    write_results(tmp_path, data)
    monkeypatch.chdir(tmp_path)
    names = run(ROOT / "docs" / "formats.md")
    np.testing.assert_allclose(names["nodule_ras"], data.nodule_deflated_ras, atol=1e-6)
    expected = data.deflated_from_ct(names["ct_ras"][None])[0]
    np.testing.assert_allclose(names["deflated_ras"], expected, atol=2e-3)


def test_formats_page_names_every_file_of_a_result() -> None:
    text = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
    for name in OUTPUT_FILES:
        assert name in text or "_xfm" in name, name


def test_own_case_page_makes_a_case(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    case = run(ROOT / "docs" / "your-own-case.md")["case"]
    # The mean of the voxels nearer than 4 to (35, 30, 30), at 2 mm from -60.
    np.testing.assert_allclose(case.nodule.centre_ras, [10, 0, 0], atol=1e-9)
    assert capsys.readouterr().out.startswith("right Volume")


def test_own_case_page_s_tables_are_known_to_the_readers() -> None:
    page = ROOT / "docs" / "your-own-case.md"
    cases = [CaseFile.model_validate(tomllib.loads(text)) for text in blocks(page, "toml", "case")]
    assert [case.side for case in cases] == ["right", "left"]
    assert cases[1].setup.pleural_gas == "co2"
    (settings,) = (Settings(**tomllib.loads(text)) for text in blocks(page, "toml", "settings"))
    assert (settings.registration.voxel_mm, settings.gates.min_overlap) == (3.0, 0.3)
    assert len(blocks(page, "toml")) == 3


def test_extend_page_s_metric_and_material_hold_what_it_asserts() -> None:
    names = run(ROOT / "docs" / "extend.md")
    assert names["fit"].min_det > 0
    assert names["material"].name == "neo-Hookean with a quadratic bulk term"


@pytest.mark.parametrize("page", ["glossary.md", "method.md"])
def test_files_that_a_page_names_are_there(page: str) -> None:
    named = re.findall(r"`([a-z]\w*/[\w/]+(?:\.py)?)`", (ROOT / "docs" / page).read_text(encoding="utf-8"))
    assert len(named) > 20
    assert [name for name in named if not (ROOT / name).exists()] == []


@pytest.mark.parametrize("page", [*PAGES, ROOT / "README.md"], ids=lambda page: page.name)
def test_commands_of_a_page_are_understood(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    inline = re.findall(r"`(vatsloc [^`]+)`", text)
    lines = [line for block in blocks(page, "sh") for line in block.splitlines() if line.startswith("vatsloc ")]
    for line in inline + lines:
        words = shlex.split(line, comments=True)[1:]
        command: Any = typer.main.get_command(app)
        while words and hasattr(command, "commands"):
            words = command.named(words) if isinstance(command, ByOption) else words
            assert words[0] in command.commands, f"{page.name}: {line}"
            command, words = command.commands[words[0]], words[1:]
        if words:
            command.make_context(line, [word.rstrip(".,;") for word in words], resilient_parsing=False)
