"""Each use of `vatsloc phantom` gets its own options, and none that belong to another use."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from vatsloc import synthetic
from vatsloc.cli import main
from vatsloc.errors import CaseError, InputRefused
from vatsloc.phantom_command import phantom, subcommand_of
from vatsloc.study.cohort import contact_sheet, suite
from vatsloc.synthetic import case, series
from vatsloc.terminal import say

CASE = ("write_phantom", "demo", Path("c"), 0, say, None)
SUITE = ("write_suite", Path("d"), 1, say, None)


def twin(side: str = "right", name: str | None = None, nodule: Path | None = None, cbct: str | None = None) -> Any:
    return ("write_twin", Path("f"), side, Path("c"), name, 0, nodule, say, cbct)


def run(capsys: pytest.CaptureFixture[str], words: str) -> tuple[Any, str, str]:
    with pytest.raises(SystemExit) as end:
        main(["phantom", *words.split()])
    return end.value.code, *capsys.readouterr()


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What the command asks of those that write cases: the name of the function and what it was given."""
    found: list[Any] = []

    def watch(room: Any, name: str, answer: Any = None) -> None:
        def ask(*values: Any, **named: Any) -> Any:
            found.append((name, *values, *named.items()))
            return answer

        monkeypatch.setattr(room, name, ask)

    watch(synthetic, "write_phantom")
    watch(case, "write_twin")
    watch(series, "write_series")
    watch(suite, "write_suite", ["a", "b"])
    watch(contact_sheet, "write_sheet")
    monkeypatch.setattr(suite, "table", lambda made: f"table of {made}")
    return found


@pytest.mark.parametrize(
    ("words", "made"),
    [
        ("demo --out c", CASE),
        ("case demo --out c", CASE),
        ("--out c demo", CASE),
        ("demo --out c --seed 3 --cbct projection", (*CASE[:3], 3, say, "projection")),
        ("--from-ct f --side right --out c", twin()),
        ("--from-ct=f --out=c", twin()),
        ("twin --from-ct f --out c --cbct projection", twin(cbct="projection")),
        ("base --from-ct f --side left --out c --nodule n --seed 0", twin("left", "base", Path("n"))),
        ("--from-ct f --series 20 --out c", ("write_series", Path("f"), "right", Path("c"), 20, 0, say)),
        (
            "--from-ct f --series 10 --out c --side left --seed 2",
            ("write_series", Path("f"), "left", Path("c"), 10, 2, say),
        ),
    ],
)
def test_each_use_gets_what_was_said_and_its_defaults(
    words: str, made: tuple[Any, ...], asked: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = run(capsys, words)
    assert code == 0
    assert asked == [made]
    assert out == "c\n"


@pytest.mark.parametrize("words", ["--suite d", "suite --suite d", "--suite d --jobs 1"])
def test_the_suite_is_written_and_its_table_printed(
    words: str, asked: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = run(capsys, words)
    assert (code, asked, out) == (0, [SUITE], "table of ['a', 'b']\n")


def test_the_suite_s_sheet_shows_its_cases_beside_another(asked: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    code, _, _ = run(capsys, "--suite d --jobs 2 --cbct projection --sheet s.png --beside b")
    sheet = ("write_sheet", [Path("d/a"), Path("d/b")], Path("s.png"), ("beside", Path("b")))
    assert code == 0
    assert asked == [("write_suite", Path("d"), 2, say, "projection"), sheet]


def test_a_sheet_is_drawn_of_any_cases(asked: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "sheet a b --out s.jpg --columns 1")
    assert (code, out) == (0, "s.jpg\n")
    assert asked == [("write_sheet", [Path("a"), Path("b")], Path("s.jpg"), 1)]


@pytest.mark.parametrize(
    ("words", "use", "sentence"),
    [
        ("demo", "case", "Missing option '--out'"),
        ("--out c", "case", "Missing argument 'NAME'"),
        ("demo --out c --jobs 2", "case", "No such option: --jobs"),
        ("demo --out c --side right", "case", "No such option: --side"),
        ("--suite d --seed 0", "suite", "No such option: --seed"),
        ("--suite d --jobs 0", "suite", "Invalid value for '--jobs'"),
        ("--suite d --from-ct f --out c", "suite", "No such option: --from-ct"),
        ("--suite d demo", "suite", "unexpected extra argument"),
        ("--from-ct f", "twin", "Missing option '--out'"),
        ("--from-ct f --out c --sheet s", "twin", "No such option: --sheet"),
        ("--from-ct f --out c --series 20 --nodule n", "breath", "No such option: --nodule"),
        ("--from-ct f --out c --series 9", "breath", "Invalid value for '--series'"),
        ("--series 20 --out c", "breath", "Missing option '--from-ct'"),
    ],
)
def test_what_lacks_or_belongs_to_another_use_is_named(
    words: str, use: str, sentence: str, asked: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, said = run(capsys, words)
    assert code == CaseError.exit_code
    assert f"phantom {use}" in said
    assert sentence in said
    assert asked == []


def test_a_side_that_is_none_is_refused(asked: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    code, _, said = run(capsys, "--from-ct f --out c --side middle")
    assert code == CaseError.exit_code
    assert 'got "middle"' in said
    assert asked == []


@pytest.mark.parametrize("words", ["", "--help"])
def test_the_help_lists_every_use(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, words)
    assert code == (0 if words else CaseError.exit_code)
    uses = [command.name for command in phantom.registered_commands]
    assert all(f" {use} " in out for use in uses)
    assert uses == ["case", "suite", "sheet", "twin", "breath"]
    told = {subcommand_of(line) for line in (["x"], ["--suite"], ["--from-ct"], ["--series=1"])}
    assert told == set(uses) - {"sheet"}


def test_a_case_beside_the_sheet_needs_the_sheet(asked: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    code, _, said = run(capsys, "--suite d --beside b")
    assert code == CaseError.exit_code
    assert "give --sheet FILE too" in said
    assert asked == []


def test_a_scan_that_no_twin_can_be_made_of_is_refused_with_its_name(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def refuse(*_given: Any) -> None:
        raise ValueError("the lung has no place for a nodule")

    monkeypatch.setattr(case, "read_scan", lambda *_given: SimpleNamespace(nodule=None))
    monkeypatch.setattr(case, "make_twin", refuse)
    with pytest.raises(InputRefused, match=r"scan\.nii\.gz: the lung has no place for a nodule, or give the mask"):
        case.write_twin(Path("scan.nii.gz"), "left", tmp_path / "out")
    assert not (tmp_path / "out").exists()
