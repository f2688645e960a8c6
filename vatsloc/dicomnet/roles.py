"""Which of a patient's scans is the CT, which the inflated and which the deflated lung."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from vatsloc.dicomnet.arrival import Scan
from vatsloc.imaging.side import PleuralGas


@dataclass(frozen=True)
class Roles:
    """None where a scan has not come yet. deflated: later ones too, each to be answered; warnings: sentences."""

    ct: Scan | None
    inflated: Scan | None
    deflated: tuple[Scan, ...]
    warnings: tuple[str, ...] = ()


def roles(scans: Sequence[Scan]) -> Roles:
    """Roles of whole scans of one patient, by kind, time and pleural gas.

    The CT with the most slices is taken. Cone-beam CTs belong together where they are of one study, of which the latest
    counts; the first of them shows the inflated lung, unless gas clearly says the opposite of the first two.
    """
    said: list[str] = []
    cts = sorted((s for s in scans if s.kind == "CT"), key=lambda s: (s.n, s.time))
    if len(cts) > 1:
        said.append(f"{len(cts)} CTs have come; the one of {cts[-1].n} slices is taken ({_called(cts[-1])}).")
    cbcts = sorted((s for s in scans if s.kind != "CT"), key=lambda s: (s.time, s.folder.name))
    if cbcts:
        study = cbcts[-1].study
        others = sum(s.study != study for s in cbcts)
        if others:
            said.append(f"{others} cone-beam CTs are of another study than the latest one and are left aside.")
        cbcts = [s for s in cbcts if s.study == study]
    ct = cts[-1] if cts else None
    if len(cbcts) < 2:
        return Roles(ct, cbcts[0] if cbcts else None, (), tuple(said))
    first, second, *later = cbcts
    gas, told_by_time = _order(first, second), bool(first.time) and first.time != second.time
    if gas is False:
        first, second = second, first
        said.append("Pleural gas says that the later cone-beam CT shows the inflated lung; it is taken so.")
    elif not told_by_time and gas is None:
        said.append("Neither time nor pleural gas tells the inflated from the deflated scan; nothing is answered.")
        return Roles(ct, None, (), tuple(said))
    for scan in (second, *later):
        if scan.frame != first.frame:
            said.append(
                f"{_called(scan)} has another frame of reference than the inflated scan; "
                "their headers are taken to place them within 10 cm all the same."
            )
    return Roles(ct, first, (second, *later), tuple(said))


def _order(first: Scan, second: Scan) -> bool | None:
    """Whether gas says that `first` shows the inflated lung; None where it says nothing clear."""
    if first.gas_ml is None or second.gas_ml is None:
        return None
    a, b = ({"right": s.gas_ml["right"], "left": s.gas_ml["left"]} for s in (first, second) if s.gas_ml is not None)
    forth, back = PleuralGas(a, b).side, PleuralGas(b, a).side  # type: ignore[arg-type]
    return None if (forth is None) == (back is None) else forth is not None


def _called(scan: Scan) -> str:
    return f'"{scan.description}"' if scan.description else f"the scan of {scan.time or 'no time'}"
