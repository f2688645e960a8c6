"""Frictionless contact between the lobes of a lung, each of which moves by a spline of its own.

A point of one lobe's surface is taken back through the other lobe's map; how deep it then lies in that lobe's region of
the CT is what is pushed apart. The push acts on both lobes, so momentum is kept.
Ref: Wriggers 2006, ch. 6 (penalty, two passes).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from phantoms.fields import Lattice
from phantoms.lobes import FACING_MM, Lobes, surface_points
from phantoms.spline import SplineMap, cofactors, determinant

Array = NDArray[Any]
NEAR_MM = 30.0
"""Surfaces further apart than this in the CT are not looked at for contact."""
REACH_MM = 8.0
FOUND_MM, LOST_MM = 1e-7, 1e-3
CONTACT_KPA_MM = 2.0
TIE_KPA_MM = 2.0


@dataclass
class Side:
    """Points of one lobe's surface against another lobe. place: (n, 3) mm in the CT, where the other lobe's tissue is
    that was last found at each point; own, other: lobes; stiffness: (n,) kPa mm; both_ways: (n,) whether the point is
    also held, as by a film of fluid."""

    points: Array
    place: Array
    own: int
    other: int
    stiffness: Array
    both_ways: Array


@dataclass(frozen=True)
class Joint:
    """How the lobes of a lung meet. sides: pairs of surfaces that may touch; grown: ties where they are one."""

    sides: list[Side]
    grown: list[Side]


def make_joint(lobes: Lobes, held: bool) -> Joint:
    """The joint of a lung's lobes; held: whether a film of fluid keeps facing surfaces together."""
    sides, grown = [], []
    for own, region in enumerate(lobes.regions):
        points, area = surface_points(region, 2) if len(lobes.regions) > 1 else (np.zeros((0, 3)), np.zeros(0))
        gaps = [r.sample(points) if n != own else np.full(len(points), np.inf) for n, r in enumerate(lobes.regions)]
        nearest = np.argmin(gaps, axis=0)
        one = lobes.fissures.grown(points)
        for other, gap in enumerate(gaps):
            facing = (nearest == other) & (gap < FACING_MM)
            touch = (facing if held else gap < NEAR_MM) & ~one
            tie = facing & one
            if touch.any():
                sides.append(_side(points[touch], own, other, CONTACT_KPA_MM * area[touch], facing[touch] & held))
            if tie.any():
                grown.append(_side(points[tie], own, other, TIE_KPA_MM * area[tie], facing[tie]))
    return Joint(sides, grown)


def _side(points: Array, own: int, other: int, stiffness: Array, both_ways: Array) -> Side:
    return Side(points, points.copy(), own, other, stiffness, both_ways)


def contact_energy(
    sides: list[Side], maps: list[SplineMap], regions: tuple[Lattice, ...]
) -> tuple[float, list[Array], list[tuple[Side, Array]]]:
    """Energy (kPa mm3) of points inside other lobes; its gradient on the coefficients (nx, ny, nz, 3) of each lobe's
    map; and how deep, (n,) mm in the CT, the points of each side lie in the other lobe, zero outside."""
    total, depths = 0.0, []
    gradients = [np.zeros_like(m.coefficients) for m in maps]
    for side in sides:
        own, other, region = maps[side.own], maps[side.other], regions[side.other]
        x = own(side.points)
        place, left = other.follow(x, side.place, FOUND_MM)
        phi, slope = region.with_gradient(place)
        good = (left < LOST_MM) & (np.abs(phi) < REACH_MM)
        side.place = np.where((left < LOST_MM)[:, None], place, side.points)
        depth = np.where(good & ((phi < 0) | side.both_ways), phi, 0.0)
        on = np.flatnonzero(depth)
        f = other.with_gradient(place[on])[1]
        inverse_t = cofactors(f) / determinant(f)[:, None, None]
        push = (side.stiffness[on] * depth[on])[:, None]
        force = push * np.einsum("nij,nj->ni", inverse_t, slope[on])
        total += 0.5 * float((push[:, 0] * depth[on]).sum())
        _scatter(gradients[side.own], own.origin, own.spacing, side.points[on], force)
        _scatter(gradients[side.other], other.origin, other.spacing, place[on], -force)
        depths.append((side, depth))
    return total, gradients, depths


@numba.njit(cache=True)
def _scatter(out, origin, h, points, force):
    """Add the forces (n, 3) at points (n, 3) to the coefficients that move them."""
    w = np.empty((3, 3))
    base = np.empty(3, dtype=np.int64)
    for n in range(len(points)):
        for m in range(3):
            s = (points[n, m] - origin[m]) / h
            i = min(max(int(np.floor(s + 0.5)), 1), out.shape[m] - 2)
            a = min(max(s - i, -0.5), 0.5)
            base[m] = i - 1
            w[m, 0], w[m, 1], w[m, 2] = 0.5 * (0.5 - a) ** 2, 0.75 - a * a, 0.5 * (0.5 + a) ** 2
        for p in range(3):
            for q in range(3):
                for r in range(3):
                    v = w[0, p] * w[1, q] * w[2, r]
                    for m in range(3):
                        out[base[0] + p, base[1] + q, base[2] + r, m] += v * force[n, m]
