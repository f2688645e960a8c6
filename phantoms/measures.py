"""How hard a case is: motion, what an affine map leaves of it, slip along the wall, volumes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from phantoms.imaging import State
from phantoms.tissue import Equilibrium

Array = NDArray[Any]


def measure(states: tuple[State, State], marks: Array, dense: Array, ends: list[Equilibrium]) -> dict[str, Any]:
    """Numbers of a case in mm and ratios. marks, dense: (n, 3) landmarks and lung tissue in the CT.

    The spine stays where it is, so motion in the frame of the CT is the error of a perfect rigid registration of it.
    """
    inflated, deflated = (s.lung_map for s in states)
    return {
        "n_landmarks": len(marks),
        "pose_mm": _sizes(inflated(marks) - marks),
        "pneumothorax_mm": _sizes(deflated(marks) - inflated(marks)),
        "total_mm": _sizes(deflated(marks) - marks),
        "affine_share": [affine_share(a, b) for a, b in _pairs(dense, inflated(dense), deflated(dense))],
        "wall_slip_mm": [_sizes(wall_slip(s)) for s in states],
        "volume_ratio": [float(m.determinant(dense).mean()) for m in (inflated, deflated)],
        "smallest_determinant": [float(m.determinant(states[0].samples).min()) for m in (inflated, deflated)],
        "dome_mm": [s.motion.operated_dome for s in states],
        "pose": [s.pose.tolist() for s in states],
        "equilibrium": [e.status.name for e in ends],
        "steps": [len(e.history) for e in ends],
    }


def affine_share(source: Array, target: Array) -> float:
    """Mean distance (n, 3) `target` keeps from the best affine map of (n, 3) `source`, over the mean motion."""
    rows = np.c_[source, np.ones(len(source))]
    fit = rows @ np.linalg.lstsq(rows, target, rcond=None)[0]
    return float(np.linalg.norm(fit - target, axis=1).mean() / np.linalg.norm(target - source, axis=1).mean())


def wall_slip(state: State) -> Array:
    """Tangential jump (n, 3) mm between lung and wall where the lung, in the CT, faced the ribs or the diaphragm."""
    points = state.lung.points()
    skin = points[np.abs(state.lung.values.ravel()) < 0.5 * state.lung.spacing]
    _, normal = state.lung.with_gradient(skin)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    jump = state.lung_map(skin) - state.motion(skin)
    side = np.sign(skin[:, 0].mean())
    outer = (side * normal[:, 0] > -0.3) & (np.abs(skin[:, 0]) > 40)
    along = jump - (jump * normal).sum(axis=1, keepdims=True) * normal
    return np.asarray(along[outer])


def _pairs(ct: Array, inflated: Array, deflated: Array) -> list[tuple[Array, Array]]:
    return [(ct, inflated), (inflated, deflated), (ct, deflated)]


def _sizes(vectors: Array) -> list[float]:
    """Mean, 95 % and greatest length (mm) of vectors (n, 3)."""
    size = np.linalg.norm(vectors, axis=1)
    return [float(size.mean()), float(np.percentile(size, 95)), float(size.max())]
