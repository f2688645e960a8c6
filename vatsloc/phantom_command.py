"""Command `vatsloc phantom`: one synthetic case, the whole suite, or the twin of a scan, collapsed or breathing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from vatsloc.errors import CaseError
from vatsloc.terminal import say


@dataclass(frozen=True)
class Mode:
    """One use of the command. needed, allowed: options that it has to have and may have, by parameter; make: gets all
    of them and returns what is printed.
    """

    usage: str
    needed: frozenset[str]
    allowed: frozenset[str]
    make: Callable[..., str]


def phantom(
    context: typer.Context,
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="Name of the phantom, for instance demo.")] = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="CASE", help="Case folder to write.")] = None,
    seed: Annotated[int, typer.Option(metavar="N", help="Seed of the anatomy.")] = 0,
    suite: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write every case of the suite; those there are kept.")
    ] = None,
    jobs: Annotated[int, typer.Option(metavar="N", min=1, help="Cases of the suite made at once.")] = 1,
    sheet: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Contact sheet of the suite to write, PNG or JPEG.")
    ] = None,
    beside: Annotated[
        Path | None, typer.Option(metavar="CASE", help="Case made from a real scan that the sheet shows first.")
    ] = None,
    from_ct: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Chest CT to make a twin of, collapsed like NAME if given.")
    ] = None,
    side: Annotated[
        str, typer.Option(metavar="SIDE", help="Lung of the twin that collapses: right or left.")
    ] = "right",
    nodule: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Mask of the nodule in the CT; else one is put in.")
    ] = None,
    series: Annotated[
        int | None, typer.Option(metavar="N", min=10, max=100, help="Breathe the twin instead: N states of one breath.")
    ] = None,
    cbct: Annotated[
        str, typer.Option(metavar="DOMAIN", help='Scanner: image, or projection for a C-arm (extra "projections").')
    ] = "image",
) -> None:
    """Write a synthetic case with known truth, the whole suite with a table of how hard its cases are, or the twin of a
    scan: collapsed, or breathing.

    \b
    NAME --out CASE [--seed N] [--cbct DOMAIN]
    --suite DIR [--jobs N] [--sheet FILE [--beside CASE]] [--cbct DOMAIN]
    --from-ct FILE --out CASE [NAME] [--side SIDE] [--seed N] [--nodule FILE] [--cbct DOMAIN]
    --from-ct FILE --series N --out DIR [--side SIDE] [--seed N]
    """
    values = {key: value for key, value in locals().items() if key != "context"}
    given = {key for key in values if getattr(context.get_parameter_source(key), "name", "") == "COMMANDLINE"}
    mode = mode_of(given)
    print(mode.make(**{key: values[key] for key in mode.allowed}))


def mode_of(given: set[str]) -> Mode:
    """The mode of the parameters given on the command line; raises CaseError where one lacks or belongs elsewhere."""
    mode = next((MODES[key] for key in ("suite", "series", "from_ct") if key in given), MODES["name"])
    lacking, strange = mode.needed - given, given - mode.allowed
    if lacking or strange:
        wrong = [f"{', '.join(map(_spelt, sorted(lacking)))} is missing"] if lacking else []
        wrong += [f"{', '.join(map(_spelt, sorted(strange)))} does not belong there"] if strange else []
        uses = "; ".join(f"phantom {mode.usage}" for mode in MODES.values())
        raise CaseError(f"phantom {mode.usage}: {' and '.join(wrong)}. Give one of: {uses}.")
    return mode


def make_case(name: str, out: Path, seed: int, cbct: str) -> str:
    """One phantom; the folder that it was written to."""
    from vatsloc.synthetic import write_phantom

    write_phantom(name, out, seed, say, cbct)
    return str(out)


def make_suite(suite: Path, jobs: int, sheet: Path | None, beside: Path | None, cbct: str) -> str:
    """Every case of the suite and its contact sheet, where one is asked for; the table of how hard the cases are."""
    from vatsloc.study.cohort.contact_sheet import write_sheet
    from vatsloc.study.cohort.suite import table, write_suite

    if beside is not None and sheet is None:
        raise CaseError("--beside is shown on the contact sheet; give --sheet FILE too.")
    made = write_suite(suite, jobs, say, cbct)
    if sheet is not None:
        write_sheet([suite / case for case in made], sheet, beside=beside)
    return table(made)


def make_twin(from_ct: Path, side: str, out: Path, name: str | None, seed: int, nodule: Path | None, cbct: str) -> str:
    """The collapsed twin of a scan; the folder that it was written to."""
    from vatsloc.synthetic.case import side_named, write_twin

    write_twin(from_ct, side_named(side), out, name, seed, nodule, say, cbct)
    return str(out)


def make_breath(from_ct: Path, side: str, out: Path, series: int, seed: int) -> str:
    """A breath of the twin of a scan; the folder that it was written to."""
    from vatsloc.synthetic.case import side_named
    from vatsloc.synthetic.series import write_series

    write_series(from_ct, side_named(side), out, series, seed, say)
    return str(out)


def _mode(usage: str, needed: str, optional: str, make: Callable[..., Any]) -> Mode:
    return Mode(usage, frozenset(needed.split()), frozenset((needed + " " + optional).split()), make)


def _spelt(parameter: str) -> str:
    return "NAME" if parameter == "name" else f"--{parameter.replace('_', '-')}"


MODES = {
    "name": _mode("NAME --out CASE", "name out", "seed cbct", make_case),
    "suite": _mode("--suite DIR", "suite", "jobs sheet beside cbct", make_suite),
    "from_ct": _mode("--from-ct FILE --out CASE", "from_ct out", "side name seed nodule cbct", make_twin),
    "series": _mode("--from-ct FILE --series N --out DIR", "from_ct series out", "side seed", make_breath),
}
"""Modes by the parameter that tells them."""
