"""Triangulated surface, its normals and areas."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from poro.arrays import Array


@dataclass(frozen=True)
class TriSurface:
    """Triangles with outward normals. points: (n, 3) mm; triangles: (t, 3); nodes: (n,) numbers in the parent mesh."""

    points: Array
    triangles: Array
    nodes: Array

    @cached_property
    def area_vectors(self) -> Array:
        """Normal of every triangle times its area, (t, 3) mm2."""
        a, b, c = (self.points[self.triangles[:, m]] for m in range(3))
        return np.cross(b - a, c - a) / 2

    @cached_property
    def areas(self) -> Array:
        """(t,) mm2."""
        return np.linalg.norm(self.area_vectors, axis=1)

    @cached_property
    def normals(self) -> Array:
        """Unit outward normals of the triangles, (t, 3)."""
        return self.area_vectors / self.areas[:, None]

    @cached_property
    def node_areas(self) -> Array:
        """A third of the area around each node, (n,) mm2."""
        return np.bincount(self.triangles.ravel(), np.repeat(self.areas / 3, 3), len(self.points))

    @cached_property
    def node_normals(self) -> Array:
        """Area-weighted unit outward normals at the nodes, (n, 3)."""
        total = np.zeros_like(self.points)
        for m in range(3):
            np.add.at(total, self.triangles[:, m], self.area_vectors)
        return total / np.maximum(np.linalg.norm(total, axis=1), 1e-30)[:, None]

    def moved(self, points: Array) -> TriSurface:
        """The same triangles on new points (n, 3)."""
        return TriSurface(points, self.triangles, self.nodes)
