"""Tetrahedral mesh, its boundary surface and its quality."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from poro.arrays import Array
from poro.mesh.cells import Cells, cells_of
from poro.mesh.closest import depth_below
from poro.mesh.trisurface import TriSurface

# Faces of a positively oriented tetrahedron, seen anticlockwise from outside.
FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])


@dataclass(frozen=True, eq=False)
class TetMesh:
    """Positively oriented linear tetrahedra. points: (n, 3) mm; tets: (m, 4) node numbers. Equal only to itself."""

    points: Array
    tets: Array

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise ValueError(f"points must be (n, 3), got {self.points.shape}")
        if self.tets.ndim != 2 or self.tets.shape[1] != 4:
            raise ValueError(f"tets must be (m, 4), got {self.tets.shape}")

    def __repr__(self) -> str:
        return f"TetMesh({len(self.tets)} tetrahedra, {len(self.points)} nodes, {self.volumes.sum() / 1e6:.3f} l)"

    @cached_property
    def volumes(self) -> Array:
        """Volume of every tetrahedron, (m,) mm3."""
        return signed_volumes(self.points, self.tets)

    @cached_property
    def gradients(self) -> Array:
        """Gradients of the four barycentric coordinates, (m, 4, 3) 1/mm."""
        x = self.points[self.tets]
        edges = x[:, 1:] - x[:, :1]
        inverse = np.linalg.inv(edges)
        grads = np.empty((len(self.tets), 4, 3))
        grads[:, 1:] = inverse.transpose(0, 2, 1)
        grads[:, 0] = -grads[:, 1:].sum(axis=1)
        return grads

    @cached_property
    def node_volumes(self) -> Array:
        """A quarter of the volume of the tetrahedra around each node, (n,) mm3."""
        return np.bincount(self.tets.ravel(), np.repeat(self.volumes / 4, 4), len(self.points))

    @cached_property
    def cells(self) -> Cells:
        """Grid in which the tetrahedra about a point are found."""
        return cells_of(self.points, self.tets, self.volumes)

    @cached_property
    def boundary(self) -> TriSurface:
        """The outer surface (see `surface`)."""
        return surface(self)

    @cached_property
    def node_depths(self) -> Array:
        """How deep each node lies below the outer surface, (n,) mm. None lies outside, but where surfaces of two pieces
        coincide their sides cannot be told apart.
        """
        return np.abs(depth_below(self.boundary, self.points))


@dataclass(frozen=True)
class Quality:
    """What a mesh is like: counts, volume, dihedral angles in degrees, edge lengths in mm."""

    nodes: int
    tets: int
    volume_l: float
    min_dihedral: float
    max_dihedral: float
    obtuse_share: float
    min_edge: float
    mean_edge: float
    max_edge: float


def signed_volumes(points: Array, tets: Array) -> Array:
    """Signed volumes (m,) of tetrahedra (m, 4) over points (n, 3)."""
    x, y, z = (points[:, axis][tets] for axis in range(3))
    (x1, x2, x3), (y1, y2, y3), (z1, z2, z3) = ((q[:, 1:] - q[:, :1]).T for q in (x, y, z))
    return np.asarray(x1 * (y2 * z3 - y3 * z2) + y1 * (z2 * x3 - z3 * x2) + z1 * (x2 * y3 - x3 * y2)) / 6


def surface(mesh: TetMesh) -> TriSurface:
    """Outer surface of a mesh, triangles oriented outward."""
    faces = mesh.tets[:, FACES].reshape(-1, 3)
    key = np.sort(faces, axis=1).astype(np.int64)
    n = np.int64(len(mesh.points))
    code = (key[:, 0] * n + key[:, 1]) * n + key[:, 2]
    _, first, count = np.unique(code, return_index=True, return_counts=True)
    outer = faces[np.sort(first[count == 1])]
    nodes, local = np.unique(outer, return_inverse=True)
    return TriSurface(mesh.points[nodes], local.reshape(-1, 3), nodes)


def dihedral_angles(mesh: TetMesh) -> Array:
    """The six dihedral angles of every tetrahedron, (m, 6) degrees."""
    g = mesh.gradients / np.linalg.norm(mesh.gradients, axis=2, keepdims=True)
    i, j = np.triu_indices(4, 1)
    cosine = -np.einsum("mek,mek->me", g[:, i], g[:, j])
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def quality(mesh: TetMesh) -> Quality:
    """Counts, volume, extreme dihedral angles and edge lengths; obtuse angles are what breaks the maximum principle."""
    angles = dihedral_angles(mesh)
    i, j = np.triu_indices(4, 1)
    edges = np.linalg.norm(mesh.points[mesh.tets[:, i]] - mesh.points[mesh.tets[:, j]], axis=2)
    return Quality(
        nodes=len(mesh.points),
        tets=len(mesh.tets),
        volume_l=float(mesh.volumes.sum() / 1e6),
        min_dihedral=float(angles.min()),
        max_dihedral=float(angles.max()),
        obtuse_share=float((angles.max(axis=1) > 90).mean()),
        min_edge=float(edges.min()),
        mean_edge=float(edges.mean()),
        max_edge=float(edges.max()),
    )
