"""Where the nodule will probably be once the lung is down, from the CT alone: what phantoms' lungs did, as a spread.

Every phantom of the calibration (`vatsloc calibrate-forecast`) tells one affine motion of its lung about the middle,
against the spine; carried over to this lung, each is one guess at where the nodule goes. Their mean is the forecast,
and their spread, with what an affine motion leaves over, its ellipsoid. Lungs of drawn anatomy roll forward as they
collapse, those of a scanned chest do not, by the same physics: either kind of anatomy counts by half.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from functools import cache
from importlib.resources import files
from typing import Any, Literal

import numpy as np
from scipy.special import fdtri

from registration.volume import Array, Mask
from vatsloc.formats.casefile import PleuralGas
from vatsloc.frames import Side

CALIBRATION_FILE = "forecast.json"
State = Literal["inflated", "deflated"]


@dataclass(frozen=True)
class Motions:
    """Motions of lungs against the spine, one per person, R counted towards the operated side.

    gas: (m,) "air" or "co2"; anatomy: (m,) "drawn" or "scan"; shift: (m, 3) mm of the middle; gradient: (m, 3, 3) of
    the motion about it; left: (m, 3, 3) mm2, mean square of what the affine motion leaves over.
    """

    gas: Array
    anatomy: Array
    shift: Array
    gradient: Array
    left: Array

    def __len__(self) -> int:
        return len(self.shift)

    def only(self, chosen: Array) -> Motions:
        """The persons (m,) bool."""
        return Motions(*(getattr(self, part.name)[chosen] for part in fields(self)))


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
    mirror = mirrored(side)
    groups = {str(kind): motions.only(motions.gas == kind) for kind in np.unique(motions.gas)}
    n = len(groups[gas]) if gas in groups else 0
    if n < 5:
        raise ValueError(f"the calibration holds {n} persons with {gas} in the chest, 5 needed")
    guesses = {kind: _by_anatomy(group, (point - middle) * mirror) for kind, group in groups.items()}
    apart = np.concatenate([guess - guess.mean(axis=0) for each in guesses.values() for guess in each])
    freedom = len(motions) - sum(map(len, guesses.values()))
    means = np.array([guess.mean(axis=0) for guess in guesses[gas]])
    mean, kinds = means.mean(axis=0), len(means)
    spread = apart.T @ apart / freedom + motions.left.mean(axis=0)
    if kinds > 1:  # another kind of anatomy lies as far from these as they lie apart
        spread = spread + (kinds + 1) / kinds * np.cov(means.T)
    reach = (n + 1) / n * 3 * freedom / (freedom - 2) * fdtri(3, freedom - 2, 0.95)
    variance, directions = np.linalg.eigh(spread * np.outer(mirror, mirror) * reach)
    return Forecast(point + mean * mirror, np.sqrt(variance[::-1]), directions.T[::-1], n)


def mean_motion(points: Array, middle: Array, side: Side, motions: Motions) -> Array:
    """Displacements (n, 3) mm of points (n, 3) of a lung under the mean of the motions."""
    mirror = mirrored(side)
    each = [motions.only(motions.anatomy == kind) for kind in np.unique(motions.anatomy)]
    shift, gradient = (np.mean([getattr(m, part).mean(axis=0) for m in each], axis=0) for part in ("shift", "gradient"))
    return np.asarray((shift + (points - middle) * mirror @ gradient.T) * mirror)


def _by_anatomy(motions: Motions, about: Array) -> list[Array]:
    """What the persons of every kind of anatomy say, (m, 3) mm each, of a place (3,) mm about the middle."""
    guesses = motions.shift + motions.gradient @ about
    return [guesses[motions.anatomy == kind] for kind in np.unique(motions.anatomy)]


def middle_of(lung: Mask) -> Array:
    """Middle (3,) RAS mm of a lung, about which motions are told."""
    return lung.grid.to_ras(np.argwhere(lung.inside).mean(axis=0))


def mirrored(side: Side) -> Array:
    """Signs (3,) that count R towards the operated side."""
    return np.array([1.0 if side == "right" else -1.0, 1.0, 1.0])


def calibrated_motions(state: State) -> Motions:
    """Of the persons of the calibration that comes with the program."""
    return motions_of(calibration(), state)


def motions_of(rows: list[dict[str, Any]], state: State) -> Motions:
    """Of the rows that a calibration writes."""
    shift, gradient, left = (np.array([row[state][key] for row in rows]) for key in ("shift", "gradient", "left"))
    gas, anatomy = (np.array([row[key] for row in rows]) for key in ("gas", "anatomy"))
    return Motions(gas, anatomy, shift.reshape(-1, 3), gradient.reshape(-1, 3, 3), left.reshape(-1, 3, 3))


@cache
def calibration() -> list[dict[str, Any]]:
    """Rows of the calibration that comes with the program."""
    text = files("vatsloc.workflow").joinpath(CALIBRATION_FILE).read_text(encoding="utf-8")
    rows: list[dict[str, Any]] = json.loads(text)
    return rows
