"""Driver `regional-pressure`: pressures on patches of chest and diaphragm, fitted to the inspired border. Ref: Fuerst.

Once fitted they are generative: any history of them is a motion. Here they rise together, by the lung's volume.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from poro.arrays import Array
from poro.breathing.elastic import acting_at
from poro.breathing.pressure_fit import balanced, fit_pressures
from poro.breathing.regional import Pressed, Thorax, thorax
from poro.mesh import locate
from poro.mesh.locate import Location
from poro.mesh.tetmesh import signed_volumes
from vatsloc.breathing.case import BreathCase
from vatsloc.breathing.lungs import Pair, both_scans
from vatsloc.breathing.motion import IN, LungMotion, Motion, between, shares
from vatsloc.breathing.registered import as_motion, register
from vatsloc.breathing.score import read_landmarks
from vatsloc.errors import InputRefused

EDGE_MM = 16.0
SEEN = "E2: the fit has seen the landmarks that score it; its error at them tells how well it fits, and nothing more."


def drive(case: BreathCase, count: int, say: Callable[[str], None], see_landmarks: bool = False) -> Motion:
    """From expiration to inspiration in `count` states; see_landmarks: the paper's experiment E2."""
    pairs, notes = both_scans(case, EDGE_MM)
    found = None if see_landmarks else register(case, pairs, say)
    lungs, pressures, rows = [], [], []
    for number, pair in enumerate(pairs):
        try:
            scene = thorax(pair.expired.inside, pair.expired.ras_from_ijk, pair.lung, acting_at(pair.depth))
        except ValueError as refusal:
            raise InputRefused(f"No chest can be built about the {pair.side} lung: {refusal}.") from refusal
        matched = _matched(case, pair) if see_landmarks else None
        if found is not None:
            known = found[number]
            matched = locate(pair.lung.expired, known.expired), known.expired, known.inspired.points
        fit = fit_pressures(scene, pair.lung.inspired.boundary, matched, partial(_say, say, pair.side))
        say(f"{pair.side} lung: {count - 1} states of the fitted pressures ...")
        states, lost = states_of(scene, fit.state.p, fit.state.u, count)
        notes += _unsound(pair.side, scene, fit.state, lost)
        lungs.append(LungMotion(pair.side, scene.lung, states))
        pressures.append(1000 * np.abs(fit.state.p).mean())
        rows.append([pair.side, f"{fit.history[0]:.2f}", f"{fit.history[-1]:.2f}", str(fit.evaluations)])
        rows[-1].append(", ".join(f"{1000 * p:.0f}" for p in fit.state.p))
    if see_landmarks:
        notes.append(SEEN)
    head = ["lung", "surface distance at no pressure, mm", "fitted, mm", "equilibria", "pressures, Pa"]
    details: dict[str, Any] = {"tables": [{"title": "Fit of the pressures", "head": head, "rows": rows}]}
    if see_landmarks:
        details["saw_landmarks"] = True
    mean = float(np.mean(pressures))
    pressure = tuple(float(s * mean) for s in shares(count))
    return Motion("regional-pressure", IN, tuple(lungs), pressure, count - 1, tuple(notes), details, as_motion(found))


def _say(say: Callable[[str], None], side: str, text: str) -> None:
    say(f"{side} lung: {text}")


def states_of(scene: Thorax, p: Array, end: Array, count: int) -> tuple[tuple[Array, ...], int]:
    """Lung's nodes in `count` states from rest to `end`, equal steps of volume apart, as the pressures rise together;
    and at how many of the shares of them that were tried the bodies found no balance, where states lie on a line.
    """
    size = len(scene.lung.points)
    tried = np.linspace(0.0, 1.0, max(min(count, 6), 2))
    shares_, found, u = [0.0], [np.zeros_like(end)], np.zeros_like(end)
    for share in tried[1:-1]:
        pressed = balanced(scene, share * p, u + (share - shares_[-1]) * end, share)
        if pressed is not None:
            u = pressed.u
            shares_.append(float(share))
            found.append(u)
    shares_.append(1.0)
    found.append(end)
    volume = np.array([signed_volumes(scene.lung.points + f[:size], scene.lung.tets).sum() for f in found])
    wanted = np.linspace(volume[0], volume[-1], count)
    order, progress = np.argsort(volume), np.array(shares_)
    at = np.interp(wanted, volume[order], progress[order])
    every = np.stack([f[:size] for f in found])
    states = [scene.lung.points + between(every, progress, share) for share in at]
    states[0], states[-1] = scene.lung.points, scene.lung.points + every[-1]
    return tuple(states), len(tried) - len(found)


def _unsound(side: str, scene: Thorax, end: Pressed, lost: int) -> list[str]:
    """Sentences on what of a lung's answer is not to be relied on."""
    notes = []
    after = signed_volumes(scene.lung.points + end.u[: len(scene.lung.points)], scene.lung.tets)
    if (after <= 0).any():
        notes.append(f"{side} lung: {(after <= 0).sum()} of {len(after)} elements are turned inside out at the end.")
    if lost:
        notes.append(f"{side} lung: no balance at {lost} of the pressures between; states there lie on a line.")
    return notes


def _matched(case: BreathCase, pair: Pair) -> tuple[Location, Array, Array] | None:
    """Landmarks that lie in a lung, for E2."""
    if case.landmarks is None:
        raise InputRefused(f"{case.folder} has no landmarks to fit to; leave --fit-landmarks out.")
    inspired, expired = read_landmarks(case.landmarks)
    where = locate(pair.lung.expired, expired)
    near = np.flatnonzero(where.distance < 8.0)
    if len(near) == 0:
        return None
    return locate(pair.lung.expired, expired[near]), expired[near], inspired[near]
