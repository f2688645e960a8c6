"""A run's check of itself: the CT, warped by the result, compared with the scan that it should look like.

The comparison uses nothing that led to the result (registration/verification.py), so a fault anywhere between the first
registration and the last shows here: as a shift or rotation of the whole, as a part that is off, or as a lung in which
no keypoint is recognized.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from poro.mesh import TetMesh
from registration.images.morphology import dilate, erode
from registration.images.resample import coarsen, resample, resample_mask
from registration.verification import LeftOver, left_over
from registration.volume import Array, Mask, Volume
from vatsloc.frames import flip_points
from vatsloc.imaging.cbct import PreparedCbct
from vatsloc.maps import MeshMap, covered, sampled
from vatsloc.workflow.gates import Gate, at_least, at_most
from vatsloc.workflow.settings import GateSettings
from vatsloc.workflow.uncertainty import CHECK_REACH_MM

VOXEL_MM, MAP_MM = 2.0, 4.0
RIM_MM = 3.0
"""So far from the lung's border an image shows what lies beyond."""
MARGIN_MM = 40.0
CHECK = "check"


@dataclass(frozen=True)
class Checks:
    """What is left over of both parts of a result. phase1: CT to inflated CBCT, None without one; chain: CT to deflated
    CBCT.
    """

    phase1: LeftOver | None
    chain: LeftOver

    def entry(self, nodule_inf: Array, nodule_def: Array) -> dict[str, Any]:
        """The keys of run.json, vectors in LPS. nodule_inf, nodule_def: (3,) RAS mm."""
        phase1 = None if self.phase1 is None else _entry(self.phase1, nodule_inf)
        return {"phase1": phase1, "chain": _entry(self.chain, nodule_def)}


def compare(ct: Volume, scan: PreparedCbct, lung: Mask, scan_from_ct: MeshMap) -> LeftOver:
    """What is left between a CT, carried by a map, and a cone-beam CT, inside the lung as it was segmented there.

    ct: as coarse as it will be compared, or finer.
    """
    inside = np.argwhere(lung.inside)
    if not len(inside):
        return LeftOver(np.zeros((0, 3)), np.zeros((0, 3)), 0)
    margin = MARGIN_MM / lung.grid.spacing
    box = lung.grid.box(inside.min(axis=0) - margin, inside.max(axis=0) + 1 + margin).with_spacing(VOXEL_MM)
    seen = resample_mask(scan.field.usable, box).inside
    here = resample_mask(lung, box).inside & seen
    there = covered(TetMesh(scan_from_ct.moved, scan_from_ct.mesh.tets), box).inside
    back = sampled(scan_from_ct.inverse(), box.with_spacing(MAP_MM))
    region = Mask(erode(here, RIM_MM, box.spacing), box.ras_from_ijk)
    allowed = Mask(dilate(there, RIM_MM, box.spacing), box.ras_from_ijk)
    return left_over(resample(coarsen(scan.volume, VOXEL_MM), box), resample(ct, box, back), region, allowed)


def check_gates(checks: Checks, limits: GateSettings) -> dict[str, Gate]:
    """Gates on what is left over, and on whether enough is recognized to say so."""
    gates = {}
    for suffix, left in (("_phase1", checks.phase1), ("", checks.chain)):
        if left is None:
            continue
        scan = "inflated" if suffix else "deflated"
        gates[f"check{suffix}"] = at_most(
            worst_mm(left),
            limits.max_left_over_mm,
            f"Independent keypoints show the CT's structures elsewhere in the {scan} CBCT than the result says.",
        )
        gates[f"recognized{suffix}"] = at_least(
            left.recognized_share,
            limits.min_recognized,
            f"Too little of the {scan} CBCT's lung looks like the CT carried there.",
        )
    return gates


def worst_mm(left: LeftOver) -> float:
    """What is left at 95 % of the keypoints at most, each smoothed with those about it; NaN where there are none."""
    around = np.linalg.norm(left.near(left.points, CHECK_REACH_MM), axis=1)
    known = around[np.isfinite(around)]
    return float(np.percentile(known, 95)) if len(known) else float("nan")


def _entry(left: LeftOver, nodule: Array) -> dict[str, Any]:
    lengths = np.linalg.norm(left.vectors, axis=1)
    here = left.near(nodule, CHECK_REACH_MM)[0]
    return {
        "looked_for": left.looked_for,
        "recognized": len(left.points),
        "shift_lps_mm": flip_points(left.shift),
        "turn_degrees": left.turn_degrees,
        "median_mm": float(np.median(lengths)) if len(lengths) else float("nan"),
        "worst_mm": worst_mm(left),
        "at_nodule_lps_mm": flip_points(here),
        "at_nodule_mm": float(np.linalg.norm(here)),
    }
