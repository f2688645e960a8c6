"""A lung for benchmarks and studies whose wall is an expression, so that another program can read the same wall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from poro.arrays import Array
from poro.collapse import PoroSystem, assemble
from poro.contact import LevelSet
from poro.fem import Tissue
from poro.mesh import TetMesh, stuff_level_set

RADII_MM = np.array([45.0, 65.0, 100.0])
# An ellipsoid with a bay for the heart and a dome for the diaphragm, 1 l; positive inside, in mm.
WALL = (
    "45*(1-sqrt(sqr(x_/45)+sqr(y_/65)+sqr(z_/100)))"
    "-14*exp(-(sqr(x_+40)+sqr(y_-25)+sqr(z_+30))/1500)"
    "-22*exp(-(sqr(x_)+sqr(y_)+sqr(z_+105))/2500)"
)
GRAVITY = np.array([0.9, 0.1, -0.2]) / np.linalg.norm([0.9, 0.1, -0.2])
HILUM_CENTRE = np.array([-44.0, -5.0, 5.0])
# Measured on this shape: tetrahedra times the cube of their mean edge in mm.
_TETS_EDGE3 = 9.9e6


def wall_level(points: Array) -> Array:
    """Value of `WALL` at points (..., 3) mm."""
    names = {"x_": points[..., 0], "y_": points[..., 1], "z_": points[..., 2]}
    return np.asarray(eval(WALL, {"sqrt": np.sqrt, "sqr": np.square, "exp": np.exp, **names}))


@dataclass(frozen=True)
class Lung:
    """Mesh of the lung with its hilum. hilum: (k,) sorted nodes, all nodes of whole faces; hilum_displacement: (k, 3)
    mm.
    """

    mesh: TetMesh
    hilum: Array
    hilum_displacement: Array


def lung(tets: int, hilum_radius_mm: float = 22.0) -> Lung:
    """The lung in about `tets` tetrahedra, held by the faces within `hilum_radius_mm` of the hilum's centre."""
    mesh = stuff_level_set(wall_level, -RADII_MM - 5, RADII_MM + 5, float(np.cbrt(_TETS_EDGE3 / tets)))
    boundary = mesh.boundary
    near = np.linalg.norm(boundary.points - HILUM_CENTRE, axis=1) < hilum_radius_mm
    faces = boundary.triangles[near[boundary.triangles].all(axis=1)]
    hilum = np.sort(boundary.nodes[np.unique(faces)])
    motion = np.array([3.0, 1.0, 2.0]) + 0.02 * (mesh.points[hilum] - HILUM_CENTRE)[:, [1, 2, 0]]
    return Lung(mesh, hilum, motion)


def system_of(body: Lung, tissue: Tissue, wall: LevelSet | None = None) -> PoroSystem:
    """The lung set up inside a wall, by default its own outline."""
    return assemble(body.mesh, tissue, GRAVITY, body.hilum, body.hilum_displacement, wall_level=wall)


def smooth_wall(step_mm: float = 2.0) -> LevelSet:
    """The wall `WALL`, sampled finely enough for a spline to be exact to microns."""
    origin = -RADII_MM - 45
    shape = np.ceil(-2 * origin / step_mm).astype(int) + 1
    axes = [origin[d] + step_mm * np.arange(shape[d]) for d in range(3)]
    samples = wall_level(np.stack(np.meshgrid(*axes, indexing="ij"), -1))
    return LevelSet(ndimage.spline_filter(samples, order=3, mode="mirror"), origin, step_mm)
