"""Rows of numbers as markdown."""

from __future__ import annotations

from typing import Any

Row = dict[str, Any]


def markdown(rows: list[Row]) -> str:
    """Rows as a markdown table, numbers to four digits, nothing for None."""
    lines = ["| " + " | ".join(rows[0]) + " |", "|" + "---|" * len(rows[0])]
    for row in rows:
        cells = ("" if v is None else f"{v:.4g}" if isinstance(v, float) else str(v) for v in row.values())
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)
