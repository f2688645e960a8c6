"""Target registration errors of one case: the maps of a run applied to its landmarks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from registration.volume import Array
from vatsloc.evaluation.landmarks import LandmarkTriples
from vatsloc.evaluation.statistics import distances

PointMap = Callable[[Array], Array]

# Each measure: what is mapped, where the truth is. Order and names as in tre.json.
MEASURES = ("rigid_ct_inflated", "phase1", "rigid_ct_deflated", "rigid_inflated_deflated", "phase2", "chain")

# The rigid pose is what each phase starts from, so it is that phase's "before".
BEFORE = {"phase1": "rigid_ct_inflated", "phase2": "rigid_inflated_deflated", "chain": "rigid_ct_deflated"}


@dataclass(frozen=True)
class RunMaps:
    """Where one run sends points, RAS mm to RAS mm. Each map takes (n, 3) and gives NaN where it is not defined."""

    rigid_inf_from_ct: PointMap
    rigid_def_from_ct: PointMap
    rigid_def_from_inf: PointMap
    inf_from_ct: PointMap
    def_from_inf: PointMap
    def_from_ct: PointMap


@dataclass(frozen=True)
class Errors:
    """Predictions and errors, one row per landmark.

    inflated, deflated: predicted from the CT, (n, 3) RAS mm; deflated_from_inflated: predicted from the true inflated
    landmark, as Alvarez 2021 scores phase 2 (section 8.3). mm: measure -> (n,) errors, NaN where a truth is missing.
    """

    inflated: Array
    deflated: Array
    deflated_from_inflated: Array
    mm: dict[str, Array]


def target_registration_errors(landmarks: LandmarkTriples, maps: RunMaps) -> Errors:
    """Distance between mapped and true landmarks, before and after each phase. Ref: Alvarez 2021, sections 8.1-8.3."""
    ct, inf, deflated = landmarks.ct, landmarks.inflated, landmarks.deflated
    inf_predicted = _where_known(maps.inf_from_ct, ct)
    def_predicted = _where_known(maps.def_from_ct, ct)
    def_from_true_inf = _where_known(maps.def_from_inf, inf)
    return Errors(
        inf_predicted,
        def_predicted,
        def_from_true_inf,
        {
            "rigid_ct_inflated": distances(_where_known(maps.rigid_inf_from_ct, ct), inf),
            "phase1": distances(inf_predicted, inf),
            "rigid_ct_deflated": distances(_where_known(maps.rigid_def_from_ct, ct), deflated),
            "rigid_inflated_deflated": distances(_where_known(maps.rigid_def_from_inf, inf), deflated),
            "phase2": distances(def_from_true_inf, deflated),
            "chain": distances(def_predicted, deflated),
        },
    )


def _where_known(map_: PointMap, points: Array) -> Array:
    known = np.isfinite(points).all(axis=1)
    mapped = np.full(points.shape, np.nan)
    if known.any():
        mapped[known] = map_(points[known])
    return mapped
