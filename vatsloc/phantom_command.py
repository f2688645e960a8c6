"""Command `vatsloc phantom`: one synthetic case, the whole suite, or the twin of a scan, collapsed or breathing; and a
picture of cases side by side.

Each use is a subcommand with its own options. Which one is meant shows in the options, so its name need not be given.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer.core import TyperGroup

from vatsloc.errors import CaseError
from vatsloc.terminal import say

TOLD_BY = {"--suite": "suite", "--series": "breath", "--from-ct": "twin"}
"""Subcommand that an option tells, the first one of these that is given; without them it is one phantom."""


class ByOption(TyperGroup):
    """Takes the subcommand from the options, where its name is not given."""

    def parse_args(self, ctx: typer.Context, args: list[str]) -> list[str]:  # type: ignore[override]
        """The arguments, begun by the name of a subcommand."""
        asks_help = args and args[0] in self.get_help_option_names(ctx)
        return super().parse_args(ctx, args if asks_help else self.named(args))

    def named(self, args: list[str]) -> list[str]:
        """Arguments with the name of the subcommand that they ask for."""
        return args if not args or args[0] in self.commands else [subcommand_of(args), *args]


def subcommand_of(args: list[str]) -> str:
    """Name of the subcommand that arguments without one ask for."""
    given = {word.partition("=")[0] for word in args}
    return next((name for option, name in TOLD_BY.items() if option in given), "case")


phantom = typer.Typer(
    cls=ByOption,
    no_args_is_help=True,
    help="Write a synthetic case with known truth, the whole suite, or the twin of a scan, collapsed or breathing; "
    "or draw cases side by side.",
    epilog="The subcommand's name may be left out: phantom NAME --out CASE; phantom --suite DIR; "
    "phantom --from-ct FILE --out CASE; phantom --from-ct FILE --series N --out DIR. Not that of sheet.",
)

SeedOption = Annotated[int, typer.Option("--seed", metavar="N", help="Seed of the anatomy.")]
CbctOption = Annotated[
    str | None, typer.Option(metavar="DOMAIN", help="Scanner: image, or projection for a C-arm; else the recipe's.")
]
CaseOption = Annotated[Path, typer.Option("--out", metavar="CASE", help="Case folder to write.")]
CtOption = Annotated[Path, typer.Option("--from-ct", metavar="FILE", help="Chest CT to make a twin of.")]
SideOption = Annotated[str, typer.Option(metavar="SIDE", help="Lung of the twin that is moved: right or left.")]


@phantom.command("case")
def make_case(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the phantom, for instance demo.")],
    out: CaseOption,
    seed: SeedOption = 0,
    cbct: CbctOption = None,
) -> None:
    """Write one phantom, collapsed, with its truth."""
    from vatsloc.synthetic import write_phantom

    write_phantom(name, out, seed, say, cbct)
    print(out)


@phantom.command("suite")
def make_suite(
    suite: Annotated[Path, typer.Option(metavar="DIR", help="Write every case of the suite; those there are kept.")],
    jobs: Annotated[int, typer.Option(metavar="N", min=1, help="Cases of the suite made at once.")] = 1,
    sheet: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Contact sheet of the suite to write, PNG or JPEG.")
    ] = None,
    beside: Annotated[
        Path | None, typer.Option(metavar="CASE", help="Case made from a real scan that the sheet shows first.")
    ] = None,
    cbct: CbctOption = None,
) -> None:
    """Write every case of the suite and a table of how hard they are."""
    from vatsloc.study.cohort.contact_sheet import write_sheet
    from vatsloc.study.cohort.suite import table, write_suite

    if beside is not None and sheet is None:
        raise CaseError("--beside is shown on the contact sheet; give --sheet FILE too.")
    made = write_suite(suite, jobs, say, cbct)
    if sheet is not None:
        write_sheet([suite / case for case in made], sheet, beside=beside)
    print(table(made))


@phantom.command("sheet")
def make_sheet(
    cases: Annotated[list[Path], typer.Argument(metavar="CASES...", help="Case folders with true nodules.")],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="Picture to write, PNG or JPEG.")],
    columns: Annotated[int, typer.Option(metavar="N", min=1, help="Cases beside each other.")] = 2,
) -> None:
    """Draw cases side by side in one window of HU: phantoms, or twins of scans beside them."""
    from vatsloc.study.cohort.contact_sheet import write_sheet

    write_sheet(cases, out, columns)
    print(out)


@phantom.command("twin")
def make_twin(
    from_ct: CtOption,
    out: CaseOption,
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="Phantom that it is collapsed like.")] = None,
    side: SideOption = "right",
    seed: SeedOption = 0,
    nodule: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Mask of the nodule in the CT; else one is put in.")
    ] = None,
    cbct: CbctOption = None,
) -> None:
    """Write the twin of a scan, collapsed."""
    from vatsloc.synthetic.case import side_named, write_twin

    write_twin(from_ct, side_named(side), out, name, seed, nodule, say, cbct)
    print(out)


@phantom.command("breath")
def make_breath(
    from_ct: CtOption,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write.")],
    series: Annotated[int, typer.Option(metavar="N", min=10, max=100, help="States of one breath.")],
    side: SideOption = "right",
    seed: SeedOption = 0,
) -> None:
    """Write the twin of a scan in N states of one breath."""
    from vatsloc.synthetic.case import side_named
    from vatsloc.synthetic.series import write_series

    write_series(from_ct, side_named(side), out, series, seed, say)
    print(out)
