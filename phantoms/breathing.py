"""A breath of one scanned person: states along a volume signal, each with its image and its map.

Equilibria are found at a few volumes; between them the coefficients of the map follow a spline in the volume, so a
state costs no more than its image. The scan itself is the end of the inspiration.
Ref: Lujan 1999, eq. 1 (the signal); Li and Porikli 2014 (a series from one scan).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from phantoms.cage import CageMotion, fit_dome
from phantoms.imaging import State, image_state
from phantoms.lobes import LobedMap
from phantoms.patient import Patient
from phantoms.spec import Collapse
from phantoms.spline import SplineMap
from phantoms.states import lung_body
from phantoms.voxels import Grid, Image

Array = NDArray[Any]
SUPINE = np.array([0.0, -1.0, 0.0])
RIBS_MM = 4.0
"""How far the ribs of one side move in while the lung loses three tenths of its volume."""
KNOTS = 4


@dataclass(frozen=True)
class Breath:
    """States of one breath. volume: (n,) of the lung over that in the scan; patient, body: what images are made of."""

    volume: Array
    states: tuple[State, ...]
    patient: Patient
    body: Image

    def images(self, grid: Grid) -> Iterator[Image]:
        """The image of every state on `grid`, without noise but that of the scan."""
        for state in self.states:
            yield image_state(self.patient, self.body, state, grid).clean


def volume_signal(count: int, least: float, sharpness: int = 4) -> Array:
    """Volumes (count,) of one breath from the end of inspiration, 1, through that of expiration, `least`, and back."""
    t = np.arange(count) / count
    return np.asarray(least + (1 - least) * np.cos(np.pi * t) ** sharpness)


def breathe(patient: Patient, body: Image, volume: Array, element_mm: float, rng: np.random.Generator) -> Breath:
    """A breath along `volume` (n,), ratios to the scan's, no greater than 1. body: the scan without the lung."""
    knots = np.linspace(volume.min(), 1.0, KNOTS)
    lung = lung_body(patient, Collapse(), element_mm, rng)
    motions = [_motion(patient, v) for v in knots]
    ends = [lung.settle(m, SUPINE, held=True)[1].state_from_ct for m in motions]
    last = ends[-1].pieces[0]
    coefficients = np.stack([end.pieces[0].coefficients - last.coefficients for end in ends])
    between = CubicSpline(knots, coefficients, axis=0)
    rises = CubicSpline(knots, [m.operated_dome for m in motions])
    states = []
    for v in volume:
        rise = float(rises(v) - rises(1.0))
        motion = CageMotion(patient.build, patient.sign, rise, rise, 0.0, _ribs(v))
        piece = SplineMap(np.ascontiguousarray(between(v)), last.origin, last.spacing)
        room = motion.carry(patient.lung)
        moved = LobedMap((piece,), patient.lobes)
        states.append(State(patient.lung, room, motion, moved, True, np.eye(4), lung.tissue.points))
    return Breath(volume, tuple(states), patient, body)


def _ribs(volume: float) -> float:
    return RIBS_MM * (1 - volume) / 0.3


def _motion(patient: Patient, volume: float) -> CageMotion:
    motion = CageMotion(patient.build, patient.sign, 0.0, 0.0, 0.0, _ribs(volume))
    found = fit_dome(motion, patient.lung, volume) if volume < 1 else motion
    return replace(found, other_dome=found.operated_dome)
