"""Whether points lie in an image's box, and how much two boxes share."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from registration.volume import Array, Grid
from vatsloc.errors import InputRefused

MIN_OVERLAP = 0.2
"""Share of the smaller image's box that must lie inside the other; headers promise poses within about 10 cm."""


def check_overlap(a: Grid, b: Grid, path_a: Path, path_b: Path) -> None:
    """Raises InputRefused where two images' boxes share too little for their headers to be right."""
    share = image_overlap(a, b)
    if share < MIN_OVERLAP:
        centres = [grid.to_ras((np.array(grid.shape) - 1) / 2) for grid in (a, b)]
        apart = float(np.linalg.norm(centres[0] - centres[1]))
        raise InputRefused(
            f"{path_a} and {path_b} overlap by {100 * share:.0f} % ({apart:.0f} mm between centres), "
            f"{100 * MIN_OVERLAP:.0f} % needed; place them within about 10 cm of each other by their headers."
        )


def image_overlap(a: Grid, b: Grid) -> float:
    """Share of the smaller of two images' boxes that lies inside the other."""
    return max(_share_inside(a, b), _share_inside(b, a))


def _share_inside(a: Grid, b: Grid) -> float:
    """Share of a's box that lies inside b's."""
    fractions = (np.arange(16) + 0.5) / 16
    ijk = np.stack(np.meshgrid(*(fractions * n - 0.5 for n in a.shape), indexing="ij"), axis=-1)
    return float(inside_of(b, a.to_ras(ijk)).mean())


def inside_of(grid: Grid, points_ras: Array) -> Array:
    """Whether points (..., 3) lie in the box of a grid's voxels, (...) bool."""
    ijk = grid.to_ijk(points_ras)
    return np.asarray(((ijk >= -0.5) & (ijk <= np.array(grid.shape) - 0.5)).all(axis=-1))
