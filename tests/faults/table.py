"""What came of the mutants, as Markdown for docs/."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

Name = tuple[Any, ...]
Record = dict[str, Any]  # a mutant's fields, the tests it was put to, and the verdict; "demo": what the demo run said


def name_of(record: Mapping[str, Any]) -> Name:
    """What tells a mutant from all others, in this run and the next."""
    return tuple(record[part] for part in ("file", "line", "column", "operator", "before", "after"))


def table(records: Sequence[Record], judged: Iterable[Mapping[str, str]], seed: int) -> str:
    """Markdown for docs/: the share that is killed, by operator, and every survivor with what was judged of it."""
    valid = [record for record in records if record["verdict"] != "does not compile"]
    alive = sorted((record for record in valid if record["verdict"] == "survived"), key=name_of)
    why = {(entry["file"], entry["source"], entry["operator"]): entry["why"] for entry in judged}
    reasons = [why.get((record["file"], record["source"], record["operator"]), "") for record in alive]
    demos = [record["demo"] for record in alive if "demo" in record]
    told = [
        f"{len(records)} mutants from seed {seed}, {len(records) - len(valid)} of which do not compile. "
        f"Killed: {len(valid) - len(alive)} of {len(valid)} ({1 - len(alive) / max(len(valid), 1):.1%}), "
        f"{sum(record['verdict'] == 'timeout' for record in valid)} of them by a timeout. "
        f"Survivors: {len(alive)}, {sum(map(bool, reasons))} of them judged.",
        f"The demo run kills {len(demos) - demos.count('survived')} of {len(demos)} survivors put to it.",
        *("", "| operator | killed | mutants |", "|---|---|---|"),
    ]
    for operator in sorted({record["operator"] for record in valid}):
        verdicts = [record["verdict"] for record in valid if record["operator"] == operator]
        told.append(f"| {operator} | {len(verdicts) - verdicts.count('survived')} | {len(verdicts)} |")
    told += ["", "| survivor | operator | line | change | demo run | judged |", "|---|---|---|---|---|---|"]
    for record, reason in zip(alive, reasons, strict=True):
        source, before, after = (_code(record[part]) for part in ("source", "before", "after"))
        change = f"{before} to {after}" if record["after"].strip() else f"{before} left out"
        cells = [_code(f"{record['file']}:{record['line']}"), record["operator"], source, change]
        told.append(f"| {' | '.join([*cells, record.get('demo', 'not run'), reason or '**no**'])} |")
    return "\n".join(told) + "\n"


def _code(text: str) -> str:
    """Text as code in a cell of a Markdown table."""
    return "`" + " ".join(text.split()).replace("|", "\\|") + "`"
