"""Quasi-dense match propagation: every correspondence proposes, by the local affine motion about it, where keypoints
next to it lie in the other image and how their blocks look there.

Where a first guess of the motion is farther off than blocks are looked for, or turned too far for them to correlate,
the matches next to a keypoint know better. Ref: Lhuillier & Quan 2002; Furukawa & Ponce 2010; Heinrich 2015 (lungs).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from registration.correspondences import Correspondences
from registration.images.resample import resample, resample_mask
from registration.keypoints.affine_matching import MaskedImage, match_affine_blocks
from registration.keypoints.matching import MatchSettings, detect_inside, smoothed
from registration.volume import Array, Grid, Mask, Volume

ROUNDS = 12
SAME_MM = 3.0
"""A keypoint this near to one that was matched is the same keypoint."""


@dataclass(frozen=True)
class PropagationSettings:
    """match: blocks and what they have to fulfil, its reach and outliers left out; reach_mm: how far from where it was
    proposed a keypoint is looked for; step_mm: how far a match may lie from a keypoint it makes a proposal for;
    proposals: how many a keypoint gets; apart_mm: proposals nearer than this are one; neighbours: that tell the local
    affine motion; votes, agree_mm: of the nearest `voters` matches, how many have to expect a new one within that
    distance.
    """

    match: MatchSettings
    reach_mm: float = 8.0
    step_mm: float = 25.0
    proposals: int = 5
    apart_mm: float = 3.0
    neighbours: int = 12
    voters: int = 8
    votes: int = 2
    agree_mm: float = 5.0


@dataclass(frozen=True)
class _Proposals:
    """keypoint, match: (n,) numbers; moving: (n, 3) mm, where the match expects the keypoint."""

    keypoint: Array
    match: Array
    moving: Array


def propagate_matches(
    fixed: Volume,
    moving: Volume,
    fixed_region: Mask,
    moving_region: Mask,
    seeds: Correspondences,
    settings: PropagationSettings,
) -> Correspondences:
    """The seeds, and the keypoints of `fixed` that were found in `moving` next to them, and next to those.

    Only what lies in the regions is compared. The seeds come first and stay as they are; fewer of them than
    `neighbours` tell no affine motion, and nothing is added.
    """
    match, grid = settings.match, fixed.grid.with_spacing(settings.match.voxel_mm)
    here, inside = smoothed(resample(fixed, grid), match), resample_mask(fixed_region, grid).inside
    there = MaskedImage(smoothed(moving, match).hu, resample_mask(moving_region, moving.grid).inside)
    matches = seeds
    if len(matches) <= settings.neighbours or not inside.any():
        return matches
    starts = detect_inside(here, inside, match)
    keypoints = grid.to_ras(starts.astype(float))
    is_open = cKDTree(matches.fixed).query(keypoints)[0] > SAME_MM
    tried = np.zeros(0, np.int64)
    for _ in range(ROUNDS):
        affines = local_affines(matches, settings.neighbours)
        proposals, tried = _proposals(keypoints, is_open, matches, affines, tried, settings)
        if not len(proposals.keypoint):
            break
        moving_from_voxel = affines[proposals.match] @ grid.ras_from_ijk[:3, :3]
        found = match_affine_blocks(
            MaskedImage(here.hu, inside),
            there,
            starts[proposals.keypoint],
            _in_voxels(moving.grid, moving_from_voxel, proposals.moving),
            round(settings.reach_mm / match.voxel_mm),
        )
        holds = (found.ncc >= match.least_ncc) & (found.round_trip * grid.spacing.max() <= match.round_trip_mm)
        at = proposals.moving + np.einsum("nij,nj->ni", moving_from_voxel, found.shift)
        best = _best_of_each(proposals.keypoint, np.where(holds, found.ncc, -1))
        number = proposals.keypoint[best]
        new = Correspondences.of(keypoints[number], at[best], found.ncc[best])
        agreed = has_consensus(new, matches, affines, settings)
        is_open[number[agreed]] = False
        if not agreed.any():
            break
        matches = matches.joined(new.only(agreed))
    return matches


def local_affines(matches: Correspondences, neighbours: int, scale_mm: float = 3.0, ridge_mm: float = 6.0) -> Array:
    """Gradients (n, 3, 3) of the motion from fixed to moving at every match, from its nearest neighbours.

    Those that move otherwise, as across a fissure, lose influence (Cauchy, `scale_mm`); where neighbours tell little,
    all matches' common gradient counts, as a neighbour `ridge_mm` away along every axis would.
    """
    near = cKDTree(matches.fixed).query(matches.fixed, neighbours + 1)[1][:, 1:]
    x, y = (points[near] - points[:, None] for points in (matches.fixed, matches.moving))
    all_x, all_y = (points - points.mean(axis=0) for points in (matches.fixed, matches.moving))
    common = np.linalg.lstsq(all_x, all_y, rcond=None)[0].T
    affines = np.broadcast_to(common, (len(near), 3, 3))
    for _ in range(5):
        left = np.linalg.norm(y - np.einsum("nij,nkj->nki", affines, x), axis=2)
        weight = 1 / (1 + (left / scale_mm) ** 2)
        xx = np.einsum("nk,nki,nkj->nij", weight, x, x) + ridge_mm**2 * np.eye(3)
        xy = np.einsum("nk,nki,nkj->nij", weight, x, y) + ridge_mm**2 * common.T
        affines = np.linalg.solve(xx, xy).transpose(0, 2, 1)
    return affines


def has_consensus(
    new: Correspondences, matches: Correspondences, affines: Array, settings: PropagationSettings
) -> Array:
    """Which new matches (n,) enough of the nearest known ones expect about where they were found."""
    count = min(settings.voters, len(matches))
    near = cKDTree(matches.fixed).query(new.fixed, count)[1].reshape(len(new), count)
    offset = new.fixed[:, None] - matches.fixed[near]
    expected = matches.moving[near] + np.einsum("nkij,nkj->nki", affines[near], offset)
    off = np.linalg.norm(expected - new.moving[:, None], axis=2)
    return np.asarray((off < settings.agree_mm).sum(axis=1) >= settings.votes)


def _proposals(
    keypoints: Array,
    is_open: Array,
    matches: Correspondences,
    affines: Array,
    tried: Array,
    settings: PropagationSettings,
) -> tuple[_Proposals, Array]:
    """Where the nearest matches expect the keypoints (n, 3) that are open, what was tried before left out, and
    everything tried so far, as numbers of keypoint and match in one.
    """
    number = np.flatnonzero(is_open)
    count = min(settings.proposals, len(matches))
    far, match = (a.reshape(len(number), count) for a in cKDTree(matches.fixed).query(keypoints[number], count))
    offset = keypoints[number, None] - matches.fixed[match]
    moving = matches.moving[match] + np.einsum("nkij,nkj->nki", affines[match], offset)
    apart = np.linalg.norm(moving[:, :, None] - moving[:, None], axis=3)
    is_repeated = np.tril(apart < settings.apart_mm, -1).any(axis=2)
    key = number[:, None] * np.int64(1 << 32) + match
    is_new = (far < settings.step_mm) & ~is_repeated & ~np.isin(key, tried)
    keypoint = np.broadcast_to(number[:, None], is_new.shape)
    return _Proposals(keypoint[is_new], match[is_new], moving[is_new]), np.concatenate([tried, key[is_new]])


def _in_voxels(grid: Grid, gradients: Array, points: Array) -> Array:
    """Affine maps (n, 3, 4) to voxels of a grid, of gradients (n, 3, 3) in mm per voxel about points (n, 3)."""
    return np.concatenate([grid.ijk_from_ras[:3, :3] @ gradients, grid.to_ijk(points)[:, :, None]], axis=2)


def _best_of_each(keypoint: Array, score: Array) -> Array:
    """Where in (n,) the highest positive score of every keypoint stands."""
    order = np.argsort(-score, kind="stable")
    best = order[np.unique(keypoint[order], return_index=True)[1]]
    return np.asarray(best[score[best] > 0])
