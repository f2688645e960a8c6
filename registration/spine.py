"""Rigid registration of the spine from any start within 12 cm and 25 degrees, told apart from a slip by one vertebra.

Ref: Alvarez 2021, section 6.1.1 (there with one clicked vertebra).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import partial

import numpy as np
from numba import njit
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from registration.images.interpolate import interpolate, warp_samples
from registration.images.pyramid import Pyramid
from registration.images.resample import coarsen, coarsen_mask
from registration.kernels.correlation import coefficient
from registration.kernels.threads import in_parts
from registration.maps.rigid import RigidTransform
from registration.terms.metrics import GlobalNcc
from registration.volume import Array, Mask, Volume

BONE_WINDOW = (-150.0, 700.0)
UNSEEN = -1e4
LEAST_OVERLAP = 0.5


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
    surroundings_mm: float = 40.0
    margin: float = 0.02
    least_ncc: float = 0.5


@dataclass(frozen=True)
class _Level:
    """Samples of the fixed image, the moving image and where that sees, at one resolution."""

    points: Array
    values: Array
    moving: Volume
    seen: Volume


def register_spine(
    fixed: Volume,
    moving: Volume,
    fixed_spine: Mask,
    moving_spine: Mask | None = None,
    *,
    initial: RigidTransform | None = None,
    fixed_seen: Mask | None = None,
    moving_seen: Mask | None = None,
    search: SpineSearch | None = None,
) -> RigidFit:
    """Find the rigid map under which the moving image around the spine looks like the fixed one.

    Starts from every pose of a grid of shifts and rotations about `initial` (default identity, the images' headers);
    moving_spine, when given, drops poses that carry the fixed spine off it. fixed_seen, moving_seen: fields of view.
    The best distinct poses are refined at 4 and 2 mm; the runner-up is the best that ends elsewhere, or a slip along
    the spine by one vertebra refined in turn.
    """
    search = search or SpineSearch()
    initial = initial or RigidTransform.identity()
    if not fixed_spine.inside.any():
        raise ValueError("the fixed spine mask is empty; check its segmentation")
    centre = fixed_spine.grid.to_ras(np.argwhere(fixed_spine.inside).mean(axis=0))
    coarse, middle, fine = _levels(fixed, moving, fixed_spine, fixed_seen, moving_seen, search.surroundings_mm)
    poses = _coarse(coarse, centre, initial, search, moving_spine)
    best = _refined(poses, (middle, fine), centre, 4)
    if not best:
        return RigidFit(initial, RigidStatus.POOR, -1.0, -1.0, 0.0, 0.0)
    pose, ncc = best[0]
    axis = _spine_axis(fixed_spine)
    slips = [pose @ _shift(s * axis) for s in (-42.0, -30.0, -20.0, 20.0, 30.0, 42.0)]
    others = [item for item in best[1:] + _refined(slips, (middle, fine), centre, 3) if _far(item[0], pose, centre)]
    second, second_ncc = max(others, key=lambda item: item[1], default=(pose, -1.0))
    status = RigidStatus.FOUND
    if ncc < search.least_ncc:
        status = RigidStatus.POOR
    elif ncc - second_ncc < search.margin:
        status = RigidStatus.AMBIGUOUS
    overlap = float(_weights(fine, pose(fine.points)).mean())
    return RigidFit(pose, status, ncc, second_ncc, _distance(second, pose, centre), overlap)


def _levels(
    fixed: Volume,
    moving: Volume,
    spine: Mask,
    fixed_seen: Mask | None,
    moving_seen: Mask | None,
    surroundings_mm: float,
) -> list[_Level]:
    """Levels of 8, 4 and 2 mm, each coarsened from the finer, with samples around the spine that the image shows."""
    everywhere = Mask(np.ones(moving.hu.shape, dtype=bool), moving.ras_from_ijk)
    seen = coarsen_mask(moving_seen or everywhere, 2.0)
    images = Pyramid(fixed, spine, moving, moving_seen, 2.0).at(2.0)
    low, high = BONE_WINDOW
    fixed, moving = coarsen(fixed, 2.0), images.moving
    shown = None if fixed_seen is None else coarsen_mask(fixed_seen, 2.0)
    inside = coarsen(coarsen_mask(spine, 2.0), 4.0)
    away = ndimage.distance_transform_edt(inside.hu < 0.1, sampling=inside.grid.spacing)
    levels = []
    for voxel, most in ((2.0, 12000), (4.0, 4000), (8.0, 600)):
        fixed, moving, seen = (coarsen(v, voxel) for v in (fixed, moving, seen))
        points = fixed.grid.points().reshape(-1, 3)
        taken = interpolate(away, inside.grid, points, 1e3) <= surroundings_mm
        if shown is not None:
            taken &= interpolate(shown.hu, shown.grid, points, 0.0) > 0.99
        index = np.flatnonzero(taken)
        if len(index) < 50:
            raise ValueError(
                f"the fixed spine mask leaves {len(index)} samples of {voxel} mm, 50 needed; check the mask"
            )
        index = index[np.random.default_rng(0).permutation(len(index))[:most]]
        values = np.clip(fixed.hu.reshape(-1)[index], low, high)
        clipped = Volume(np.clip(moving.hu, low, high), moving.ras_from_ijk)
        levels.append(_Level(points[index], values, clipped, seen))
    return levels[::-1]


def _refined(
    starts: list[RigidTransform], levels: tuple[_Level, _Level], centre: Array, most: int
) -> list[tuple[RigidTransform, float]]:
    """Distinct poses refined at both resolutions with their correlations, best first."""
    fits = sorted((_refine(levels[0], pose, centre, 12) for pose in starts), key=lambda item: -item[1])
    apart: list[tuple[RigidTransform, float]] = []
    for pose, ncc in fits:
        if ncc > -1 and len(apart) < most and all(_far(pose, k, centre) for k, _ in apart):
            apart.append((pose, ncc))
    return sorted((_refine(levels[1], pose, centre, 8) for pose, _ in apart), key=lambda item: -item[1])


def _coarse(
    level: _Level, centre: Array, initial: RigidTransform, search: SpineSearch, moving_spine: Mask | None
) -> list[RigidTransform]:
    """Best distinct poses of the search grid at the coarsest resolution."""
    step = 10.0
    ticks = np.arange(-search.shift_mm, search.shift_mm + step / 2, step)
    shifts = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    shifts = shifts[np.linalg.norm(shifts, axis=1) <= search.shift_mm + 1e-6]
    if moving_spine is not None:
        shifts = shifts[_near_spine(moving_spine, initial(centre[None])[0] + shifts)]
    rotations = _rotations(search.angle_degrees)
    ijk = level.moving.grid.ijk_from_ras
    relative = level.points - centre
    base = np.stack([relative @ (ijk[:3, :3] @ initial.matrix[:3, :3] @ r).T for r in rotations])
    target = level.moving.grid.to_ijk(initial(centre[None])[0] + shifts)
    scores = np.empty((len(rotations), len(shifts)), dtype=np.float32)
    unseen = np.where(level.seen.hu > 0.9, level.moving.hu, np.float32(2 * UNSEEN))
    single = base.astype(np.float32), target.astype(np.float32)
    in_parts(partial(_scores, np.ascontiguousarray(unseen), *single, level.values, scores), len(target))
    kept: list[RigidTransform] = []
    for flat in np.argsort(-scores, axis=None)[:4000]:
        t, s = np.unravel_index(flat, scores.shape)
        m = np.eye(4)
        m[:3, :3] = initial.matrix[:3, :3] @ rotations[t]
        m[:3, 3] = initial(centre[None])[0] + shifts[s] - m[:3, :3] @ centre
        pose = RigidTransform(m)
        if scores[t, s] > 0 and all(
            _distance(pose, k, centre) > 12.0 or (pose @ k.inverse()).angle_degrees > 15.0 for k in kept
        ):
            kept.append(pose)
        if len(kept) == 24:
            break
    return kept


def _rotations(half_width: float) -> list[Array]:
    """Rotations on a grid of rotation vectors, about 12 degrees apart, up to `half_width` degrees."""
    n = max(int(np.ceil(half_width / 13)), 1)
    ticks = np.linspace(-half_width, half_width, 2 * n + 1) * 0.9
    vectors = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    vectors = vectors[np.linalg.norm(vectors, axis=1) <= half_width]
    return [Rotation.from_rotvec(v, degrees=True).as_matrix() for v in vectors]


NEAR_SPINE_MM = 30.0
"""How far from the spine an image is compared."""


def _near_spine(spine: Mask, points: Array) -> Array:
    inside = spine.grid.to_ras(np.argwhere(spine.inside[::4, ::4, ::2]) * [4.0, 4.0, 2.0])
    away, _ = cKDTree(inside[:: max(len(inside) // 400, 1)]).query(points)
    return np.asarray(away <= NEAR_SPINE_MM)


@njit(cache=True, nogil=True)
def _scores(voxels, base, target, values, scores, first, end):
    ni, nj, nk = voxels.shape
    rotations, n, _ = base.shape
    for s in range(first, end):
        for t in range(rotations):
            count, sf, sm, sff, smm, sfm = 0, 0.0, 0.0, 0.0, 0.0, 0.0
            for p in range(n):
                x, y, z = base[t, p, 0] + target[s, 0], base[t, p, 1] + target[s, 1], base[t, p, 2] + target[s, 2]
                i, j, k = int(x + 0.5), int(y + 0.5), int(z + 0.5)
                if x < 0 or y < 0 or z < 0 or i >= ni or j >= nj or k >= nk:
                    continue
                f, m = values[p], voxels[i, j, k]
                if m < UNSEEN:
                    continue
                count += 1
                sf, sm = sf + f, sm + m
                sff, smm, sfm = sff + f * f, smm + m * m, sfm + f * m
            scores[t, s] = -1.0
            if count >= 0.6 * n:
                scores[t, s] = coefficient(count, sf, sm, sff, smm, sfm, 0.0, 0.0)


def _refine(level: _Level, pose: RigidTransform, centre: Array, steps: int) -> tuple[RigidTransform, float]:
    """Gauss-Newton on rotation about `centre` and shift, damped until each step raises the correlation."""
    metric = GlobalNcc(level.values)
    a = np.ascontiguousarray(level.moving.grid.ijk_from_ras[:3, :3])
    still, index = np.zeros((3, 1)), np.zeros(len(level.points), dtype=np.int64)

    def sampled(p: RigidTransform) -> tuple[Array, Array, Array, Array]:
        moved = p(level.points)
        base = np.ascontiguousarray(level.moving.grid.to_ijk(moved))
        return moved, _weights(level, moved), *warp_samples(level.moving.hu, base, still, index, a)

    moved, w, m, g = sampled(pose)
    if w.mean() < LEAST_OVERLAP:
        return pose, -1.0
    here, damping = metric.evaluate(m, w), 1e-3
    for _ in range(steps):
        pivot = pose(centre[None])[0]
        jacobian = np.concatenate([np.cross(moved - pivot, g.T), g.T], axis=1)
        gradient = jacobian.T @ here.slope
        hessian = (jacobian * here.curvature[:, None]).T @ jacobian
        value, improved = here.value, False
        while not improved and damping < 1e3:
            d = -np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)) + 1e-12 * np.eye(6), gradient)
            trial = RigidTransform.about(pivot, d[:3], d[3:]) @ pose
            trial_moved, w, m, trial_g = sampled(trial)
            there = metric.evaluate(m, w) if w.mean() >= LEAST_OVERLAP else here
            improved = there.value < value
            damping *= 0.2 if improved else 10
        if not improved:
            break
        pose, moved, g, here = trial, trial_moved, trial_g, there
        if value - here.value < 1e-5:
            break
    return pose, 1 - here.value


def _distance(a: RigidTransform, b: RigidTransform, centre: Array) -> float:
    return float(np.linalg.norm(a(centre[None]) - b(centre[None])))


def _far(a: RigidTransform, b: RigidTransform, centre: Array) -> bool:
    return _distance(a, b, centre) > 8.0


def _weights(level: _Level, moved: Array) -> Array:
    """1 for samples (n,) that land where the moving image sees, else 0."""
    return (interpolate(level.seen.hu, level.seen.grid, moved, 0.0) > 0.9).astype(float)


def _spine_axis(spine: Mask) -> Array:
    points = spine.grid.to_ras(np.argwhere(spine.inside).astype(float))
    return np.asarray(np.linalg.svd((points - points.mean(axis=0))[:: max(len(points) // 2000, 1)], False)[2][0])


def _shift(vector: Array) -> RigidTransform:
    return RigidTransform.about(np.zeros(3), np.zeros(3), vector)
