"""Tetrahedral meshes of a lung: how a mask is filled, its surface and patches, quality, and where points lie.

`stuff` fills a mask with tetrahedra (`TetMesh`), `locate` and `interpolate` carry nodal fields to points,
`rasterize` to voxels, and `closest_points` measures distances from a surface (`TriSurface`).
"""

from poro.mesh.closest import closest_points
from poro.mesh.locate import interpolate, locate
from poro.mesh.patches import patches
from poro.mesh.rasterize import rasterize
from poro.mesh.stuffing import signed_distance, stuff, stuff_level_set
from poro.mesh.tetmesh import TetMesh, quality, surface
from poro.mesh.trisurface import TriSurface

__all__ = [
    "TetMesh",
    "TriSurface",
    "closest_points",
    "interpolate",
    "locate",
    "patches",
    "quality",
    "rasterize",
    "signed_distance",
    "stuff",
    "stuff_level_set",
    "surface",
]
