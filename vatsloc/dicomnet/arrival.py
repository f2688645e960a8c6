"""Whether a series has arrived whole: even slices, as many as stated, and a sender that did not break off."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path

from vatsloc.dicomnet.store import Store
from vatsloc.errors import InputRefused
from vatsloc.formats.dicom.source import SourceSeries, read_source
from vatsloc.formats.folder import write_whole

CBCT_MM = 280.0
"""Longest in-plane side of what counts as a cone-beam CT; C-arms see 160 to 250 mm, a chest CT shows 300 mm or more."""
_X_RAY_3D = ("XA", "RF")


class Arrived(StrEnum):
    """How far the arrival of a series is."""

    RECEIVING = "images are arriving"
    WAITING = "waiting for the rest"
    WHOLE = "whole"
    INCOMPLETE = "incomplete"


@dataclass(frozen=True)
class Scan:
    """A whole series. folder: with its slices; n: how many images; kind: "CT" or "cone-beam CT"; time: of acquisition,
    YYYYMMDDHHMMSS as far as stated; side_mm: longest in-plane side; gas_ml: beside the lungs, by side, None unknown."""

    folder: Path
    n: int
    kind: str
    time: str
    study: str
    frame: str
    side_mm: float
    description: str
    gas_ml: dict[str, float] | None = None


@dataclass(frozen=True)
class Arrival:
    """A series so far. says: what is missing, "" where nothing is."""

    state: Arrived
    n: int
    says: str = ""
    scan: Scan | None = None


@dataclass(frozen=True)
class Patience:
    """settle_s: seconds of silence after which a series may be whole; timeout_s: after which it is given up."""

    settle_s: float = 5.0
    timeout_s: float = 120.0


def arrival(series: Path, store: Store, patience: Patience) -> Arrival:
    """How far a series folder of a store is. What is known of a whole one is kept beside it, so it is read once."""
    slices = series / "slices"
    n = sum(1 for _ in slices.iterdir())
    known = _known(series)
    if known is not None and known.n == n:
        return Arrival(Arrived.WHOLE, n, scan=known)
    marks = [mark.name.removeprefix("open-") for mark in series.glob("open-*")]
    quiet = time.time() - slices.stat().st_mtime
    if any(mark in store.active for mark in marks) or quiet < patience.settle_s:
        return Arrival(Arrived.RECEIVING, n)
    missing, source = _missing(slices, n, bool(marks))
    if source is None:
        late = quiet >= patience.timeout_s
        return Arrival(Arrived.INCOMPLETE if late else Arrived.WAITING, n, missing)
    scan = _scan(series, n, source)
    keep(scan)
    return Arrival(Arrived.WHOLE, n, scan=scan)


def keep(scan: Scan) -> None:
    """Note beside a series what is known of it."""
    text = json.dumps({**asdict(scan), "folder": scan.folder.name}, indent=1)
    write_whole(scan.folder / "scan.json", text + "\n")


def _missing(slices: Path, n: int, broken: bool) -> tuple[str, SourceSeries | None]:
    """What a series lacks, or the series."""
    try:
        source = read_source(slices)
    except InputRefused as error:
        return str(error), None
    stated = str(source.images[0].get("NumberOfSeriesRelatedInstances") or "")
    if stated.isdecimal() and int(stated) > n:
        return f"{n} images of {stated} have arrived; push the series again.", None
    if broken:
        return f"the sender broke off after {n} images; push the series again.", None
    return "", source


def _scan(series: Path, n: int, source: SourceSeries) -> Scan:
    header = source.images[0]
    side = float((source.grid.spacing * source.grid.shape)[:2].max())
    is_cbct = str(header.get("Modality")) in _X_RAY_3D or side <= CBCT_MM
    day = header.get("AcquisitionDate") or header.get("SeriesDate") or header.get("StudyDate") or ""
    hour = header.get("AcquisitionTime") or header.get("SeriesTime") or ""
    when = str(header.get("AcquisitionDateTime") or f"{day}{hour}")
    return Scan(
        folder=series,
        n=n,
        kind="cone-beam CT" if is_cbct else "CT",
        time=when.split(".")[0].split("+")[0][:14],
        study=str(header.StudyInstanceUID),
        frame=source.frame_of_reference,
        side_mm=round(side, 1),
        description=str(header.get("SeriesDescription") or ""),
    )


def _known(series: Path) -> Scan | None:
    try:
        told = json.loads((series / "scan.json").read_text(encoding="utf-8"))
        return Scan(**{**told, "folder": series})
    except (OSError, ValueError, TypeError):
        return None
