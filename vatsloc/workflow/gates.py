"""Quality gates: measured values with limits, which mark a result that should not be trusted."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Gate:
    """One check. value is held against limit; `ok` says on which side it fell, `says` what a failure means."""

    value: float
    limit: float
    ok: bool
    says: str

    def as_json(self) -> dict[str, float | bool | str]:
        """The keys of run.json."""
        return {"ok": self.ok, "value": round(self.value, 6), "limit": self.limit, "says": self.says}


def at_most(value: float, limit: float, says: str) -> Gate:
    """Gate that passes while value <= limit."""
    return Gate(float(value), float(limit), bool(value <= limit), says)


def at_least(value: float, limit: float, says: str) -> Gate:
    """Gate that passes while value >= limit."""
    return Gate(float(value), float(limit), bool(value >= limit), says)
