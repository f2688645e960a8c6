"""breath.html: one file with every state's pictures, to be scrubbed through without a network."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2

from poro.arrays import Array
from vatsloc.breathing.film import as_uri

TITLES = {
    "surface": "motion driven by the lung's border (Li 2008)",
    "pressure-volume": "motion driven by the pressure-volume curve (Eom 2010)",
    "regional-pressure": "motion driven by pressures of regions (Fuerst)",
    "one-scan": "states of one scan (Li & Porikli 2014)",
}


@dataclass(frozen=True)
class Strip:
    """Pictures of one view, one per state."""

    caption: str
    pictures: Sequence[Array]


@dataclass(frozen=True)
class Table:
    """A table as text."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


def page(name: str, result: Mapping[str, Any], strips: Sequence[Strip], tables: Sequence[Table]) -> str:
    """The page as HTML."""
    environment = jinja2.Environment(autoescape=True, trim_blocks=True)
    template = environment.from_string((Path(__file__).parent / "breath.html").read_text(encoding="utf-8"))
    uris = [{"caption": strip.caption, "pictures": [as_uri(p) for p in strip.pictures]} for strip in strips]
    seen = " but the fit E2" if result.get("saw_landmarks") else ""
    return template.render(
        name=name,
        title=TITLES[result["driver"]],
        result=result,
        strips=uris,
        tables=[_states(result), *tables],
        scripts=json.dumps([uri["pictures"] for uri in uris]),
        seen=seen,
    )


def _states(result: Mapping[str, Any]) -> Table:
    rows = [
        [str(n), f"{state['volume_ml']:.0f}", f"{state['pressure_pa']:.0f}"] for n, state in enumerate(result["states"])
    ]
    return Table("States", ["state", "volume, ml", "pressure, Pa"], rows)
