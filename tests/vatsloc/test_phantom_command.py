"""Each use of `vatsloc phantom` gets its own options, and none that belong to another use."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from vatsloc import phantom_command
from vatsloc.cli import main
from vatsloc.errors import CaseError
from vatsloc.phantom_command import MODES, make_suite, mode_of

CASE = {"name": "demo", "out": Path("c"), "seed": 0, "cbct": "image"}
SUITE = {"suite": Path("d"), "jobs": 1, "sheet": None, "beside": None, "cbct": "image"}
TWIN = {"from_ct": Path("f"), "side": "right", "out": Path("c"), "name": None, "seed": 0, "nodule": None} | {
    "cbct": "image"
}
BREATH = {"from_ct": Path("f"), "side": "right", "out": Path("d"), "series": 20, "seed": 0}


@pytest.mark.parametrize(
    ("words", "made"),
    [
        ("demo --out c", CASE),
        ("demo --out c --seed 3 --cbct projection", CASE | {"seed": 3, "cbct": "projection"}),
        ("--suite d", SUITE),
        (
            "--suite d --jobs 2 --sheet s.png --beside b",
            SUITE | {"jobs": 2, "sheet": Path("s.png"), "beside": Path("b")},
        ),
        ("--from-ct f --side right --out c", TWIN),
        (
            "base --from-ct f --side left --out c --nodule n --seed 0",
            TWIN | {"side": "left", "name": "base"} | {"nodule": Path("n")},
        ),
        ("--from-ct f --series 20 --out d", BREATH),
        ("--from-ct f --series 10 --out d --side left --seed 2", BREATH | {"series": 10, "side": "left", "seed": 2}),
    ],
)
def test_each_use_gets_what_was_said_and_its_defaults(
    words: str, made: dict[str, Any], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[dict[str, Any]] = []

    def make(**values: Any) -> str:
        asked.append(values)
        return "made"

    for key, mode in MODES.items():
        monkeypatch.setitem(phantom_command.MODES, key, replace(mode, make=make))
    with pytest.raises(SystemExit) as end:
        main(["phantom", *words.split()])
    assert end.value.code == 0
    assert asked == [made]
    assert capsys.readouterr().out == "made\n"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("", "phantom NAME --out CASE: NAME, --out is missing"),
        ("demo", "--out is missing"),
        ("demo --out c --jobs 2", "--jobs does not belong there"),
        ("demo --out c --side right", "--side does not belong there"),
        ("--suite d --seed 0", "phantom --suite DIR: --seed does not belong there"),
        ("--suite d --from-ct f --out c", "--from-ct, --out does not belong there"),
        ("--suite d demo", "NAME does not belong there"),
        ("--from-ct f", "--out is missing"),
        ("--from-ct f --out c --sheet s", "--sheet does not belong there"),
        ("--from-ct f --out c --series 20 --nodule n", "--nodule does not belong there"),
        ("--series 20 --out c", "--from-ct is missing"),
    ],
)
def test_what_lacks_or_belongs_to_another_use_is_named(
    words: str, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(["phantom", *words.split()])
    assert end.value.code == CaseError.exit_code
    assert sentence in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_mode_s_sentence_lists_every_use() -> None:
    with pytest.raises(CaseError) as refusal:
        mode_of({"jobs"})
    assert all(f"phantom {mode.usage}" in str(refusal.value) for mode in MODES.values())


def test_a_case_beside_the_sheet_needs_the_sheet(tmp_path: Path) -> None:
    with pytest.raises(CaseError, match="give --sheet FILE too"):
        make_suite(tmp_path / "suite", 1, None, tmp_path, "image")
    assert list(tmp_path.iterdir()) == []
