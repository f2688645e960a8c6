"""Where the nodule will probably be once the lung is down, from the CT alone: what phantoms' lungs did, as a spread.

Every phantom of the calibration (`vatsloc calibrate-forecast`) tells one affine motion of its lung about the middle,
against the spine; carried over to this lung, each is one guess at where the nodule goes. Their mean is the forecast,
and their spread, with what an affine motion leaves over, its ellipsoid.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any, Literal

import numpy as np
from scipy import stats

from registration.volume import Array
from vatsloc.formats.casefile import PleuralGas
from vatsloc.frames import Side

CALIBRATION_FILE = "forecast.json"
State = Literal["inflated", "deflated"]


@dataclass(frozen=True)
class Motions:
    """Motions of lungs against the spine, one per person, R counted towards the operated side.

    gas: (m,) "air" or "co2"; shift: (m, 3) mm of the middle; gradient: (m, 3, 3) of the motion about it; left:
    (m, 3, 3) mm2, mean square of what the affine motion leaves over.
    """

    gas: Array
    shift: Array
    gradient: Array
    left: Array

    def __len__(self) -> int:
        return len(self.shift)


@dataclass(frozen=True)
class Forecast:
    """centre: (3,) RAS mm in the CT's frame; semi_axes_mm: (3,) of the 95 % ellipsoid, longest first; axes: (3, 3),
    their directions in rows; persons: how many with this gas in the chest it rests on.
    """

    centre: Array
    semi_axes_mm: Array
    axes: Array
    persons: int


def forecast(point: Array, middle: Array, side: Side, motions: Motions, gas: PleuralGas = "air") -> Forecast:
    """Where a point (3,) of a lung with its middle (3,) goes, RAS mm. side: the operated one.

    The mean is that of the persons with this gas, the spread that of all about the mean of theirs; the ellipsoid is the
    prediction region of one more person (Hotelling's T squared). Raises ValueError for fewer than five persons.
    """
    own = motions.gas == gas
    n = int(own.sum())
    if n < 5:
        raise ValueError(f"the calibration holds {n} persons with {gas} in the chest, 5 needed")
    mirror = mirrored(side)
    about = (point - middle) * mirror
    guesses = motions.shift + motions.gradient @ about
    mean = guesses[own].mean(axis=0)
    kinds = np.unique(motions.gas)
    apart = np.concatenate([guesses[motions.gas == kind] - guesses[motions.gas == kind].mean(axis=0) for kind in kinds])
    freedom = len(motions) - len(kinds)
    spread = apart.T @ apart / freedom + motions.left.mean(axis=0)
    reach = (n + 1) / n * 3 * freedom / (freedom - 2) * stats.f.ppf(0.95, 3, freedom - 2)
    variance, directions = np.linalg.eigh(spread * np.outer(mirror, mirror) * reach)
    return Forecast(point + mean * mirror, np.sqrt(variance[::-1]), directions.T[::-1], n)


def mean_motion(points: Array, middle: Array, side: Side, motions: Motions) -> Array:
    """Displacements (n, 3) mm of points (n, 3) of a lung under the mean of the motions."""
    mirror = mirrored(side)
    about = (points - middle) * mirror
    return np.asarray((motions.shift.mean(axis=0) + about @ motions.gradient.mean(axis=0).T) * mirror)


def mirrored(side: Side) -> Array:
    """Signs (3,) that count R towards the operated side."""
    return np.array([1.0 if side == "right" else -1.0, 1.0, 1.0])


def calibrated_motions(state: State) -> Motions:
    """Of the persons of the calibration that comes with the program."""
    return motions_of(calibration(), state)


def motions_of(rows: list[dict[str, Any]], state: State) -> Motions:
    """Of the rows that a calibration writes."""
    shift, gradient, left = (np.array([row[state][key] for row in rows]) for key in ("shift", "gradient", "left"))
    gas = np.array([row["gas"] for row in rows])
    return Motions(gas, shift.reshape(-1, 3), gradient.reshape(-1, 3, 3), left.reshape(-1, 3, 3))


@cache
def calibration() -> list[dict[str, Any]]:
    """Rows of the calibration that comes with the program."""
    text = files("vatsloc.workflow").joinpath(CALIBRATION_FILE).read_text(encoding="utf-8")
    rows: list[dict[str, Any]] = json.loads(text)
    return rows
