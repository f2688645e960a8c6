"""What commands share: talk on stderr, data on stdout."""

from __future__ import annotations

import json
import sys
from typing import Annotated, Any

import typer

JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]


def say(message: str) -> None:
    """Progress and talk, on stderr."""
    print(message, file=sys.stderr, flush=True)


def show(data: dict[str, Any]) -> None:
    """Data, on stdout."""
    print(json.dumps(data, indent=2))
