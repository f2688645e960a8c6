"""Where a run sees that the lung has parted: its keypoints and the gas about the collapsed lung, carried to the CT."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from poro.mesh import interpolate, locate
from poro.mesh.closest import depth_below
from registration.correspondences import Correspondences
from registration.volume import Array
from vatsloc.imaging.surface import Border
from vatsloc.workflow.fissures import LEAST_DEEP_MM, Fissure, Sheet, find_fissure, mapped, smooth_map
from vatsloc.workflow.observe import Observed
from vatsloc.workflow.pose import ChangeOfPose

PIECES = "pieces"
GAS_REACH_MM = 20.0
"""How far a keypoint may lie that tells where gas came from."""
NEIGHBOURS = 4
CLEAR_MM = 4.0
"""A keypoint's side is clear where one side's map is nearer to its motion than this, and the other farther off by more
than this again."""
LEAST_CLEAR = 20
"""On either side, that a sheet is bent by."""
ROUNDS = 3


@dataclass(frozen=True)
class _Seen:
    """What a sheet is found from. found: keypoints; points: (n, 3) RAS mm, where they lie in the CT; hilum: (3,) there;
    air: (k, 3), the border of gas in the deflated CBCT.
    """

    pose: ChangeOfPose
    observed: Observed
    found: Correspondences
    points: Array
    hilum: Array
    air: Array

    @property
    def moving(self) -> Array:
        return self.found.moving

    @property
    def fixed(self) -> Array:
        return self.found.fixed

    @property
    def motion(self) -> Array:
        return self.fixed - self.moving

    def in_ct(self, points: Array) -> Array:
        """Where points (q, 3) mm of the lung before its collapse lie in the CT."""
        return _in_ct(self.pose, self.observed, points)

    def deep(self, in_ct: Array) -> Array:
        """Points (q, 3) mm of the CT that lie deep below the pleura."""
        return in_ct[depth_below(self.pose.mesh_ct.boundary, in_ct) > LEAST_DEEP_MM]


def seen_fissure(pose: ChangeOfPose, observed: Observed, keypoints: Correspondences) -> Fissure | None:
    """The sheet along which keypoints and gas say that the lung parted, with what each of them says; bent to them where
    both say so.
    """
    seen = _seen(pose, observed, keypoints)
    far, near = cKDTree(seen.fixed).query(seen.air, NEIGHBOURS)
    known = far[:, 0] < GAS_REACH_MM
    gas = seen.in_ct(seen.air[known] - seen.motion[near[known]].mean(axis=1))
    found = find_fissure(seen.points, seen.motion, seen.deep(gas), seen.hilum, len(gas))
    if found is None or len(found.evidence) < 2:
        return found
    sheet = _bent(found.sheet, seen)
    return replace(found, sheet=sheet, bare_mm=_bare_mm(sheet, seen))


def _seen(pose: ChangeOfPose, observed: Observed, keypoints: Correspondences) -> _Seen:
    points, hilum = (_in_ct(pose, observed, x) for x in (keypoints.moving, observed.hilum.point_ras[None]))
    air = observed.surface.only(Border.AIR, Border.FISSURE).points
    return _Seen(pose, observed, keypoints, points, hilum[0], air)


def _in_ct(pose: ChangeOfPose, observed: Observed, points: Array) -> Array:
    return interpolate(locate(observed.mesh_before, points), pose.mesh_ct.points)


def _bent(sheet: Sheet, seen: _Seen) -> Sheet:
    """The sheet bent to keypoints that clearly move with one side, and to where gas on either side came from."""
    out = sheet
    for _ in range(ROUNDS):
        clear, side = _sides(out, seen)
        if min((clear & (side == number)).sum() for number in (1, -1)) < LEAST_CLEAR:
            return out
        gas = [seen.deep(seen.in_ct(_came_from(seen, clear, side, number))) for number in (1, -1)]
        out = sheet.bent(seen.points[clear], side[clear], np.concatenate(gas))
    return out


def _bare_mm(sheet: Sheet, seen: _Seen) -> float:
    """How far half of the CT's lung on one side lies from that side's keypoints, mm: the larger of both, inf where a
    side holds no lung or no keypoint.
    """
    nodes = seen.pose.mesh_ct.points
    above, of_keypoint = sheet.distance(nodes) > 0, sheet.distance(seen.points) > 0
    pairs = ((nodes[above == side], seen.points[of_keypoint == side]) for side in (True, False))
    return max(
        float(np.median(cKDTree(told).query(piece)[0])) if len(piece) and len(told) else np.inf for piece, told in pairs
    )


def _sides(sheet: Sheet, seen: _Seen) -> tuple[Array, Array]:
    """Which keypoints (n,) clearly move with one side of a sheet, and with which (n,), +1 or -1; none where a side has
    too few to tell how it moved.
    """
    at = seen.points - seen.hilum
    above = sheet.distance(seen.points) > 0
    if min(above.sum(), (~above).sum()) < LEAST_CLEAR:
        return np.zeros(len(at), dtype=bool), np.where(above, 1, -1)
    upper, lower = (
        np.linalg.norm(mapped(smooth_map(at[mine], seen.motion[mine]), at) - seen.motion, axis=1)
        for mine in (above, ~above)
    )
    clear = (np.minimum(upper, lower) < CLEAR_MM) & (np.abs(upper - lower) > CLEAR_MM)
    return clear, np.where(upper < lower, 1, -1)


def _came_from(seen: _Seen, clear: Array, side: Array, number: int) -> Array:
    """Where gas that lies on one side's tissue came from, (q, 3) mm before the collapse: all clear keypoints about it
    are of that side, and a smooth map of theirs back, with what it leaves at the nearest, tells.
    """
    far, near = cKDTree(seen.fixed[clear]).query(seen.air, NEIGHBOURS)
    mine = (far[:, 0] < GAS_REACH_MM) & (side[clear][near] == number).all(axis=1)
    of_side, centre = clear & (side == number), seen.fixed.mean(axis=0)
    start, back = seen.fixed[of_side] - centre, -seen.motion[of_side]
    told = smooth_map(start, back)
    left, gas = back - mapped(told, start), seen.air[mine]
    nearest = cKDTree(seen.fixed[of_side]).query(gas, NEIGHBOURS)[1]
    return np.asarray(gas + mapped(told, gas - centre) + left[nearest].mean(axis=1))
