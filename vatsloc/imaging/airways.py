"""Windpipe and bronchi: dark tubes followed from a seed that is found by its shape."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from registration.volume import Array, Volume
from vatsloc.imaging.lattice import _box

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
    box = _box(seed, margin)
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
