"""How hard a case is: motion, what an affine map leaves of it, slip along the wall, volumes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from phantoms.imaging import State
from phantoms.lobes import surface_points
from phantoms.tissue import Equilibrium

Array = NDArray[Any]


def measure(states: tuple[State, State], marks: Array, dense: Array, ends: list[Equilibrium]) -> dict[str, Any]:
    """Numbers of a case in mm and ratios. marks, dense: (n, 3) landmarks and lung tissue in the CT.

    The spine stays where it is, so motion in the frame of the CT is the error of a perfect rigid registration of it.
    """
    inflated, deflated = (s.lung_map for s in states)
    jumps = [fissure_jump(s) for s in states]
    return {
        "lobes": list(inflated.lobes.names),
        "n_landmarks": len(marks),
        "pose_mm": _sizes(inflated(marks) - marks),
        "pneumothorax_mm": _sizes(deflated(marks) - inflated(marks)),
        "total_mm": _sizes(deflated(marks) - marks),
        "affine_share": [affine_share(a, b) for a, b in _pairs(dense, inflated(dense), deflated(dense))],
        "wall_slip_mm": [_sizes(wall_slip(s)) for s in states],
        "fissure_slip_mm": [_sizes(slid) for slid, _ in jumps],
        "fissure_gap_mm": [float(np.percentile(parted, 95)) for _, parted in jumps],
        "lobe_overlap_mm": [float(np.percentile(lobe_overlap(s), 99)) for s in states],
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


def fissure_jump(state: State) -> tuple[Array, Array]:
    """Where lobes face each other in the CT and have not grown together: the jump of the map along the fissure, (n, 3)
    mm, and across it, (n,) mm, positive where they part. One point without a jump for one piece.

    Across is across the moved fissure at that point: where lobes slide far over a bent one it may be below zero without
    an overlap."""
    pieces, lobes = state.lung_map.pieces, state.lung_map.lobes
    slid, parted = [np.zeros((1, 3))], [np.zeros(1)]
    if len(pieces) > 1:
        points, _, own, other = lobes.facing()
        free = ~lobes.fissures.grown(points)
        slid, parted = [], []
        for a, b in {(int(a), int(b)) for a, b in zip(own, other, strict=True) if a < b}:
            x = points[free & (own == a) & (other == b)]
            here, f = pieces[a].with_gradient(x)
            normal = np.einsum("nji,nj->ni", np.linalg.inv(f), lobes.regions[a].with_gradient(x)[1])
            normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
            jump = pieces[b](x) - here
            away = (jump * normal).sum(axis=1)
            slid.append(jump - away[:, None] * normal)
            parted.append(away)
    return np.concatenate(slid), np.concatenate(parted)


def lobe_overlap(state: State) -> Array:
    """How deep, (n,) mm in the CT, points of the lobes' surfaces lie inside another lobe; zero where they do not."""
    pieces, lobes = state.lung_map.pieces, state.lung_map.lobes
    depths = [np.zeros(1)]
    for a, region in enumerate(lobes.regions):
        x = pieces[a](surface_points(region, 2)[0])
        for b, other in enumerate(lobes.regions):
            if a != b:
                samples = state.samples[other.sample(state.samples) < 6.0]
                found, left = pieces[b].inverse(x, samples)
                depths.append(np.where(left < 1e-3, np.maximum(-other.sample(found), 0), 0.0))
    return np.concatenate(depths)


def _pairs(ct: Array, inflated: Array, deflated: Array) -> list[tuple[Array, Array]]:
    return [(ct, inflated), (inflated, deflated), (ct, deflated)]


def _sizes(vectors: Array) -> list[float]:
    """Mean, 95 % and greatest length (mm) of vectors (n, 3)."""
    size = np.linalg.norm(vectors, axis=1)
    return [float(size.mean()), float(np.percentile(size, 95)), float(size.max())]
