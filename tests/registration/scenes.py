"""Scenes with known answers: smooth patterns defined at every point of space, and grids in every orientation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from registration.volume import Array, Grid, Volume

Pattern = Callable[[Array], Array]


def make_pattern(seed: int = 0, waves: int = 60, shortest_mm: float = 14.0) -> Pattern:
    """HU at any points (..., 3): a sum of cosines in random directions, wavelengths `shortest_mm` to 6 times that."""
    rng = np.random.default_rng(seed)
    k = rng.normal(size=(waves, 3))
    k *= (2 * np.pi / (shortest_mm * rng.uniform(1, 6, waves)) / np.linalg.norm(k, axis=1))[:, None]
    phase, height = rng.uniform(0, 2 * np.pi, waves), rng.uniform(20, 60, waves)

    def pattern(points: Array) -> Array:
        flat = points.reshape(-1, 3)
        parts = np.array_split(flat, len(flat) // 2048 + 1)  # small enough for the processor's cache
        return np.concatenate([-500 + np.cos(x @ k.T + phase) @ height for x in parts]).reshape(points.shape[:-1])

    return pattern


def image_of(pattern: Pattern, grid: Grid) -> Volume:
    """A pattern on a grid."""
    values = pattern(grid.points().reshape(-1, 3)).reshape(grid.shape)
    return Volume(values.astype(np.float32), grid.ras_from_ijk)


def oriented(codes: str, shape_ras: tuple[int, int, int], spacing: float, centre: Array) -> Grid:
    """Grid about `centre` whose axes run along `codes`, for instance "LPS"; shape_ras: voxels along R, A, S."""
    affine, shape = np.eye(4), [0, 0, 0]
    for axis, code in enumerate(codes):
        m = next(i for i, pair in enumerate(("RL", "AP", "SI")) if code in pair)
        column = np.zeros(3)
        column[m] = spacing if code in "RAS" else -spacing
        affine[:3, axis] = column
        shape[axis] = shape_ras[m]
    affine[:3, 3] = centre - affine[:3, :3] @ ((np.array(shape) - 1) / 2)
    return Grid((shape[0], shape[1], shape[2]), affine)


def tilted(grid: Grid, rotation: Array) -> Grid:
    """The same grid turned about its centre by a rotation (3, 3)."""
    centre = grid.to_ras((np.array(grid.shape) - 1) / 2)
    affine = grid.ras_from_ijk.copy()
    affine[:3, :3] = rotation @ affine[:3, :3]
    affine[:3, 3] = centre + rotation @ (grid.ras_from_ijk[:3, 3] - centre)
    return Grid(grid.shape, affine)
