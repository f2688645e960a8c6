"""Driver `pressure-volume`: the expired lung is inflated inside the inspired cavity, phase by phase. Ref: Eom 2010.

The pressure follows the volume: at every phase the lung has the phase's volume, and its tissue's stiffness is set by
one number, so that at the end of inspiration the pressure is what the pressure-volume curve says.

Tissue is even in a full lung and uneven in an emptied one, so how much each part fills is told by the inspired lung
emptied; where there are two images, by their registration. Ref: Milic-Emili 1966 (regional volumes).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from poro.arrays import Array
from poro.breathing.cavity import TISSUE, Inflating, inflating
from poro.breathing.elastic import acting_at, breathe_out
from poro.breathing.inflation import fill
from poro.breathing.mesh_quality import Shares, smooth, violations
from poro.breathing.pressure_volume import pressure_volume, recoil_pa
from vatsloc.breathing.case import BreathCase
from vatsloc.breathing.lungs import Pair, both_scans, meshed
from vatsloc.breathing.motion import IN, LungMotion, Motion, between, shares
from vatsloc.breathing.registered import Registered, as_motion, register

EDGE_MM = 16.0
"""Of the lung that is inflated; the one that is emptied has the finer mesh of driver `surface`."""
EQUILIBRIA = 2
"""How many are computed; phases between lie on a line from one to the next, which none left by over 0.7 mm."""
FULL = 0.99
"""Share of the way to the inspired volume at which the lung stops: corners of the cavity it would only fill at any
pressure."""


def drive(case: BreathCase, count: int, say: Callable[[str], None]) -> Motion:
    """From expiration to inspiration in `count` phases of equal volume steps."""
    pairs, notes = both_scans(case)
    progress = shares(count)
    knots = shares(min(count, EQUILIBRIA + 1))
    lungs, pressures, quality = [], [], []
    found = register(case, pairs, say)
    for number, pair in enumerate(pairs):
        say(f"{pair.side} lung: {len(knots) - 1} equilibria of its inflation ...")
        scene = _scene(pair, breathe_out(pair.lung, acting_at(pair.depth)) if found is None else found[number].expired)
        phases = list(fill(scene.at, knots[1:].tolist(), partial(_volume, scene), scene.guess))
        u = np.stack([np.zeros_like(scene.mesh.points), *(phase.u for phase in phases)])
        states = tuple(scene.mesh.points + between(u, knots, s) for s in progress)
        lungs.append(LungMotion(pair.side, scene.mesh, states))
        pressures.append([recoil_pa(scene.mesh, nodes, TISSUE) for nodes in states])
        quality.append((pair.side, violations(scene.mesh), violations(smooth(scene.mesh))))
        if not all(phase.settled for phase in phases):
            slow = sum(not phase.settled for phase in phases)
            notes.append(f"{pair.side} lung: {slow} of {len(knots) - 1} equilibria still moved by over 0.3 mm a step.")
    by_tissue = np.mean(pressures, axis=0)
    volumes = np.array([sum(lung.volume_ml(n) for lung in lungs) for n in range(count)])
    curve = pressure_volume(volumes - volumes[0], volumes[0])
    stiffness = float(curve[-1] / by_tissue[-1]) if by_tissue[-1] > 0 else 1.0
    details: dict[str, Any] = {
        "stiffness_ratio": stiffness,
        "tables": [_pressures(volumes, curve, stiffness * by_tissue), _quality(quality)],
    }
    pressure = tuple(float(p) for p in stiffness * by_tissue)
    return Motion("pressure-volume", IN, tuple(lungs), pressure, count - 1, tuple(notes), details, as_motion(found))


def _scene(pair: Pair, emptied: Array) -> Inflating:
    """A lung's inspiration, guided back along the way on which its inspired nodes came to `emptied` (n, 3)."""
    lung = replace(pair.lung, expired=meshed(pair.expired, EDGE_MM))
    return inflating(lung, Registered(replace(pair, lung=lung), emptied).inward())


def _volume(scene: Inflating, share: float) -> float:
    return scene.volume(FULL * share)


def _pressures(volumes: Array, curve: Array, tissue: Array) -> dict[str, Any]:
    rows = [
        [n, f"{v:.0f}", f"{c:.0f}", f"{t:.0f}"] for n, (v, c, t) in enumerate(zip(volumes, curve, tissue, strict=True))
    ]
    return {"title": "Pressure and volume", "head": ["phase", "ml", "curve, Pa", "tissue, Pa"], "rows": rows}


def _quality(lungs: Sequence[tuple[str, Shares, Shares]]) -> dict[str, Any]:
    rows = []
    for side, before, after in lungs:
        for name, shares_ in (("as stuffed", before), ("after descent on V / L^3", after)):
            rows.append([f"{side}, {name}", *(f"{100 * share:.1f} %" for share in shares_)])
    head = ["mesh", "Jacobian < 0.9", "aspect > 2", "angle > 80", "angle < 50", "worst V / L^3"]
    return {"title": "Elements beyond the limits of Eom's table II", "head": head, "rows": rows}
