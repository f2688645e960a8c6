"""Windpipe and bronchi: dark tubes followed from a seed that is found by its shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from registration.images.morphology import bounding_box, dilate, touching
from registration.volume import Array, Volume

TUBE_AREA_MM2 = (50.0, 900.0)
MOST_AIRWAY_ML = 120.0


def trachea(work: Volume, air: Array) -> Array:
    """Voxels of the longest dark round tube that runs along S near the body's midline (empty when there is none).

    work: image along R, A, S; air: its air inside the body. Round sections of 50-900 mm2 are linked over slices.
    """
    spacing = work.grid.spacing
    tube = air & (work.hu < -700)
    in_slice = np.zeros((3, 3, 3), dtype=bool)
    in_slice[:, :, 1] = ndimage.generate_binary_structure(2, 1)
    labels, count = ndimage.label(tube, in_slice)
    if count == 0:
        return np.zeros_like(air)
    pixel = spacing[0] * spacing[1]
    area = np.bincount(labels.ravel(), minlength=count + 1) * pixel
    boxes = ndimage.find_objects(labels)
    round_section = np.zeros(count + 1, dtype=bool)
    for n, box in enumerate(boxes, start=1):
        width, depth = (box[m].stop - box[m].start for m in (0, 1))
        fill = area[n] / (width * depth * pixel)
        slim = max(width * spacing[0], depth * spacing[1]) / max(min(width * spacing[0], depth * spacing[1]), 1e-9)
        round_section[n] = TUBE_AREA_MM2[0] < area[n] < TUBE_AREA_MM2[1] and fill > 0.55 and slim < 2.2
    sections = round_section[labels]
    chains, chain_count = ndimage.label(sections)
    if chain_count == 0:
        return np.zeros_like(air)
    body_r = np.argwhere(work.hu.max(axis=(1, 2)) > -200)
    middle, half = (body_r.min() + body_r.max()) / 2, (body_r.max() - body_r.min()) / 2
    best, best_score = 0, 0.0
    for n, box in enumerate(ndimage.find_objects(chains), start=1):
        length = (box[2].stop - box[2].start) * spacing[2]
        off = abs((box[0].stop + box[0].start - 1) / 2 - middle) / max(half, 1.0)
        upright = (box[2].start + box[2].stop) / 2 / air.shape[2]
        score = length * (1 - min(off, 1.0)) * (0.3 + upright)
        if length >= 24.0 and score > best_score:
            best, best_score = n, score
    return (chains == best) if best else np.zeros_like(air)


def grow_airways(work: Volume, seed: Array) -> Array:
    """The dark tree connected to `seed`: grown at rising HU and stopped before it leaks into lung tissue.

    A step that adds more than 35 % and 15 ml, or a tree above 120 ml beside the seed, is a leak.
    Ref: Alvarez 2021, section 6.1.2.
    """
    if not seed.any():
        return seed.copy()
    margin = np.array([110.0, 80.0, 150.0]) / work.grid.spacing
    box = bounding_box(seed, margin)
    hu, start = work.hu[box], seed[box]
    voxel_ml = float(work.grid.spacing.prod()) / 1000
    seed_ml = start.sum() * voxel_ml
    tree, size = start, seed_ml
    for limit in np.arange(-980.0, -699.0, 20.0):
        labels, count = ndimage.label((hu < limit) | start)
        keep = np.zeros(count + 1, dtype=bool)
        keep[np.unique(labels[start])] = True
        keep[0] = False
        grown = keep[labels]
        ml = grown.sum() * voxel_ml
        if ml > seed_ml + MOST_AIRWAY_ML or (ml > 1.35 * size and ml - size > 15.0):
            break
        tree, size = grown, ml
    out = np.zeros_like(seed)
    out[box] = tree
    return out


@dataclass(frozen=True)
class TrackedAirways:
    """Airways found again in a CBCT. inside: lumen on the working grid; shift_mm: (3,) RAS move of the expected tree.

    contrast_hu: wall minus lumen at the place found; the runner-up is the best place at least 8 mm away.
    """

    inside: Array
    shift_mm: Array
    contrast_hu: float
    runner_up_hu: float


def track_airways(work: Volume, seen: Array, expected: Array, reach_mm: float = 20.0) -> TrackedAirways:
    """The dark tubes of a CBCT near where the CT's airways are expected.

    The expected tree is moved as a whole to where its lumen is darkest against its wall, over shifts up to `reach_mm`;
    then dark voxels connected to it and not far from it are taken.
    """
    spacing = work.grid.spacing
    nothing = TrackedAirways(np.zeros_like(expected), np.zeros(3), 0.0, 0.0)
    if (expected & seen).sum() * spacing.prod() < 500.0:
        return nothing
    wall = dilate(expected, 4.5, spacing) & ~dilate(expected, 2.0, spacing)
    lumen_ijk, wall_ijk = (np.argwhere(m & seen)[:: max(int((m & seen).sum() // 4000), 1)] for m in (expected, wall))
    hu = np.where(seen, work.hu, np.float32(np.nan))
    n = np.maximum(np.floor(reach_mm / (2 * spacing)), 1).astype(int) * 2
    steps = np.stack(np.meshgrid(*[np.arange(-m, m + 1, 2) for m in n], indexing="ij"), -1).reshape(-1, 3)
    steps = steps[np.linalg.norm(steps * spacing, axis=1) <= reach_mm]
    score = _contrasts(hu, lumen_ijk, wall_ijk, steps)
    first = steps[int(score.argmax())]
    away = np.linalg.norm((steps - first) * spacing, axis=1) >= 8.0
    near = first + np.stack(np.meshgrid(*[np.arange(-2, 3)] * 3, indexing="ij"), -1).reshape(-1, 3)
    fine = _contrasts(hu, lumen_ijk, wall_ijk, near).reshape(5, 5, 5)
    if not np.isfinite(fine.max()):
        return nothing
    peak = np.array(np.unravel_index(int(fine.argmax()), fine.shape))
    best = first + peak - 2
    moved = _shifted(expected, best) & seen
    region = dilate(moved, 5.0, spacing)
    dark_level = float(np.median(work.hu[moved])) + 150.0 if moved.any() else -1000.0
    dark = (work.hu < dark_level) & region
    tubes = touching(dark, moved & dark)
    shift_mm = work.grid.ras_from_ijk[:3, :3] @ (best + _between_voxels(fine, peak))
    runner_up = float(score[away].max()) if away.any() else 0.0
    return TrackedAirways(tubes & seen, shift_mm, float(fine.max()), runner_up)


def _contrasts(hu: Array, lumen_ijk: Array, wall_ijk: Array, steps: Array) -> Array:
    """Mean wall minus mean lumen in HU for every shift (n, 3) in voxels; -inf where half of the tree is lost."""
    reach = np.abs(steps).max(axis=0)
    padded = np.pad(np.minimum(hu, 0.0), [(r, r) for r in reach], constant_values=np.nan)
    shifts = np.ravel_multi_index(tuple((steps + reach).T), padded.shape)
    flat, means = padded.reshape(-1), np.full((2, len(steps)), np.nan)
    for mean, ijk in zip(means, (lumen_ijk, wall_ijk), strict=True):
        places = np.ravel_multi_index(tuple(ijk.T), padded.shape)
        for n, shift in enumerate(shifts):
            values = flat[places + shift]
            values = values[np.isfinite(values)]
            if values.size > 0.5 * len(ijk):
                mean[n] = values.mean()
    return np.nan_to_num(means[1] - means[0], nan=-np.inf)


def _shifted(inside: Array, step: Array) -> Array:
    """`inside` moved by whole voxels, nothing wrapped round."""
    out = np.zeros_like(inside)
    to = tuple(slice(max(s, 0), n + min(s, 0)) for s, n in zip(step, inside.shape, strict=True))
    back = tuple(slice(max(-s, 0), n + min(-s, 0)) for s, n in zip(step, inside.shape, strict=True))
    out[to] = inside[back]
    return out


def _between_voxels(score: Array, peak: Array) -> Array:
    """Offset (3,) in voxels from the best sample to the top of the parabola through its neighbours on each axis."""
    offset = np.zeros(3)
    for axis in range(3):
        if not 0 < peak[axis] < score.shape[axis] - 1:
            continue
        before, at, after = (float(score[tuple(peak + step * np.eye(3, dtype=int)[axis])]) for step in (-1, 0, 1))
        bend = before - 2 * at + after
        if np.isfinite(bend) and bend < 0:
            offset[axis] = 0.5 * (before - after) / bend
    return np.clip(offset, -0.5, 0.5)
