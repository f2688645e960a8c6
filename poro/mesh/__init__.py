"""Tetrahedral lung meshes: stuffing of a mask, surface and patches, quality, point location."""

from poro.mesh.closest import ClosestPoints, closest_points
from poro.mesh.locate import Location, interpolate, locate
from poro.mesh.patches import Patches, patches, principal_axis
from poro.mesh.stuffing import signed_distance, stuff, stuff_level_set
from poro.mesh.tetmesh import Quality, TetMesh, TriSurface, quality, surface

__all__ = [
    "ClosestPoints",
    "Location",
    "Patches",
    "Quality",
    "TetMesh",
    "TriSurface",
    "closest_points",
    "interpolate",
    "locate",
    "patches",
    "principal_axis",
    "quality",
    "signed_distance",
    "stuff",
    "stuff_level_set",
    "surface",
]
