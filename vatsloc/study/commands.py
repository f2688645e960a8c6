"""Commands that study the method: `bench`, `stability`, `cohort`, `chart`, `paper` and `calibrate-forecast`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from vatsloc.terminal import JsonOption, PresetOption, SettingsOption, say, show

bench = typer.Typer(no_args_is_help=True, help="Measure a part of the product, beside other programs where installed.")
stability = typer.Typer(no_args_is_help=True, help="Show where a part of the product stops being right.")


def _report(
    result: dict[str, Any], table: Callable[..., str], page: Callable[..., str], out: Path | None, as_json: bool
) -> None:
    """Table on stderr, page to a file and JSON on stdout, where they are asked for."""
    say(table(result))
    if out is not None:
        out.write_text(page(result), encoding="utf-8")
    if as_json:
        show(result)


@bench.command("poro")
def bench_poro_command(
    cost: Annotated[bool, typer.Option("--cost", help="Also seconds and memory of every stage against mesh size.")] = (
        False
    ),
    max_tets: Annotated[int, typer.Option(metavar="N", help="Largest mesh of the cost table.")] = 500_000,
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Markdown page to write.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Poroelastic lung: displacements and speed beside GetFEM's, and cost against mesh size."""
    from vatsloc.study.bench.cost_poro import SIZES
    from vatsloc.study.bench.poro import bench_poro, page, table

    result = bench_poro(tuple(size for size in SIZES if cost and size <= max_tets), say=say)
    _report(result, table, page, out, as_json)


@bench.command("cold")
def bench_cold_command(
    cases: Annotated[list[Path], typer.Argument(metavar="CASES...", help="Case folders.")],
    preset: PresetOption = "balanced",
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="List of kernels to write.")] = None,
    as_json: JsonOption = False,
) -> None:
    """The first run on a machine: what it compiles, and its seconds with and without a process that compiles beside."""
    from vatsloc.study.bench.cold import as_json as list_of
    from vatsloc.study.bench.cold import bench_cold, table

    kernels, result = bench_cold(cases, preset, say)
    if out is not None:
        out.write_text(list_of(kernels), encoding="utf-8")
    _report(result, table, table, None, as_json)


@bench.command("registration")
def bench_registration_command(
    cases: Annotated[
        list[Path] | None,
        typer.Argument(metavar="CASES", help="Case folders, or NAME:SEED of a phantom; default: three phantoms."),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Markdown page to write.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Phase 1: errors at the landmarks, seconds, memory and folding beside itk-elastix, and cost against image size."""
    from vatsloc.study.bench.registration import bench_registration, page, table

    result = bench_registration(cases or [], say=say)
    _report(result, table, page, out, as_json)


@bench.command("fit")
def bench_fit_command(
    cases: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="CASES", help="Case folders, folders of them, or NAME:SEED of a phantom; default: three phantoms."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder that keeps the results; a rerun goes on.")
    ] = None,
    jobs: Annotated[int, typer.Option(metavar="N", min=1, help="Cases run at once.")] = 1,
    as_json: JsonOption = False,
) -> None:
    """The whole chain: errors, seconds, how often the ellipsoid holds the nodule, and the share of silent failures."""
    from vatsloc.study.bench.fit import bench_fit, table

    result = bench_fit(cases or [], out, jobs, say=say)
    say(table(result))
    if as_json:
        show(result)


@bench.command("forecast")
def bench_forecast_command(
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="JSON file of the rows; a rerun goes on.")],
    names: Annotated[list[str] | None, typer.Argument(metavar="NAMES", help="Of the suite's phantoms; all.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Forecasts from the CT alone beside where the suite's phantoms move their nodules; no image is made."""
    from vatsloc.study.forecast import bench_forecast, table

    result = bench_forecast(out, names or [], say)
    say(table(result))
    if as_json:
        show(result)


@bench.command("check")
def bench_check_command(
    cases: Annotated[list[Path], typer.Argument(metavar="CASES...", help="Case folders with dense truth.")],
    preset: PresetOption = "balanced",
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Markdown table to write.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Whole run: what its check finds left over, beside the true error at the same places."""
    from vatsloc.study.bench.check import bench_check, table
    from vatsloc.workflow.settings import load_settings

    result = bench_check(cases, load_settings(preset, None), say)
    _report(result, table, table, out, as_json)


@bench.command("cbct")
def bench_cbct_command(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the phantom.")] = "demo",
    seed: Annotated[int, typer.Option(metavar="N", help="Seed of the anatomy.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """The phantoms' cone-beam scanner in the image domain beside a C-arm's projections."""
    from vatsloc.study.bench.cbct import bench_cbct, table

    result = bench_cbct(name, seed, say)
    say(table(result))
    if as_json:
        show(result)


@bench.command("real")
def bench_real_command(
    people: Annotated[
        list[Path],
        typer.Argument(metavar="DIR...", help="Folders with lung masks at two breath-holds and landmark pairs."),
    ],
    picture: Annotated[Path | None, typer.Option(help="PNG of the errors as arrows; needs the extra `report`.")] = None,
    spoil: Annotated[bool, typer.Option("--spoil", help="Also with the masks spoilt the ways that people do.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Real lungs: move one breath-hold into the other by shape alone; errors at landmarks that were only scored."""
    from vatsloc.study.bench.real import bench_real, table
    from vatsloc.study.bench.real_draw import draw_real
    from vatsloc.study.chart.draw import require_matplotlib

    if picture is not None:
        require_matplotlib()
    result = bench_real(people, say, spoil)
    say(table(result))
    if picture is not None:
        draw_real(people, picture)
    if as_json:
        show(result)


@bench.command("breathe")
def bench_breathe_command(
    cases: Annotated[list[Path], typer.Argument(metavar="CASE...", help="Breathing cases with landmarks, or series.")],
    drivers: Annotated[str | None, typer.Option(metavar="A,B,..", help="Drivers; all by default.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Breathing lung: each driver's error at landmarks beside its paper's, the share of motion left, and seconds."""
    from vatsloc.breathing.run import DRIVERS
    from vatsloc.study.bench.breathe import bench_breathe, table

    chosen = [name.strip() for name in drivers.split(",")] if drivers else list(DRIVERS)
    result = bench_breathe(cases, chosen, say=say)
    say(table(result))
    if as_json:
        show(result)


@stability.command("poro")
def stability_poro_command(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for CSV files, plots and tables.md.")],
) -> None:
    """Poroelastic lung: pressure bounds, inverted elements, nu towards 0.5, contact methods, small hila."""
    from vatsloc.study.stability.poro import stability_poro

    stability_poro(out, say)
    print(out / "tables.md")


@stability.command("registration")
def stability_registration_command(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for CSV files, the plot and tables.md.")],
) -> None:
    """Registration: noise, view, start, motion, collapsed lung, and the spine's pose; goes on where it was stopped."""
    from vatsloc.study.stability.registration import stability_registration

    stability_registration(out, say)
    print(out / "tables.md")


@stability.command("fit")
def stability_fit_command(
    cases: Annotated[list[Path], typer.Argument(metavar="CASES...", help="Case folders with landmarks.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for CSV files and tables.md.")],
) -> None:
    """Collapse: disturbed surface, gravity, hilum and spine; random starts; what the surface tells of theta."""
    from vatsloc.study.stability.fit import stability_fit
    from vatsloc.workflow.settings import Settings

    stability_fit(cases, out, Settings(), say)
    print(out / "tables.md")


@stability.command("faults")
def stability_faults_command(
    cases: Annotated[list[Path], typer.Argument(metavar="CASES...", help="Case folders with landmarks.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for tables.md.")],
    preset: Annotated[str, typer.Option(help="Preset of the runs.")] = "balanced",
) -> None:
    """Whole run: shifts, turns, a slipped vertebra, swapped and strange scans put in; whether the run notices."""
    from vatsloc.study.stability.faults import stability_faults
    from vatsloc.workflow.settings import load_settings

    stability_faults(cases, out, load_settings(preset, None), say)
    print(out / "tables.md")


@stability.command("choices")
def stability_choices_command(
    cases: Annotated[list[Path], typer.Argument(metavar="CASES...", help="Case folders.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for choices.md.")],
) -> None:
    """Preset auto: how far the nodule moves when a choice is made the other way."""
    from vatsloc.study.stability.choices import study_choices, table

    print(table(study_choices(cases, out, say=say)))


def calibrate_forecast(
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="JSON file of the persons; a rerun goes on.")],
    persons: Annotated[int, typer.Option(metavar="N", min=5, max=100, help="Phantoms of each anatomy.")] = 24,
    right: Annotated[
        list[Path] | None, typer.Option(metavar="CT", help="Scanned chest whose right lung is collapsed as well.")
    ] = None,
    left: Annotated[list[Path] | None, typer.Option(metavar="CT", help="The same of a left lung.")] = None,
) -> None:
    """Move phantoms by their physics, and write what `foresee` forecasts from."""
    from vatsloc.study.forecast import calibrate

    calibrate(out, persons, {"right": right or [], "left": left or []}, say)
    print(out)


def cohort(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for results and tables; a rerun goes on.")],
    folders: Annotated[
        list[Path] | None, typer.Argument(metavar="DIR...", help="Case folders, or folders that hold case folders.")
    ] = None,
    suite: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Run the suite of phantoms, made in DIR where they lack.")
    ] = None,
    preset: PresetOption = "balanced",
    settings: SettingsOption = None,
    jobs: Annotated[int, typer.Option(metavar="N", min=1, help="Cases run at once.")] = 1,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Dask scheduler whose workers see the same files.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Localize and score many cases; one table of errors, gates, seconds and memory as CSV, Markdown and HTML."""
    from vatsloc.study.cohort.cohort import as_json as cohort_json
    from vatsloc.study.cohort.cohort import find_cases, run_cohort, table
    from vatsloc.study.cohort.suite import write_suite
    from vatsloc.workflow.settings import load_settings

    load_settings(preset, settings)
    made = [] if suite is None else [suite / name for name in write_suite(suite, jobs, say)]
    outcomes = run_cohort(find_cases([*(folders or []), *made]), out, preset, settings, jobs, scheduler, say=say)
    if as_json:
        show(cohort_json(outcomes))
    else:
        print(table(outcomes))


def chart(
    cases: Annotated[list[Path], typer.Argument(metavar="CASES...", help="Case folders with landmarks.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for runs.csv and the chart.")],
    variants: Annotated[str | None, typer.Option(metavar="A,B,..", help="Variants to run; all by default.")] = None,
    clock: Annotated[
        Literal["seconds", "cpu"], typer.Option(help="What is drawn: the clock's seconds or the processors'.")
    ] = "seconds",
) -> None:
    """Errors against seconds of the method's variants over CASES; goes on where it was stopped (extra "report")."""
    from vatsloc.study.chart.chart import run_chart
    from vatsloc.study.chart.draw import require_matplotlib, write_chart
    from vatsloc.study.chart.variants import VARIANTS, chosen_variants

    require_matplotlib()
    chosen = chosen_variants([name.strip() for name in variants.split(",")] if variants else None)
    write_chart(run_chart(cases, chosen, out, say), VARIANTS, out, clock)
    print(out / "chart.html")


def paper(
    folders: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Case folders with landmarks, or folders that hold them.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for errors and tables; a rerun goes on.")],
    jobs: Annotated[int, typer.Option(metavar="N", min=1, help="Cases run at once.")] = 1,
) -> None:
    """The experiments of Alvarez 2021 on cases with truth: variants A to C, diaphragm, parameters (extra "report")."""
    from vatsloc.study.chart.draw import require_matplotlib
    from vatsloc.study.cohort.cohort import find_cases
    from vatsloc.study.paper.draw import write_paper
    from vatsloc.study.paper.paper import run_paper

    require_matplotlib()
    write_paper(run_paper(find_cases(folders), out, jobs, say), out)
    print(out / "paper.md")
