"""Parts of a run that a scene may not need: each is left out by one measured value against one limit."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Choice:
    """part: of the method; kept: whether it ran; why: one sentence; value, limit: it is left out up to the limit."""

    part: str
    kept: bool
    why: str
    value: float
    limit: float

    def entry(self) -> dict[str, Any]:
        """The keys of run.json."""
        return asdict(self)


def weigh(part: str, value: float, limit: float, seen: str, unit: str = "mm") -> Choice:
    """Leave `part` out where value <= limit; what was not measured (NaN) keeps it. seen: the value in words."""
    rule = "kept in every case" if limit < 0 else f"left out up to {limit:g} {unit}"
    return Choice(part, not value <= limit, f"{seen}; {rule}", float(value), float(limit))
