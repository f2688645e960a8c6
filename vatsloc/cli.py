"""Command line: data on stdout, talk on stderr, exit codes of the case format."""

from __future__ import annotations

import os
import sys
import traceback
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import Annotated

import typer

# Before numpy is first imported, whatever was set: a lung's fronts are too small to share, waiting threads burn the
# other core, and sums that threads share round otherwise.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

from vatsloc.errors import GateFailed, as_ours
from vatsloc.listen_command import listen
from vatsloc.phantom_command import phantom
from vatsloc.precompile import compile_beside
from vatsloc.study.commands import bench, calibrate_forecast, chart, cohort, paper, stability
from vatsloc.terminal import JsonOption, LinkOption, PresetOption, SettingsOption, link, progress, say, show, show_line

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

app.add_typer(bench, name="bench")
app.add_typer(stability, name="stability")
app.add_typer(phantom, name="phantom")
app.command()(listen)

DEBUG = "--debug"

CaseArgument = Annotated[Path, typer.Argument(metavar="CASE", help="Case folder with case.toml.")]


@app.callback()
def _whole_program(
    debug: Annotated[bool, typer.Option(DEBUG, help="Show the traceback of what ends a command early.")] = False,
) -> None:
    """Where is the nodule in the collapsed lung? CT + inflated CBCT + deflated CBCT in, position and report out."""


@app.command()
def localize(
    case: CaseArgument,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Results folder, written whole or not at all.")],
    preset: PresetOption = "balanced",
    settings: SettingsOption = None,
    state: Annotated[Path | None, typer.Option(metavar="STATE", help="What `vatsloc prepare` made of CASE.")] = None,
    openigtlink: LinkOption = None,
    as_json: JsonOption = False,
    json_lines: Annotated[
        bool, typer.Option("--json-lines", help="Print the answer as one line of JSON when it is known, then the end.")
    ] = False,
) -> None:
    """Find the nodule of CASE in the deflated cone-beam CT."""
    from vatsloc.workflow.run import run_case
    from vatsloc.workflow.settings import load_settings

    compile_beside()
    answered = (lambda answer: show_line({"event": "answer", **answer})) if json_lines else None
    with link(openigtlink) as publish:
        with progress() as tell:
            run = run_case(case, out, load_settings(preset, settings), tell, state, answered)
        if json_lines:
            show_line({"event": "written", "folder": str(out), "seconds": run["seconds"]["total"]})
        elif as_json:
            show(run)
        else:
            x, y, z = run["nodule_lps"]
            print(f"nodule at LPS {x:.1f} {y:.1f} {z:.1f} mm in the deflated CBCT; report: {out / 'report.html'}")
        if openigtlink is not None:
            publish(out, "")
            _until_interrupted(f"OpenIGTLink serves the answer on port {openigtlink}; Ctrl-C ends it")
    failed = [gate["says"] for gate in run["gates"].values() if not gate["ok"]]
    if failed:
        raise GateFailed(f"The result is written to {out}, but do not trust it: {' '.join(failed)}")


@app.command()
def prepare(
    case: CaseArgument,
    out: Annotated[Path, typer.Option("--out", metavar="STATE", help="Folder for `localize --state` to go on from.")],
    preset: PresetOption = "balanced",
    settings: SettingsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Do all that needs no deflated scan: after the CT alone, and again once the inflated scan is there."""
    from vatsloc.workflow.settings import load_settings
    from vatsloc.workflow.state import prepare_case

    compile_beside()
    told = prepare_case(case, out, load_settings(preset, settings), say)
    if as_json:
        show(told)
    else:
        print(f"{out} holds what {' and '.join(told['scans'])} tell; go on by vatsloc localize CASE --state {out}")


@app.command()
def foresee(
    case: CaseArgument,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the forecast, whole or not at all.")],
    as_json: JsonOption = False,
) -> None:
    """Forecast from the CT of CASE alone, before surgery, where the nodule will probably be when the lung is down."""
    from vatsloc.workflow.foresee import foresee_case

    told = foresee_case(case, out, say)
    if as_json:
        show(told)
    else:
        x, y, z = told["nodule_lps"]
        a, b, c = told["nodule_ellipsoid95_mm"]
        print(
            f"forecast: nodule at LPS {x:.0f} {y:.0f} {z:.0f} mm in the CT's frame, give or take {a:.0f}, {b:.0f}, "
            f"{c:.0f} mm (95 %); report: {out / 'report.html'}"
        )


@app.command()
def new(
    case: Annotated[Path, typer.Argument(metavar="CASE", help="Case folder to make; nothing is overwritten.")],
    ct: Annotated[Path, typer.Option("--ct", metavar="PATH", help="CT: file, or folder of DICOM slices.")],
    deflated: Annotated[Path, typer.Option("--deflated", metavar="PATH", help="Cone-beam CT of the collapsed lung.")],
    nodule: Annotated[
        str, typer.Option("--nodule", metavar="FILE|X,Y,Z", help="Mask or markup in the CT, or its centre in RAS mm.")
    ],
    inflated: Annotated[
        Path | None,
        typer.Option("--inflated", metavar="PATH", help="Cone-beam CT of the inflated lung, if there is one."),
    ] = None,
    lps: Annotated[bool, typer.Option("--lps", help="X,Y,Z is LPS, as 3D Slicer's files and DICOM have it.")] = False,
    copy: Annotated[bool, typer.Option("--copy", help="Copy the files; else they are linked.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Make a case folder of three images and a nodule, and say what they show."""
    from vatsloc.new_case import Sources, new_case, nodule_source, sentences

    told = new_case(case, Sources(ct, inflated, deflated, nodule_source(nodule, lps)), copy)
    if as_json:
        show(told)
    else:
        print(sentences(told))


@app.command()
def evaluate(
    case: CaseArgument,
    result: Annotated[Path, typer.Argument(metavar="DIR", help="Results folder of the case.")],
    as_json: JsonOption = False,
) -> None:
    """Score the result in DIR with the landmarks and the true nodule of CASE."""
    from vatsloc.evaluation import evaluate_case, table

    scores = evaluate_case(case, result)
    say(table(scores))
    if as_json:
        show(scores)


@app.command()
def breathe(
    case: Annotated[Path, typer.Argument(metavar="CASE", help="Folder with breath.toml, or with lung masks.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Results folder, written whole or not at all.")],
    driver: Annotated[
        str, typer.Option(metavar="NAME", help="pressure-volume, regional-pressure, one-scan or surface.")
    ],
    states: Annotated[int, typer.Option(metavar="N", help="Number of states.")] = 10,
    fit_landmarks: Annotated[
        bool, typer.Option("--fit-landmarks", help="Experiment: regional-pressure is fitted to the landmarks as well.")
    ] = False,
    masks_alone: Annotated[
        bool, typer.Option("--masks-alone", help="Leave the registration of two images out of the motion.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Make the lungs of CASE breathe: meshes, fields, images and a film of every state."""
    from vatsloc.breathing.run import breathe_case

    result = breathe_case(case, out, driver, states, say, fit_landmarks, masks_alone)
    if as_json:
        show(result)
    else:
        print(out / "breath.html")


@app.command()
def export_dicom(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="Results folder of localize.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the DICOM files.")],
    series: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="DICOM series of the deflated scan, where the case has it elsewhere."),
    ] = None,
) -> None:
    """Write nodule, ellipsoid and lung as DICOM Segmentation, and a measurement report (extra "dicom")."""
    from vatsloc.dicomout import export_result

    for file in export_result(result, out, series):
        print(file)


@app.command()
def demo(
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the phantom case and its result.")
    ] = Path("vatsloc-demo"),
) -> None:
    """Make a phantom, localize its nodule with the fast preset, score it and say where the report is."""
    from vatsloc.evaluation import evaluate_case, table
    from vatsloc.synthetic.case import write_phantom
    from vatsloc.workflow.run import run_case
    from vatsloc.workflow.settings import load_settings

    compile_beside()
    case, result = out / "case", out / "result"
    write_phantom("demo", case, 0, say)
    run = run_case(case, result, load_settings("fast", None), say)
    scores = evaluate_case(case, result)
    say(table(scores))
    failed = [name for name, gate in run["gates"].items() if not gate["ok"]]
    print(f"report: {(result / 'report.html').resolve()}")
    if failed:
        raise GateFailed(f"The demo's quality gates failed: {', '.join(failed)}.")


for command in (cohort, chart, paper, calibrate_forecast):
    app.command()(command)


def _until_interrupted(sentence: str) -> None:
    say(sentence)
    with suppress(KeyboardInterrupt):
        Event().wait()


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; whatever ends it early becomes one sentence and an exit code.

    `--debug` may stand anywhere among the arguments; the error's traceback is then printed before its sentence.
    """
    given = sys.argv[1:] if arguments is None else arguments
    kept = [word for word in given if word != DEBUG]
    try:
        app(args=kept, standalone_mode=True)
    except Exception as error:
        if len(kept) < len(given):
            traceback.print_exc()
        ending = as_ours(error)
        say(f"vatsloc: {ending}")
        sys.exit(ending.exit_code)


if __name__ == "__main__":
    main()
