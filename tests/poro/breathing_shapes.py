"""A lung-like pear: an ellipsoid with a flat foot, in two sizes."""

from __future__ import annotations

import numpy as np

from poro.arrays import Array
from poro.mesh import TetMesh, stuff

HALF = np.array([35.0, 50.0, 70.0])


def pear(edge_mm: float = 20.0, stretch: Array | float = 1.0) -> TetMesh:
    """Half an ellipsoid that stands on a flat foot at z = -30; head along +z."""
    step = 5.0
    n = np.ceil(HALF / step).astype(int) + 3
    x = step * np.stack(np.meshgrid(*(np.arange(-k, k + 1) for k in n), indexing="ij"), -1)
    inside = (np.linalg.norm(x / HALF, axis=-1) < 1) & (x[..., 2] > -30)
    affine = np.diag([step, step, step, 1.0])
    affine[:3, 3] = -step * n
    mesh = stuff(inside, affine, edge_mm)
    return TetMesh(mesh.points * stretch, mesh.tets)
