"""All words of the report stand in one table: none in the templates, scripts or modules, and none unused."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import vatsloc.report
from vatsloc.report.words import WORDS

ROOM = Path(vatsloc.report.__file__).parent
UNITS = {"mm", "MB", "Pa", "vatsloc"}


@pytest.mark.parametrize("name", ["page.html", "parts.html", "report.html", "scores.html", "forecast.html"])
def test_templates_hold_no_words_of_their_own(name: str) -> None:
    text = (ROOM / name).read_text(encoding="utf-8")
    text = re.sub(r"<script.*?</script>|<style.*?</style>", "", text, flags=re.DOTALL)
    bare = re.sub(r"{{.*?}}|{%.*?%}", " ", text, flags=re.DOTALL)
    told = re.findall(r'(?:alt|aria-label|title|placeholder)="([^"]*)"', bare)
    told += re.sub(r"<[^>]*>|&\w+;", " ", bare).split()
    assert [word for word in told if re.search(r"[A-Za-z]{2,}", word) and word not in UNITS] == []


@pytest.mark.parametrize("name", ["report.js", "lung3d.js"])
def test_scripts_write_no_words_of_their_own(name: str) -> None:
    text = re.sub(r"//.*", "", (ROOM / name).read_text(encoding="utf-8"))
    shown = re.findall(r'(?:write\(|textContent = |fillText\()"([^"]*)"', text)
    assert shown == []


def test_every_word_is_used() -> None:
    workflow = ROOM.parent / "workflow"
    sources = [*ROOM.glob("*.py"), *ROOM.glob("*.html"), workflow / "run.py", workflow / "foresee.py"]
    text = "\n".join(file.read_text(encoding="utf-8") for file in sources if file.name != "words.py")
    composed = {*(f"glance_trust_{level}" for level in ("ok", "warn", "fail")), "axial", "coronal", "sagittal"}
    composed |= {
        "mark_nodule",
        "mark_inflated",
        *(f"{edge}_short" for edge in ("apex", "lowest", "anterior", "posterior")),
    }
    composed |= {"head", "right", "left", "front", "back", "feet"}
    unused = [name for name in WORDS if name not in composed and not re.search(rf"w\.{name}\b|\"{name}\"", text)]
    assert unused == []


def test_another_table_makes_another_language(monkeypatch: pytest.MonkeyPatch) -> None:
    from tests.vatsloc.test_report import words_alone

    monkeypatch.setattr("vatsloc.report.render.WORDS", {**WORDS, "language": "de", "how_far": "Wie weit zu trauen ist"})
    page = words_alone()
    assert '<html lang="de">' in page
    assert "Wie weit zu trauen ist" in page
    assert "How far to trust it" not in page
