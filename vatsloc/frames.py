"""Two frames and the border between them.

Stand at the patient's feet and look up. Radiology counts millimetres to the patient's Left, to the back (Posterior) and
to the head (Superior): LPS, the frame of DICOM, MetaImage, ITK and of every file Slicer writes today. Neuroimaging
counts to the Right, to the front (Anterior) and to the head: RAS, the frame of NIfTI. The program thinks in RAS alone.

Both count the third axis alike and the first two the other way round, so the way across is half a turn about the
head-foot axis, F = diag(-1, -1, 1), and F is its own inverse: one function takes points over the border and back.

    points             x_lps = F x_ras
    vectors            v_lps = F v_ras               (a displacement field flips its vectors, its voxels stay put)
    voxel affines      lps_from_ijk = F ras_from_ijk             (one border crossed, at the world's end)
    transforms         lps_from_lps = F ras_from_ras F           (both borders crossed)

Because F turns and does not mirror, tetrahedra and triangles keep their orientation and determinants their sign.

Voxel storage is another matter: the letters of `axis_codes` say where the three *array* axes point, and `reorient`
permutes and reverses an array without moving a voxel in space.
"""

from __future__ import annotations

from itertools import permutations
from typing import Literal

import numpy as np

from registration.volume import Array

Side = Literal["left", "right"]
"""Of the patient."""

FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])
"""(4, 4): RAS to LPS and back."""

_DIRECTION = {"R": (0, 1), "L": (0, -1), "A": (1, 1), "P": (1, -1), "S": (2, 1), "I": (2, -1)}


def flip_points(points: Array) -> Array:
    """Points or vectors (..., 3) in the other frame, mm."""
    return np.asarray(points, dtype=float) * np.diag(FLIP)[:3]


def flip_affine(world_from_ijk: Array) -> Array:
    """Voxel affine (4, 4) whose world side is the other frame."""
    return FLIP @ np.asarray(world_from_ijk, dtype=float)


def flip_transform(matrix: Array) -> Array:
    """World-to-world matrix (4, 4) with both sides in the other frame."""
    return FLIP @ np.asarray(matrix, dtype=float) @ FLIP


def flip_field(vectors: Array) -> Array:
    """Displacements (ni, nj, nk, 3) with components in the other frame, mm, float32."""
    return np.asarray(vectors, dtype=np.float32) * np.diag(FLIP)[:3].astype(np.float32)


def reorient(values: Array, ras_from_ijk: Array, codes: str) -> tuple[Array, Array]:
    """Array (ni, nj, nk, ...) and its affine with array axes along `codes`, for instance "LPS"; nothing is resampled.

    An oblique grid keeps its obliquity: each axis goes to the letter it is nearest to. Raises ValueError when `codes`
    does not name each anatomical direction once.
    """
    wanted = [_DIRECTION[c] for c in codes if c in _DIRECTION]
    if len(codes) != 3 or sorted(direction for direction, _ in wanted) != [0, 1, 2]:
        raise ValueError(f'codes must name three directions such as "LPS", got "{codes}"')
    affine = np.array(ras_from_ijk, dtype=float)
    cosines = affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0)
    # The best of the six pairings, since near 45 degrees two axes can both lie nearest to the same letter.
    source = max(
        permutations(range(3)),
        key=lambda order: sum(abs(cosines[d, s]) for (d, _), s in zip(wanted, order, strict=True)),
    )
    affine = affine[:, [*source, 3]]
    values = np.transpose(values, (*source, *range(3, np.ndim(values))))
    for axis, (direction, sign) in enumerate(wanted):
        if cosines[direction, source[axis]] * sign < 0:
            affine[:, 3] += affine[:, axis] * (values.shape[axis] - 1)
            affine[:, axis] *= -1
            values = np.flip(values, axis)
    return values, affine
