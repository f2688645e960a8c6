"""Rigid registration of the spine from any start within 12 cm and 25 degrees, told apart from a slip by one vertebra.

Ref: Alvarez 2021, section 6.1.1 (there with one clicked vertebra).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numba import njit, prange
from scipy import ndimage
from scipy.spatial.transform import Rotation

from registration.interpolate import warp_samples
from registration.metric import GlobalNcc
from registration.resample import coarsen
from registration.rigid import RigidTransform
from registration.volume import Array, Mask, Volume

BONE_WINDOW = (-150.0, 700.0)


class RigidStatus(Enum):
    """What the caller may believe."""

    FOUND = "one pose of the spine explains the images clearly better than any other"
    AMBIGUOUS = "another pose, shifted along the spine, explains the images almost as well"
    POOR = "no pose explains the images: the correlation is too low"


@dataclass(frozen=True)
class RigidFit:
    """moving_from_fixed: best pose; ncc: its correlation around the spine; runner_up_ncc, runner_up_shift_mm: the best
    distinct pose and how far off it carries the spine; overlap: share of samples the moving image sees."""

    moving_from_fixed: RigidTransform
    status: RigidStatus
    ncc: float
    runner_up_ncc: float
    runner_up_shift_mm: float
    overlap: float


@dataclass(frozen=True)
class SpineSearch:
    """shift_mm, angle_degrees: half-widths of the search; surroundings_mm: how far from the spine images are compared;
    margin: least lead in correlation over the runner-up; least_ncc: below it no pose is believed."""

    shift_mm: float = 120.0
    angle_degrees: float = 25.0
    surroundings_mm: float = 25.0
    margin: float = 0.03
    least_ncc: float = 0.5


@dataclass(frozen=True)
class _Pair:
    """Samples of the fixed image and the moving image at one resolution."""

    points: Array
    values: Array
    moving: Volume


def register_spine(
    fixed: Volume,
    moving: Volume,
    fixed_spine: Mask,
    moving_spine: Mask | None = None,
    *,
    initial: RigidTransform | None = None,
    search: SpineSearch | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> RigidFit:
    """Find the rigid map under which the moving image around the spine looks like the fixed one.

    Starts from every pose of a grid of shifts and rotations about `initial` (default identity, the images' headers);
    moving_spine, when given, drops poses that carry the fixed spine off it. The best distinct poses are refined at 4
    and 2 mm; the runner-up is the best that ends elsewhere, or a slip along the spine by one vertebra refined in turn.
    """
    search = search or SpineSearch()
    initial = initial or RigidTransform.identity()
    centre = fixed_spine.grid.to_ras(np.argwhere(fixed_spine.inside).mean(axis=0))
    pairs = [
        _pair(fixed, moving, fixed_spine, search, voxel, n) for voxel, n in ((8.0, 600), (4.0, 4000), (2.0, 12000))
    ]
    poses = _coarse(pairs[0], centre, initial, search, moving_spine)
    if progress is not None:
        progress("spine: refining", 0.4)
    refined = [_refine(pairs[1], pose, centre, 12) for pose in _distinct(poses, centre, 12.0, 15.0)[:16]]
    refined.sort(key=lambda item: -item[1])
    best = [_refine(pairs[2], pose, centre, 8) for pose, _ in _apart(refined, centre, 8.0)[:3]]
    best.sort(key=lambda item: -item[1])
    pose, ncc = best[0]
    axis = _spine_axis(fixed_spine)
    slips = [_refine(pairs[1], pose @ _shift(s * axis), centre, 12) for s in (-42, -30, -20, 20, 30, 42)]
    slips = [
        _refine(pairs[2], p, centre, 8) for p, _ in _apart(sorted(slips, key=lambda item: -item[1]), centre, 8.0)[:3]
    ]
    others = [(p, q) for p, q in best[1:] + slips if _distance(p, pose, centre) > 8.0]
    second, second_ncc = max(others, key=lambda item: item[1], default=(pose, -1.0))
    status = RigidStatus.FOUND
    if ncc < search.least_ncc:
        status = RigidStatus.POOR
    elif ncc - second_ncc < search.margin:
        status = RigidStatus.AMBIGUOUS
    moved = moving.grid.to_ijk(pose(pairs[2].points))
    overlap = float(np.mean(np.all((moved >= 0) & (moved <= np.array(moving.hu.shape) - 1), axis=1)))
    return RigidFit(pose, status, ncc, second_ncc, _distance(second, pose, centre), overlap)


def _pair(fixed: Volume, moving: Volume, spine: Mask, search: SpineSearch, voxel_mm: float, most: int) -> _Pair:
    coarse = coarsen(fixed, voxel_mm)
    near = coarsen(Volume(spine.inside.astype(np.float32), spine.ras_from_ijk), voxel_mm).hu > 0.1
    distance = ndimage.distance_transform_edt(~near, sampling=coarse.grid.spacing)
    index = np.argwhere((distance <= search.surroundings_mm) & (coarse.hu > -990))
    if len(index) < 50:
        raise ValueError(
            f"the fixed spine mask leaves {len(index)} samples of {voxel_mm} mm, 50 needed; check the mask"
        )
    index = index[np.random.default_rng(0).permutation(len(index))[:most]]
    low, high = BONE_WINDOW
    values = np.clip(coarse.hu[tuple(index.T)], low, high)
    seen = coarsen(moving, voxel_mm)
    return _Pair(
        coarse.grid.to_ras(index.astype(float)), values, Volume(np.clip(seen.hu, low, high), seen.ras_from_ijk)
    )


def _coarse(
    pair: _Pair, centre: Array, initial: RigidTransform, search: SpineSearch, moving_spine: Mask | None
) -> list[tuple[RigidTransform, float]]:
    """Every pose of the search grid with its correlation at the coarsest resolution, best first."""
    step = 10.0
    ticks = np.arange(-search.shift_mm, search.shift_mm + step / 2, step)
    shifts = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    shifts = shifts[np.linalg.norm(shifts, axis=1) <= search.shift_mm + 1e-6]
    if moving_spine is not None:
        shifts = shifts[_near_spine(moving_spine, initial(centre[None])[0] + shifts)]
    turns = _turns(search.angle_degrees)
    ijk = pair.moving.grid.ijk_from_ras
    relative = pair.points - centre
    base = np.stack([relative @ (ijk[:3, :3] @ initial.matrix[:3, :3] @ r).T for r in turns])
    target = pair.moving.grid.to_ijk(initial(centre[None])[0] + shifts)
    scores = np.empty((len(turns), len(shifts)), dtype=np.float32)
    _scores(
        np.ascontiguousarray(pair.moving.hu), base.astype(np.float32), target.astype(np.float32), pair.values, scores
    )
    order = np.argsort(-scores, axis=None)[:3000]
    found = []
    for flat in order:
        t, s = np.unravel_index(flat, scores.shape)
        m = np.eye(4)
        m[:3, :3] = initial.matrix[:3, :3] @ turns[t]
        m[:3, 3] = initial(centre[None])[0] + shifts[s] - m[:3, :3] @ centre
        found.append((RigidTransform(m), float(scores[t, s])))
    return found


def _turns(half_width: float) -> list[Array]:
    """Rotations on a grid of rotation vectors, about 12 degrees apart, up to `half_width` degrees."""
    n = max(int(np.ceil(half_width / 13)), 1)
    ticks = np.linspace(-half_width, half_width, 2 * n + 1) * 0.9
    vectors = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    vectors = vectors[np.linalg.norm(vectors, axis=1) <= half_width]
    return [Rotation.from_rotvec(v, degrees=True).as_matrix() for v in vectors]


def _near_spine(spine: Mask, points: Array, reach_mm: float = 30.0) -> Array:
    inside = spine.grid.to_ras(np.argwhere(spine.inside[::4, ::4, ::2]) * [4.0, 4.0, 2.0])
    squared = np.min(np.sum((points[:, None] - inside[None, :: max(len(inside) // 400, 1)]) ** 2, axis=2), axis=1)
    return np.asarray(squared <= reach_mm**2)


@njit(cache=True, parallel=True, fastmath=True)
def _scores(voxels, base, target, values, scores):
    ni, nj, nk = voxels.shape
    turns, n, _ = base.shape
    for s in prange(target.shape[0]):
        for t in range(turns):
            count, sf, sm, sff, smm, sfm = 0, 0.0, 0.0, 0.0, 0.0, 0.0
            for p in range(n):
                x, y, z = base[t, p, 0] + target[s, 0], base[t, p, 1] + target[s, 1], base[t, p, 2] + target[s, 2]
                i, j, k = int(x + 0.5), int(y + 0.5), int(z + 0.5)
                if x < 0 or y < 0 or z < 0 or i >= ni or j >= nj or k >= nk:
                    continue
                f, m = values[p], voxels[i, j, k]
                count += 1
                sf, sm = sf + f, sm + m
                sff, smm, sfm = sff + f * f, smm + m * m, sfm + f * m
            scores[t, s] = -1.0
            if count >= 0.6 * n:
                vf, vm = sff - sf * sf / count, smm - sm * sm / count
                if vf > 0 and vm > 0:
                    scores[t, s] = (sfm - sf * sm / count) / np.sqrt(vf * vm)


def _refine(pair: _Pair, pose: RigidTransform, centre: Array, steps: int) -> tuple[RigidTransform, float]:
    """Gauss-Newton on rotation about `centre` and shift, damped until each step raises the correlation."""
    metric, n = GlobalNcc(pair.values), len(pair.points)
    a = np.ascontiguousarray(pair.moving.grid.ijk_from_ras[:3, :3])
    still, index = np.zeros((3, 1)), np.zeros(n, dtype=np.int64)
    last = np.array(pair.moving.hu.shape) - 1.0
    m, g = np.empty(n), np.empty((3, n))

    def sampled(p: RigidTransform) -> tuple[Array, Array]:
        moved = p(pair.points)
        base = np.ascontiguousarray(pair.moving.grid.to_ijk(moved))
        warp_samples(pair.moving.hu, base, still, index, a, m, g)
        return moved, np.all((base >= 0) & (base <= last), axis=1).astype(float)

    moved, w = sampled(pose)
    if w.mean() < 0.5:
        return pose, -1.0
    here, damping = metric.evaluate(m, w), 1e-3
    for _ in range(steps):
        arm = moved - pose(centre[None])
        jacobian = np.concatenate([np.cross(arm, g.T), g.T], axis=1)
        gradient = jacobian.T @ here.slope
        hessian = (jacobian * here.curvature[:, None]).T @ jacobian
        improved = False
        for _ in range(5):
            d = -np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)) + 1e-12 * np.eye(6), gradient)
            trial = RigidTransform.about(pose(centre[None])[0], d[:3], d[3:]) @ pose
            trial_moved, trial_w = sampled(trial)
            there = metric.evaluate(m, trial_w)
            if trial_w.mean() >= 0.5 and there.value < here.value:
                improved = True
                break
            damping *= 10
        if not improved:
            break
        gain, damping = here.value - there.value, damping / 5
        pose, moved, here = trial, trial_moved, there
        if gain < 1e-5:
            break
    return pose, 1 - here.value


def _distance(a: RigidTransform, b: RigidTransform, centre: Array) -> float:
    return float(np.linalg.norm(a(centre[None]) - b(centre[None])))


def _distinct(
    poses: list[tuple[RigidTransform, float]], centre: Array, apart_mm: float, apart_degrees: float
) -> list[RigidTransform]:
    """Poses, best first, without those close to a better one in both place and direction."""
    kept: list[RigidTransform] = []
    for pose, _ in poses:
        if all(
            _distance(pose, k, centre) > apart_mm or (pose @ k.inverse()).angle_degrees > apart_degrees for k in kept
        ):
            kept.append(pose)
    return kept


def _apart(
    fits: list[tuple[RigidTransform, float]], centre: Array, apart_mm: float
) -> list[tuple[RigidTransform, float]]:
    kept: list[tuple[RigidTransform, float]] = []
    for pose, ncc in fits:
        if all(_distance(pose, k, centre) > apart_mm for k, _ in kept):
            kept.append((pose, ncc))
    return kept


def _spine_axis(spine: Mask) -> Array:
    points = spine.grid.to_ras(np.argwhere(spine.inside).astype(float))
    return np.asarray(np.linalg.svd((points - points.mean(axis=0))[:: max(len(points) // 2000, 1)], False)[2][0])


def _shift(vector: Array) -> RigidTransform:
    return RigidTransform.about(np.zeros(3), np.zeros(3), vector)
