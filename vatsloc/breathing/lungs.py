"""The lungs of a case as meshes: masks read or made from images, mended, parted, the same sides in both scans."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from poro.breathing.elastic import Lung, depth_of
from poro.mesh import TetMesh, stuff
from registration.volume import Mask
from vatsloc.breathing.case import BreathCase, Scan
from vatsloc.breathing.masks import BACK_MM, BACK_SEEN, CleanLungs, back_seen, lungs_of, to_the_back
from vatsloc.errors import InputRefused
from vatsloc.frames import Side
from vatsloc.imaging.lattice import on_grid
from vatsloc.imaging.lungs import lung_halves

EDGE_MM = 12.0
MUCH = 2.5
"""Ratio of volumes of the same lung in both scans that no breath reaches."""


@dataclass(frozen=True)
class Pair:
    """One lung in both scans: masks, and meshes made of them. depth: of the breath (`depth_of`), one for both lungs."""

    side: Side
    inspired: Mask
    expired: Mask
    lung: Lung
    depth: float


def both_scans(case: BreathCase, edge_mm: float = EDGE_MM) -> tuple[list[Pair], list[str]]:
    """Lungs that both scans show, and what was mended. Raises InputRefused where a scan or a common lung is missing."""
    if case.inspiration is None or case.expiration is None:
        raise InputRefused(
            f"{case.folder} shows one state; this driver needs inspiration and expiration, so add the other one "
            "or take --driver one-scan."
        )
    inspired, expired = masks_of(case.inspiration), masks_of(case.expiration)
    notes = [*inspired.notes, *expired.notes]
    sides: list[Side] = [side for side in ("left", "right") if side in inspired.lungs and side in expired.lungs]
    if not sides:
        raise InputRefused(
            f"The inspiration shows the {' and '.join(inspired.lungs)} lung, the expiration the "
            f"{' and '.join(expired.lungs)} one; give masks of the same lung."
        )
    for side in set(inspired.lungs) ^ set(expired.lungs):
        notes.append(f"The {side} lung is shown by one of the scans only and was left out.")
    pairs = []
    # A person breathes with both lungs at once, whatever either mask has lost.
    depth = depth_of(sum(_mm3(inspired.lungs[s]) for s in sides) / sum(_mm3(expired.lungs[s]) for s in sides))
    for side in sides:
        full, rest = inspired.lungs[side], expired.lungs[side]
        ratio = _mm3(full) / _mm3(rest)
        seen, shown = float(back_seen(rest, full).min()), rest
        if case.expiration.image is None:
            rest = to_the_back(rest, full)
        if seen < BACK_SEEN:
            notes.append(_lacking(side, seen, (_mm3(rest) - _mm3(shown)) / 1000))
        if not 1 / MUCH < ratio < MUCH * 1.5:
            raise InputRefused(
                f"The {side} lung is {ratio:.2f} times as large in the inspiration as in the expiration, which no "
                "breath does; look whether both masks show the same, whole lung."
            )
        if ratio < 1:
            notes.append(f"The {side} lung is smaller in the inspiration ({ratio:.2f} of the expiration's volume).")
        pairs.append(Pair(side, full, rest, Lung(side, meshed(full, edge_mm), meshed(rest, edge_mm)), depth))
    return pairs, notes


def masks_of(scan: Scan) -> CleanLungs:
    """Lungs of a scan, by its mask or else by its image."""
    if scan.mask is not None:
        return lungs_of(scan.mask, scan.name)
    assert scan.image is not None
    work, _, halves, _ = lung_halves(scan.image)
    both = np.logical_or.reduce(list(halves.values()))
    return lungs_of(on_grid(both, work.grid, work.grid), scan.name)


def _lacking(side: Side, seen: float, filled_ml: float) -> str:
    """Warning of an expired lung without its back."""
    filled = (
        f"{filled_ml:.0f} ml were filled in up to the inspired back wall, and" if filled_ml else "It was left so, and"
    )
    return (
        f"The expired {side} lung lacks its back: somewhere along the body its mask holds {100 * seen:.0f} % of the "
        f"{BACK_MM:.0f} mm in front of the inspired back wall, at least {100 * BACK_SEEN:.0f} % are usual. "
        f"{filled} motion behind and near it is a guess; look at the mask."
    )


def _mm3(lung: Mask) -> float:
    return float(lung.inside.sum() * lung.grid.spacing.prod())


def meshed(lung: Mask, edge_mm: float) -> TetMesh:
    """Tetrahedra that fill a lung. Raises InputRefused where the mask cannot hold them."""
    try:
        return stuff(lung.inside, lung.ras_from_ijk, edge_mm)
    except ValueError as refusal:
        raise InputRefused(f"The lung of a mask cannot be meshed: {refusal}.") from refusal
