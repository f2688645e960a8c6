"""The lung of a result as it was before the run cut it: depth below the pleura must not depend on where it did."""

from __future__ import annotations

import numpy as np

from poro.mesh import TetMesh, stuff
from registration.images.morphology import close
from registration.volume import Grid
from vatsloc.maps import covered

VOXEL_MM, EDGE_MM = 2.0, 8.0
GROOVE_MM = 6.0
"""Half of how wide a groove along a cut can be: its rim is as rough as the mesh."""
SAME_MM = 1e-3


def whole_lung(lung: TetMesh) -> TetMesh:
    """The mesh where it is in one piece; where pieces have nodes of their own at one place, what they fill together,
    meshed anew with the cut and its grooves closed.
    """
    places = np.unique(np.round(lung.points / SAME_MM).astype(np.int64), axis=0)
    if len(places) == len(lung.points):
        return lung
    lower, upper = lung.points.min(axis=0) - 2 * GROOVE_MM, lung.points.max(axis=0) + 2 * GROOVE_MM
    ras_from_ijk = np.diag([VOXEL_MM, VOXEL_MM, VOXEL_MM, 1.0])
    ras_from_ijk[:3, 3] = lower
    ni, nj, nk = (int(n) for n in np.ceil((upper - lower) / VOXEL_MM))
    grid = Grid((ni, nj, nk), ras_from_ijk)
    return stuff(close(covered(lung, grid).inside, GROOVE_MM, grid.spacing), ras_from_ijk, EDGE_MM)
