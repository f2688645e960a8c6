"""What a collapsed lung is compared with: surface points and matched inner points, as residuals with derivatives."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from poro.arrays import Array
from poro.mesh.closest import ClosestPoints, closest_points
from poro.mesh.locate import Location, interpolate, locate
from poro.mesh.tetmesh import TetMesh
from poro.mesh.trisurface import TriSurface


@dataclass(frozen=True)
class Target:
    """Deflated anatomy, visible part only.

    points: (t, 3) mm on the deflated surface; normals: (t, 3) outward; weights: (t,) confidence 0..1.
    inflated, deflated: (k, 3) mm matched points inside the lung; keypoint_weights: (k,).
    """

    points: Array
    normals: Array
    weights: Array
    inflated: Array = field(default_factory=lambda: np.zeros((0, 3)))
    deflated: Array = field(default_factory=lambda: np.zeros((0, 3)))
    keypoint_weights: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        for name, value, like in (
            ("normals", self.normals, self.points),
            ("weights", self.weights, self.points[:, 0]),
            ("deflated", self.deflated, self.inflated),
            ("keypoint_weights", self.keypoint_weights, self.inflated[:, 0]),
        ):
            if value.shape != like.shape:
                raise ValueError(f"{name} must have shape {like.shape}, got {value.shape}")


@dataclass(frozen=True)
class Residuals:
    """Rows of a least-squares problem before weighting.

    value: (r,) mm; nodes: (r, c) and share: (r, c, 3): the derivative of a row is sum share . du[nodes];
    group: (r,) number of the observation that a row belongs to; weight: (r,) confidence; surface: (r,) bool.
    """

    value: Array
    nodes: Array
    share: Array
    group: Array
    weight: Array
    surface: Array

    def derivative(self, du: Array) -> Array:
        """Derivatives (r, k) of the rows for derivatives du (n, 3, k) of the nodal displacements."""
        result = np.zeros((len(self.value), du.shape[2]))
        for corner in range(self.nodes.shape[1]):
            result += np.einsum("rd,rdk->rk", self.share[:, corner], du[self.nodes[:, corner]])
        return result


@dataclass(frozen=True)
class Observer:
    """Compares deformed meshes with a target. plain: nearest-node distances of the paper instead of distance to the
    surface.
    """

    mesh: TetMesh
    target: Target
    plain: bool = False

    @cached_property
    def _inner(self) -> Location:
        return locate(self.mesh, self.target.inflated)

    def residuals(self, u: Array) -> Residuals:
        """Residuals at nodal displacements u (n, 3) mm; surface rows first."""
        surface = self._nearest_nodes(u) if self.plain else self._distances(u)
        count = len(self.target.inflated)
        if count == 0:
            return surface
        moved = self.target.inflated + interpolate(self._inner, u)
        share = np.zeros((count, 3, 4, 3))
        for axis in range(3):
            share[:, axis, :, axis] = -self._inner.barycentric
        value = (self.target.deflated - moved).ravel()
        wide = _widen(surface, 4)
        return Residuals(
            np.concatenate([wide.value, value]),
            np.concatenate([wide.nodes, np.repeat(self._inner.nodes, 3, axis=0)]),
            np.concatenate([wide.share, share.reshape(-1, 4, 3)]),
            np.concatenate([wide.group, len(self.target.points) + np.repeat(np.arange(count), 3)]),
            np.concatenate([wide.weight, np.repeat(self.target.keypoint_weights, 3)]),
            np.concatenate([wide.surface, np.zeros(3 * count, bool)]),
        )

    def _distances(self, u: Array) -> Residuals:
        """Signed distance of every target point to the deformed surface, exact and so with an exact derivative.

        Where the target's normal and the surface's disagree the point is taken to belong to another side and loses
        weight.
        """
        boundary = self.mesh.boundary
        moved = boundary.moved(boundary.points + u[boundary.nodes])
        near = closest_points(moved, self.target.points)
        face = moved.normals[near.triangle]
        offset = self.target.points - near.points
        length = np.abs(near.distance)[:, None]
        far = length > 1e-6
        normal = np.where(far, np.sign(near.distance)[:, None] * offset / np.where(far, length, 1), face)
        share = -near.barycentric[:, :, None] * normal[:, None]
        agree = np.clip(facing(moved, near, self.target.normals), 0, 1)
        nodes = boundary.nodes[boundary.triangles[near.triangle]]
        every = np.arange(len(length))
        return Residuals(near.distance, nodes, share, every, self.target.weights * agree, np.ones(len(every), bool))

    def _nearest_nodes(self, u: Array) -> Residuals:
        """Vector from the nearest surface node to every target point. Ref: Alvarez 2021, eq. 15."""
        boundary = self.mesh.boundary
        moved = boundary.points + u[boundary.nodes]
        nearest = cKDTree(moved).query(self.target.points)[1]
        count = len(self.target.points)
        share = np.broadcast_to(-np.eye(3), (count, 3, 3)).reshape(-1, 1, 3)
        return Residuals(
            (self.target.points - moved[nearest]).ravel(),
            np.repeat(boundary.nodes[nearest], 3)[:, None],
            share,
            np.repeat(np.arange(count), 3),
            np.repeat(self.target.weights, 3),
            np.ones(3 * count, bool),
        )


def facing(surface: TriSurface, near: ClosestPoints, normals: Array) -> Array:
    """Cosine (t,) between normals (t, 3) and the surface's at the points of it that lie nearest.

    The surface's are taken from its nodes: most nearest points lie on an edge, where the faces' own normals would leave
    the answer to rounding.
    """
    smooth = np.einsum("tc,tcd->td", near.barycentric, surface.node_normals[surface.triangles[near.triangle]])
    smooth /= np.maximum(np.linalg.norm(smooth, axis=1), 1e-12)[:, None]
    return np.asarray(np.einsum("td,td->t", smooth, normals))


def _widen(rows: Residuals, corners: int) -> Residuals:
    missing = corners - rows.nodes.shape[1]
    nodes = np.pad(rows.nodes, ((0, 0), (0, missing)))
    share = np.pad(rows.share, ((0, 0), (0, missing), (0, 0)))
    return Residuals(rows.value, nodes, share, rows.group, rows.weight, rows.surface)


def independence(points: Array, correlation_mm: float) -> Array:
    """Share (t,) of an independent observation that every point (t, 3) is worth: one over its neighbours nearby."""
    if not len(points) or correlation_mm <= 0:
        return np.ones(len(points))
    return 1 / cKDTree(points).query_ball_point(points, correlation_mm / 2, return_length=True)
