"""Command `vatsloc listen`: take scans that are pushed by DICOM, answer, and send the answer on."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from vatsloc.precompile import compile_beside
from vatsloc.terminal import LinkOption, link, say, taking


@dataclass(frozen=True)
class Listening:
    """Options of the command, with their defaults."""

    port: Annotated[int, typer.Option(metavar="N", min=0, max=65535, help="Port to listen on.")]
    cases: Annotated[Path, typer.Option(metavar="DIR", help="Folder for what arrives and for the answers.")]
    nodule: Annotated[
        Path | None,
        typer.Option(metavar="FILE|DIR", help="Nodule in the CT, or a folder of files named by patient ID."),
    ] = None
    ct: Annotated[Path | None, typer.Option(metavar="DIR", help="CT that is here already, as DICOM.")] = None
    patient: Annotated[str, typer.Option(metavar="ID", help="Patient whom the file of --nodule is about.")] = ""
    send: Annotated[str | None, typer.Option(metavar="[TITLE@]HOST:PORT", help="Node that gets the answers.")] = None
    allow: Annotated[str, typer.Option(metavar="A,B,..", help="Titles of callers; all others are refused.")] = ""
    title: Annotated[str, typer.Option(metavar="TITLE", help="Own application entity title.")] = "VATSLOC"
    preset: Annotated[str, typer.Option(metavar="NAME", help="fast, balanced, accurate or auto.")] = "balanced"
    settle: Annotated[float, typer.Option(metavar="S", min=0, help="Silence after which a series may be whole.")] = 5.0
    timeout: Annotated[float, typer.Option(metavar="S", min=1, help="Silence after which one is given up.")] = 120.0
    openigtlink: LinkOption = None


@taking(Listening)
def listen(options: Listening) -> None:
    """Take scans that are pushed by DICOM, answer, and send the answer on (extra "dicom")."""
    from vatsloc.dicomnet.arrival import Patience
    from vatsloc.dicomnet.listen import Node, import_series, require_pynetdicom
    from vatsloc.dicomnet.listen import listen as serve
    from vatsloc.dicomnet.nodule import NoduleFiles
    from vatsloc.dicomnet.sending import target_of
    from vatsloc.dicomnet.work import real_work
    from vatsloc.workflow.settings import load_settings

    require_pynetdicom()
    load_settings(options.preset, None)
    compile_beside()  # before the first scan is there
    target = None if options.send is None else target_of(options.send)
    whose = import_series(options.cases, options.ct) if options.ct is not None else ""
    nodules = None if options.nodule is None else NoduleFiles(options.nodule, options.patient or whose)
    callers = tuple(word.strip() for word in options.allow.split(",") if word.strip())
    patience = Patience(options.settle, options.timeout)
    with link(options.openigtlink) as publish, suppress(KeyboardInterrupt):
        node = Node(options.cases, options.port, options.title, callers, target, patience, publish)
        serve(node, nodules, real_work(options.preset), say)
    say("stopped; start it again to go on")
