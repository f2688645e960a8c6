"""What commands share: talk on stderr, data on stdout."""

from __future__ import annotations

import inspect
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

Options = TypeVar("Options")

JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]
PresetOption = Annotated[str, typer.Option(metavar="NAME", help="fast, balanced, accurate or auto.")]
SettingsOption = Annotated[Path | None, typer.Option(metavar="FILE", help="TOML file that overrides the preset.")]
LinkOption = Annotated[
    int | None,
    typer.Option(metavar="PORT", min=1, max=65535, help='Serve the answer by OpenIGTLink (extra "navigation").'),
]


def say(message: str) -> None:
    """Progress and talk, on stderr."""
    print(message, file=sys.stderr, flush=True)


def show(data: dict[str, Any]) -> None:
    """Data, on stdout."""
    print(json.dumps(data, indent=2))


def show_line(data: dict[str, Any]) -> None:
    """Data as one line on stdout, at once."""
    print(json.dumps(data), flush=True)


SHARES = {
    "read": 1.0,
    "CT lungs": 4.0,
    "spines": 2.0,
    "CBCT preparation": 1.0,
    "spine CT to inflated": 1.5,
    "inflated lung": 1.0,
    "mesh": 1.0,
    "free-form deformation": 4.0,
    "inversion and extrapolation": 2.0,
    "spine inflated to deflated": 1.0,
    "deflated surface": 3.0,
    "hilum": 1.0,
    "fit": 2.0,
    "keypoints": 2.0,
    "regional fit": 2.0,
    "elastic correction": 3.0,
    "residual registration": 3.0,
    "check": 4.0,
    "warp": 4.0,
    "write": 4.0,
    "report": 2.0,
}
"""About how many seconds each stage of `localize` takes (twin-a, balanced): what the bar's time left rests on."""


@contextmanager
def progress() -> Iterator[Callable[[str], None]]:
    """A callback for progress: a bar with the time left where stderr is a terminal, plain lines elsewhere.

    A message "NAME ..." begins a stage, "NAME: 1.2 s" ends it; others are printed as they are.
    """
    if not sys.stderr.isatty():
        yield say
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task, left = bar.add_task("reading", total=sum(SHARES.values())), dict(SHARES)

        def tell(message: str) -> None:
            stage = message.partition(":")[0]
            if message.endswith(" ..."):
                bar.update(task, description=message.removesuffix(" ..."))
            elif stage in SHARES:
                bar.advance(task, left.pop(stage, 0.0))
            else:
                bar.console.print(message, markup=False, highlight=False)

        yield tell


@contextmanager
def link(port: int | None) -> Iterator[Callable[[Path, str], None]]:
    """What publishes a result to navigation screens while the block runs; nothing where no port is given."""
    if port is None:
        yield lambda result, patient: None
        return
    from vatsloc.navigation import messages_of, serving
    from vatsloc.navigation.messages import require_pyigtl

    require_pyigtl()
    with serving(port) as screens:
        yield lambda result, patient: screens.publish(messages_of(result, patient))


def taking(options: type[Options]) -> Callable[[Callable[[Options], None]], Callable[..., None]]:
    """Make a function of a settings object a command: the object's fields, annotated for typer, are its options."""

    def command_of(act: Callable[[Options], None]) -> Callable[..., None]:
        def command(**given: Any) -> None:
            act(options(**given))

        command.__name__, command.__doc__ = act.__name__, act.__doc__
        command.__signature__ = inspect.signature(options, eval_str=True)  # type: ignore[attr-defined]
        return command

    return command_of
