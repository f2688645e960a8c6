"""Driver `one-scan`: a whole breath from one scan. Ref: Li & Porikli 2014.

Lungs settle at a few volumes between rest and full motion; every state along the signal lies between two of them, so
that a state costs no more than its image.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from poro.arrays import Array
from poro.breathing.one_scan import TRACTION, OneScan, one_scan
from registration.volume import Mask
from vatsloc.breathing.case import BreathCase, Scan
from vatsloc.breathing.lungs import both_scans, masks_of, meshed
from vatsloc.breathing.motion import FULL_DEPTH, IN, OUT, LungMotion, Motion, between
from vatsloc.breathing.registered import as_motion, register
from vatsloc.breathing.signal import PERIOD_S, quiet_breath, sampled
from vatsloc.errors import InputRefused

EDGE_MM = 15.0
TIDAL_ML = 500.0
"""Volume of a quiet breath of both lungs, where no other scan tells it."""
LEAST, MOST = 0.5, 1.9
KNOTS = 5


def drive(case: BreathCase, count: int, say: Callable[[str], None]) -> Motion:
    """States along the signal from the scan and back to it; the scan is that of the inspiration where there are both.

    Of a second scan the volume alone is taken, as the depth of the breath, unless two images are registered; and its
    landmarks score the deepest state.
    """
    scan = case.inspiration or case.expiration
    assert scan is not None
    direction = OUT if scan is case.inspiration else IN
    clean = masks_of(scan)
    notes = list(clean.notes)
    start = sum(_ml(mask) for mask in clean.lungs.values())
    full = _full_ml(case, scan, (start, len(clean.lungs)), direction, notes)
    if case.signal is None:
        t, volume = np.linspace(0, PERIOD_S, count), quiet_breath(count, direction == OUT)
    else:
        t, volume = sampled(case.signal, count)
    share = volume if direction == IN else 1 - volume
    found = None if case.images is None else register(case, both_scans(case, EDGE_MM)[0], say)
    known = {} if found is None else {r.pair.side: r for r in found}
    lungs, pressures = [], []
    for side, mask in clean.lungs.items():
        mesh = known[side].inspired if side in known else meshed(mask, EDGE_MM)
        say(f"{side} lung: {KNOTS - 1} equilibria ...")
        try:
            scene = one_scan(mesh, side)
        except ValueError as refusal:
            raise InputRefused(f"The {side} lung of {case.folder}: {refusal}.") from refusal
        rest = float(mesh.volumes.sum())
        if side in known:
            scene = scene.guided(known[side].outward(), rest * (full / start - 1))
        knots = np.linspace(0, 1, KNOTS)
        settled = scene.states([rest * (1 + k * (full / start - 1)) for k in knots[1:]])
        u = np.stack([np.zeros_like(mesh.points), *(s.u for s in settled)])
        p = np.array([0.0, *(1000 * s.transpulmonary_kpa for s in settled)])
        lag = _lag(scene, rest * (1 + (full / start - 1) / 2), case.hysteresis)
        states = tuple(
            mesh.points + between(u, knots, s) + d * 4 * s * (1 - s) * lag
            for s, d in zip(share, _way(share), strict=True)
        )
        lungs.append(LungMotion(side, mesh, states))
        pressures.append(np.interp(share, knots, p))
    pressure = tuple(float(v) for v in np.mean(pressures, axis=0))
    deepest = int(np.argmax(share))
    two = case.inspiration is not None and case.expiration is not None
    end = deepest if two and share[deepest] > FULL_DEPTH else None
    if end is None and case.landmarks is not None:
        notes.append("No state reaches the other scan's depth, so landmarks are not scored; take an odd --states.")
    details: dict[str, Any] = {"time_s": t.tolist(), "signal": volume.tolist(), "hysteresis": case.hysteresis}
    return Motion("one-scan", direction, tuple(lungs), pressure, end, tuple(notes), details, as_motion(found))


def _full_ml(case: BreathCase, scan: Scan, at_scan: tuple[float, int], direction: str, notes: list[str]) -> float:
    """Volume at the other end of the breath. at_scan: ml, and of how many lungs."""
    start, lungs = at_scan
    other = case.expiration if scan is case.inspiration else case.inspiration
    if other is None:
        tidal = TIDAL_ML * lungs / 2
        full = start + tidal * (1 if direction == IN else -1)
        notes.append(f"The depth of the breath is not known; {tidal:.0f} ml, a quiet breath's, are taken.")
    else:
        full = sum(_ml(mask) for mask in masks_of(other).lungs.values())
        if case.images is None:
            notes.append(f"Of the {other.name} the volume alone was taken, {full:.0f} ml, as the depth of the breath.")
    kept = float(np.clip(full, LEAST * start, MOST * start))
    if kept != full:
        notes.append(f"The breath was limited to {kept:.0f} ml of {start:.0f} ml at the scan, from {full:.0f} ml.")
    return kept


def _lag(scene: OneScan, half_mm3: float, hysteresis: float) -> Array:
    """How far tissue is ahead on the way in, halfway (n, 3) mm: the diaphragm leads, and on the way out the ribs."""
    if hysteresis == 0.0:
        return np.zeros_like(scene.mesh.points)
    more = scene.states([half_mm3], TRACTION * (1 + hysteresis))[0].u
    less = scene.states([half_mm3], TRACTION * (1 - hysteresis))[0].u
    return (more - less) / 2


def _way(share: Array) -> Array:
    """+1 where the motion goes on, -1 where it returns."""
    step = np.gradient(share)
    return np.where(step >= 0, 1.0, -1.0)


def _ml(mask: Mask) -> float:
    return float(mask.inside.sum() * mask.grid.spacing.prod()) / 1000
