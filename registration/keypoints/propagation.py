"""Matched points that spread from where they were found: each tells, by the stretch and turn about it, where its
neighbours lie and how their blocks look there.

Where a first guess of the motion is farther off than blocks are looked for, or turned too far for them to correlate,
the places next to it that were found know better. Ref: Lhuillier & Quan 2002; Furukawa & Ponce 2010 (spreading of
matches); Heinrich 2015 (lungs).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from registration.images.resample import resample, resample_mask
from registration.keypoints.affine_matching import Inside, find_turned
from registration.keypoints.matching import MatchSettings, Pairs, distinctive_places, smoothed
from registration.volume import Array, Grid, Mask, Volume

ROUNDS = 12
KNOWN_MM = 3.0
"""A place this near to one that was found is the same place."""


@dataclass(frozen=True)
class GrowSettings:
    """match: blocks and what they have to fulfil, its reach and strays left out; reach_mm: how far from its guess a
    place is looked for; step_mm: how far a place may lie from one that guesses for it; guides: how many guess;
    apart_mm: guesses nearer than this are one; neighbours: that tell a place's stretch and turn; voices, agree_mm: of
    the nearest `electors` places found, how many have to guess a new one within that distance.
    """

    match: MatchSettings
    reach_mm: float = 8.0
    step_mm: float = 25.0
    guides: int = 5
    apart_mm: float = 3.0
    neighbours: int = 12
    electors: int = 8
    voices: int = 2
    agree_mm: float = 5.0


@dataclass(frozen=True)
class _Guesses:
    """place, guide: (n,) numbers; first: (n, 3) mm, where the guide expects the place."""

    place: Array
    guide: Array
    first: Array


def grow(
    first: Volume, second: Volume, first_region: Mask, region: Mask, pairs: Pairs, settings: GrowSettings
) -> Pairs:
    """Pairs, and the distinctive places of `second` inside `region` that were found in `first_region` of `first` next
    to them, and next to those.

    Only what lies in the regions is compared. The pairs given come first and stay as they are; fewer of them than
    `neighbours` tell no stretch, and nothing grows.
    """
    match, grid = settings.match, second.grid.with_spacing(settings.match.voxel_mm)
    here, inside = smoothed(resample(second, grid)), resample_mask(region, grid).inside
    there = Inside(smoothed(first).hu, resample_mask(first_region, first.grid).inside)
    if len(pairs) <= settings.neighbours or not inside.any():
        return pairs
    starts = distinctive_places(_filled(here, inside), inside, match)
    places = grid.to_ras(starts.astype(float))
    is_open = cKDTree(pairs.second).query(places)[0] > KNOWN_MM
    tried = np.zeros(0, np.int64)
    for _ in range(ROUNDS):
        maps = local_maps(pairs, settings.neighbours)
        guesses, tried = _guesses(places, is_open, pairs, maps, tried, settings)
        if not len(guesses.place):
            break
        carry = maps[guesses.guide] @ grid.ras_from_ijk[:3, :3]
        found = find_turned(
            Inside(here.hu, inside),
            there,
            starts[guesses.place],
            _in_voxels(first.grid, carry, guesses.first),
            match.radius,
            round(settings.reach_mm / match.voxel_mm),
        )
        holds = (found.ncc >= match.least_ncc) & (found.stray * grid.spacing.max() <= match.round_trip_mm)
        at = guesses.first + np.einsum("nij,nj->ni", carry, found.shift)
        best = _best_of_each(guesses.place, np.where(holds, found.ncc, -1))
        number = guesses.place[best]
        new = Pairs(at[best], places[number], found.ncc[best])
        agreed = seconded(new, pairs, maps, settings)
        is_open[number[agreed]] = False
        if not agreed.any():
            break
        pairs = _joined(pairs, new.only(agreed))
    return pairs


def local_maps(pairs: Pairs, neighbours: int, scale_mm: float = 3.0, ridge_mm: float = 6.0) -> Array:
    """Gradients (n, 3, 3) of `first` by `second` at every pair, from its nearest neighbours.

    Those that move otherwise, as across a fissure, lose influence (Cauchy, `scale_mm`); where neighbours tell little,
    all pairs' common gradient counts, as a neighbour `ridge_mm` away along every axis would.
    """
    near = cKDTree(pairs.second).query(pairs.second, neighbours + 1)[1][:, 1:]
    x, y = (points[near] - points[:, None] for points in (pairs.second, pairs.first))
    all_x, all_y = (points - points.mean(axis=0) for points in (pairs.second, pairs.first))
    common = np.linalg.lstsq(all_x, all_y, rcond=None)[0].T
    maps = np.broadcast_to(common, (len(near), 3, 3))
    for _ in range(5):
        left = np.linalg.norm(y - np.einsum("nij,nkj->nki", maps, x), axis=2)
        weight = 1 / (1 + (left / scale_mm) ** 2)
        xx = np.einsum("nk,nki,nkj->nij", weight, x, x) + ridge_mm**2 * np.eye(3)
        xy = np.einsum("nk,nki,nkj->nij", weight, x, y) + ridge_mm**2 * common.T
        maps = np.linalg.solve(xx, xy).transpose(0, 2, 1)
    return maps


def seconded(new: Pairs, pairs: Pairs, maps: Array, settings: GrowSettings) -> Array:
    """Which new pairs (n,) enough of the nearest known ones expect about where they were found."""
    count = min(settings.electors, len(pairs))
    near = cKDTree(pairs.second).query(new.second, count)[1].reshape(len(new), count)
    guess = pairs.first[near] + np.einsum("nkij,nkj->nki", maps[near], new.second[:, None] - pairs.second[near])
    off = np.linalg.norm(guess - new.first[:, None], axis=2)
    return np.asarray((off < settings.agree_mm).sum(axis=1) >= settings.voices)


def _guesses(
    places: Array, is_open: Array, pairs: Pairs, maps: Array, tried: Array, settings: GrowSettings
) -> tuple[_Guesses, Array]:
    """What the nearest pairs say of the places (n, 3) that are open and that they have not spoken on, and everything
    tried so far, as numbers of place and pair in one.
    """
    number = np.flatnonzero(is_open)
    count = min(settings.guides, len(pairs))
    far, guide = (a.reshape(len(number), count) for a in cKDTree(pairs.second).query(places[number], count))
    offset = places[number, None] - pairs.second[guide]
    first = pairs.first[guide] + np.einsum("nkij,nkj->nki", maps[guide], offset)
    apart = np.linalg.norm(first[:, :, None] - first[:, None], axis=3)
    said = np.tril(apart < settings.apart_mm, -1).any(axis=2)
    key = number[:, None] * np.int64(1 << 32) + guide
    speaks = (far < settings.step_mm) & ~said & ~np.isin(key, tried)
    place = np.broadcast_to(number[:, None], speaks.shape)
    return _Guesses(place[speaks], guide[speaks], first[speaks]), np.concatenate([tried, key[speaks]])


def _in_voxels(grid: Grid, carry: Array, first: Array) -> Array:
    """Maps (n, 3, 4) to voxels of a grid, of gradients (n, 3, 3) in mm per voxel about points (n, 3)."""
    return np.concatenate([grid.ijk_from_ras[:3, :3] @ carry, grid.to_ijk(first)[:, :, None]], axis=2)


def _best_of_each(place: Array, score: Array) -> Array:
    """Where in (n,) the highest positive score of every place stands."""
    order = np.argsort(-score, kind="stable")
    best = order[np.unique(place[order], return_index=True)[1]]
    return np.asarray(best[score[best] > 0])


def _joined(one: Pairs, other: Pairs) -> Pairs:
    return Pairs(*(np.concatenate(both) for both in zip(_parts(one), _parts(other), strict=True)))


def _parts(pairs: Pairs) -> tuple[Array, Array, Array]:
    return pairs.first, pairs.second, pairs.ncc


def _filled(image: Volume, inside: Array) -> Volume:
    """What lies outside takes the value of the nearest voxel inside, so that the border is no edge."""
    nearest = ndimage.distance_transform_edt(~inside, return_distances=False, return_indices=True)
    return smoothed(Volume(image.hu[tuple(nearest)], image.ras_from_ijk))
