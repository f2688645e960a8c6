"""Groups of correspondences that follow one another by their local affine motions.

A wrong match seldom finds others that expect it where it is, and wrong ones that do are few; a lung's part that moved
as one gives hundreds. So what is looked for widely can be told apart afterwards, without a bound on the motion.
Ref: Ma 2014 (motion coherence of matches); Batagelj & Zaversnik 2003 (cores of graphs).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from registration.correspondences import Correspondences
from registration.keypoints.propagation import local_affines
from registration.volume import Array

ROUNDS = 3
"""Local motions are estimated anew from what is left."""


@dataclass(frozen=True)
class GroupSettings:
    """reach_mm: how far apart two matches may lie that are compared; agree_mm: how far off either may expect the other;
    least: with how many others each has to agree; neighbours: that tell the local affine motion; least_group,
    least_share: matches of a group, and of the largest one's.
    """

    reach_mm: float = 12.0
    agree_mm: float = 2.5
    least: int = 3
    neighbours: int = 12
    least_group: int = 20
    least_share: float = 0.1


def in_groups(matches: Correspondences, settings: GroupSettings) -> Array:
    """Numbers (k,) of the matches that belong to large groups."""
    kept = np.arange(len(matches))
    for _ in range(ROUNDS):
        if len(kept) <= settings.neighbours:
            return kept[:0]
        kept = kept[_grouped(matches.only(kept), settings)]
    return kept


def _grouped(matches: Correspondences, settings: GroupSettings) -> Array:
    """Which of the matches (n,) belong to large groups."""
    n, pairs = len(matches), _agreeing(matches, settings)
    alive = np.ones(n, bool)
    while True:
        pairs = pairs[alive[pairs].all(axis=1)]
        stay = alive & (np.bincount(pairs.ravel(), minlength=n) >= settings.least)
        if (stay == alive).all():
            break
        alive = stay
    first, second = pairs.T
    number = connected_components(coo_array((np.ones(len(pairs)), (first, second)), shape=(n, n)), directed=False)[1]
    size = np.bincount(number)
    is_large = size >= max(settings.least_group, settings.least_share * size.max())
    return np.asarray(alive & is_large[number])


def _agreeing(matches: Correspondences, settings: GroupSettings) -> Array:
    """Pairs (k, 2) of matches next to each other, each of which expects the other where it was found."""
    affines = local_affines(matches, settings.neighbours)
    pairs = cKDTree(matches.fixed).query_pairs(settings.reach_mm, output_type="ndarray")
    first, second = pairs.T
    there, here = matches.moving[second] - matches.moving[first], matches.fixed[second] - matches.fixed[first]
    off = [np.linalg.norm(there - np.einsum("nij,nj->ni", affines[one], here), axis=1) for one in (first, second)]
    return np.asarray(pairs[np.maximum(*off) < settings.agree_mm])
