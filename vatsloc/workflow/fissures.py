"""Where a collapsed lung has come apart: a bowed sheet through the CT's lung, on either side of which tissue moved
otherwise, and along which gas now lies.

Two kinds of evidence that know nothing of each other have to agree: the motion of keypoints, which two smooth maps
follow far better than one, and the gas beside the collapsed lung, whose border came from deep inside it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import minimize

from poro.mesh.pieces import Pieces
from registration.maps.monomials import monomials
from registration.volume import Array
from vatsloc.workflow.bend import Bend, bend_to

SCALE_MM = 60.0
"""Lengths of a lung, by which coordinates are divided before they are multiplied with each other."""
MOTION_MM, GAS_MM = 3.0, 5.0
"""Misfits beyond these lose influence (Cauchy)."""
GAS_WEIGHT = 0.1
"""Of a point of gas, one for some 9 mm2 of surface, beside a keypoint."""
LEAST_KEYPOINTS = 25
"""On either side of a sheet."""
LEAST_DEEP_MM = 10.0
"""Gas whose border lay so deep below the pleura has come into the lung."""
BESIDE_MM = 8.0
LEAST_GAS, LEAST_GAS_OF_BORDER, LEAST_GAS_SHARE = 40, 0.03, 0.45
"""Points of gas that there have to be, also as a share of the gas's border, of which a few are always carried back too
deep, and their share beside the sheet."""
MOST_COST, MOST_COST_BESIDE_GAS = 0.75, 0.95
"""Of the cost of one smooth map, what two have to come down to; beside gas keypoints need to say less, since most may
lie in one lobe."""
CLEAR_GAS_SHARE = 2 / 3
"""From here on the gas beside the sheet is clear evidence."""
NOT_WORSE, BETTER, MUCH_BETTER = 1.0, 0.95, 0.88
"""What two pieces may miss held-out keypoints by, as a share of what one does: where keypoints and gas are both clear,
where the gas alone is, and where it is not. The weaker the evidence, the more hold-out has to say (docs/method.md)."""
STARTS = 3
SLOPES, TILTS, OFFSETS_MM = (0.0, 0.4, 0.7, 0.9, 1.2, 1.6), (-0.4, 0.0, 0.4), np.arange(-48.0, 49.0, 8.0)
USUAL, SPREAD = np.array([0.9, 0.0, 0.0, 0.0, 0.0, 0.0]), np.array([0.6, 0.5, 40.0, 10.0, 10.0, 10.0])
"""An oblique fissure's shape, and how far it departs from that."""
_RIDGE = np.array([0.0, 0.3, 0.3, 0.3, 3.0, 3.0, 3.0, 3.0, 3.0, 3.0])


@dataclass(frozen=True)
class Sheet:
    """A bowed sheet through a lung. hilum: (3,) RAS mm; shape: (6,) mm up per mm forward and per mm to the right, mm it
    passes below the hilum, and mm it bulges at 60 mm along both axes and between them; bend: its height over that.
    """

    hilum: Array
    shape: Array
    bend: Bend | None = None

    def distance(self, points: Array) -> Array:
        """Signed distance (n,) mm of points (n, 3) from the sheet, along a plane's normal; positive above it."""
        return self._unbent(points) - (0.0 if self.bend is None else self.bend.height(points))

    def bent(self, points: Array, side: Array, gas: Array) -> Sheet:
        """The sheet with points (n, 3) mm on their sides (n,), +1 above it or -1 below, along gas (k, 3)."""
        slope, tilt = self.shape[:2]
        first, normal = np.array([1.0, 0.0, -tilt]), np.array([tilt, slope, 1.0])
        axes = np.stack([x / np.linalg.norm(x) for x in (first, np.cross(normal, first))])
        told, airy = (points, self._unbent(points), side), (gas, self._unbent(gas))
        return replace(self, bend=bend_to(self.hilum, axes, told, airy))

    def _unbent(self, points: Array) -> Array:
        slope, tilt, offset, bow_x, bow_y, twist = self.shape
        x, y, z = (points - self.hilum).T
        u, v = x / SCALE_MM, y / SCALE_MM
        bulge = bow_x * (u**2 - 0.5) + bow_y * (v**2 - 0.5) + twist * u * v
        return np.asarray((z + slope * y + tilt * x + offset + bulge) / np.sqrt(1 + slope**2 + tilt**2))


COVERED_MM = 30.0
"""How far half of a piece may lie from its own keypoints: farther off nothing tells where it went, and held-out
keypoints, which lie near others, do not notice."""


@dataclass(frozen=True)
class Fissure:
    """A sheet along which the lung may have parted. cost_share: cost of two smooth maps of the keypoints' motion over
    that of one; gas: how many points of gas came into the lung; gas_share: of them, those that lie beside the sheet;
    border: of how many points of the gas's border it is known where they came from; bare_mm: how far half of the piece
    that is told less lies from keypoints of its own, not known (0) without two kinds of evidence.
    """

    sheet: Sheet
    cost_share: float
    gas: int
    gas_share: float
    border: int
    bare_mm: float = 0.0

    def unexplained(self, is_cut: bool) -> float:
        """Share of the gas's border that came from inside the lung and, if the lung is cut, not from the sheet."""
        return self.gas * (1 - self.gas_share * is_cut) / max(self.border, 1)

    @property
    def is_bare(self) -> bool:
        """Whether a piece is told too little to be cut off, though two kinds of evidence support that."""
        return self.bare_mm > COVERED_MM

    @property
    def most_misfit(self) -> float:
        """Of what one piece misses held-out keypoints by, what two have to come down to for a cut."""
        if self.gas_share < CLEAR_GAS_SHARE:
            return MUCH_BETTER
        return NOT_WORSE if self.cost_share <= MOST_COST else BETTER

    @property
    def evidence(self) -> tuple[str, ...]:
        """What says that the lung came apart along the sheet: "keypoints", "gas"."""
        enough = self.gas >= max(LEAST_GAS, LEAST_GAS_OF_BORDER * self.border)
        parted = enough and self.gas_share >= LEAST_GAS_SHARE
        most_cost = MOST_COST_BESIDE_GAS if parted else MOST_COST
        return (*(("keypoints",) if self.cost_share <= most_cost else ()), *(("gas",) if parted else ()))


@dataclass(frozen=True)
class Parted:
    """A lung in two pieces. fissure: where it was cut; pieces: its mesh in the CT."""

    fissure: Fissure
    pieces: Pieces

    def entry(self) -> dict[str, Any]:
        """The key "pieces" of run.json."""
        return {"n": 2, "fissures": [{"between": ["above", "below"], "evidence": list(self.fissure.evidence)}]}


def find_fissure(points: Array, motion: Array, gas: Array, hilum: Array, border: int) -> Fissure | None:
    """The sheet that best tells keypoints (n, 3) of the CT apart by their motion (n, 3) mm, and gas (k, 3), where it
    came from, from the rest of the lung. border: as in `Fissure`. None where there are too few keypoints on its sides.
    """
    scene = _Scene(points, motion, gas, hilum)
    one = _misfit(_terms(points - hilum), motion)
    tries = sorted((scene.cost((s, t, o, 0, 0, 0)), s, t, o) for s in SLOPES for t in TILTS for o in OFFSETS_MM)
    best, best_cost, seen = None, np.inf, np.zeros((0, 6))
    for cost, *plane in tries:
        start = np.array([*plane, 0.0, 0.0, 0.0])
        if not np.isfinite(cost) or len(seen) == STARTS:
            break
        if len(seen) and (np.abs(seen - start) / SPREAD).max(axis=1).min() < 0.5:
            continue
        seen = np.vstack([seen, start])
        simplex = start + np.vstack([np.zeros(6), np.diag(SPREAD / 4)])
        options = {"initial_simplex": simplex, "maxfev": 250, "xatol": 0.01, "fatol": 0.05}
        found = minimize(scene.penalized, start, method="Nelder-Mead", options=options)
        if found.fun < best_cost:
            best, best_cost = found.x, found.fun
    if best is None:
        return None
    sheet = Sheet(hilum, best)
    beside = np.abs(sheet.distance(gas)) < BESIDE_MM
    share = float(beside.mean()) if len(gas) else 0.0
    return Fissure(sheet, scene.motion_cost(best) / max(one, 1e-9), len(gas), share, border)


@dataclass(frozen=True)
class _Scene:
    points: Array
    motion: Array
    gas: Array
    hilum: Array

    def cost(self, shape: tuple[float, ...] | Array) -> float:
        """Misfit of two maps, and how far gas lies from the sheet; inf where a side has too few keypoints."""
        far = Sheet(self.hilum, np.asarray(shape)).distance(self.gas)
        return self.motion_cost(shape) + GAS_WEIGHT * float(np.log1p((far / GAS_MM) ** 2).sum())

    def penalized(self, shape: Array) -> float:
        """The cost, and what is unusual in a sheet's shape."""
        return self.cost(shape) + float((((shape - USUAL) / SPREAD) ** 2).sum())

    def motion_cost(self, shape: tuple[float, ...] | Array) -> float:
        """Misfit of two smooth maps, one on either side; inf where a side has too few keypoints."""
        above = Sheet(self.hilum, np.asarray(shape)).distance(self.points) > 0
        if min(above.sum(), (~above).sum()) < LEAST_KEYPOINTS:
            return np.inf
        return sum(_misfit(self._terms[side], self.motion[side]) for side in (above, ~above))

    @cached_property
    def _terms(self) -> Array:
        return _terms(self.points - self.hilum)


def _terms(points: Array) -> Array:
    """1, the coordinates and their products, (n, 10)."""
    return np.stack(monomials((points / SCALE_MM).T, 2), axis=1)


def smooth_map(points: Array, motion: Array, degree: int = 2) -> Array:
    """Coefficients (4 or 10, 3) of the affine or quadratic map that motion (n, 3) at points (n, 3) follows, outliers
    losing influence.
    """
    return _fitted(_terms(points)[:, : 4 if degree == 1 else 10], motion, 8)[0]


def mapped(coefficients: Array, points: Array) -> Array:
    """Motion (n, 3) mm of points (n, 3) under `smooth_map`."""
    return np.asarray(_terms(points)[:, : len(coefficients)] @ coefficients)


def _misfit(terms: Array, motion: Array) -> float:
    return float(np.log1p((_fitted(terms, motion, 3)[1] / MOTION_MM) ** 2).sum())


def _fitted(terms: Array, motion: Array, rounds: int) -> tuple[Array, Array]:
    """Coefficients and misfits (n,) mm of a robust fit, products held back a little."""
    weight, ridge = np.ones(len(terms)), np.diag(_RIDGE[: terms.shape[1]])
    for _ in range(rounds):
        weighted = terms.T * weight
        coefficients = np.linalg.solve(weighted @ terms + ridge, weighted @ motion)
        off = motion - terms @ coefficients
        squared = np.einsum("nd,nd->n", off, off)
        weight = 1 / (1 + squared / MOTION_MM**2)
    return coefficients, np.sqrt(squared)
