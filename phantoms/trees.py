"""Space-filling trees of airways and vessels, and their drawing as tapering tubes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from phantoms.voxels import Grid

Array = NDArray[Any]


@dataclass(frozen=True)
class Tree:
    """Branches of a rooted binary tree. nodes: (n, 3) RAS mm; parent: (n,), -1 at the root; radius: (n,) mm of the
    branch that ends at the node; generation: (n,); cloud: (n,) which of the clouds it grew into the branch feeds."""

    nodes: Array
    parent: Array
    radius: Array
    generation: Array
    cloud: Array

    def moved(self, nodes: Array, scale: float = 1.0) -> Tree:
        """The same tree with its nodes elsewhere and its radii scaled."""
        return Tree(nodes, self.parent, self.radius * scale, self.generation, self.cloud)

    def keep(self, chosen: Array) -> Tree:
        """Sub-tree of the branches where `chosen` (n,) is true; a kept branch's parent must be kept."""
        new = np.cumsum(chosen) - 1
        parent = self.parent[chosen]
        return Tree(
            self.nodes[chosen],
            np.where(parent >= 0, new[parent], -1),
            self.radius[chosen],
            self.generation[chosen],
            self.cloud[chosen],
        )

    def forks(self) -> Array:
        """Indices of the nodes with two children."""
        inner = self.parent[self.parent >= 0]
        return np.flatnonzero(np.bincount(inner, minlength=len(self.nodes)) >= 2)


@dataclass(frozen=True)
class LungTrees:
    """Trees of one lung, RAS mm in the CT: bronchi, pulmonary arteries along them, veins between them."""

    airway: Tree
    artery: Tree
    vein: Tree


def grow(
    clouds: Sequence[Array], root: Array, hilum: Array, leaf_points: int, leaf_radius: float, exponent: float
) -> Tree:
    """Tree from `root` through `hilum` that fills point clouds (n, 3) by repeated halving, each by branches of its own.

    Every branch runs part of the way to the middle of the points it feeds, a smaller part near the root; clouds below
    `leaf_points` end it. Radii follow r^exponent of the parent = sum over its children, from `leaf_radius` mm at the
    ends.
    Ref: Tawhai 2000 (halving); Murray 1926 (radii).
    """
    nodes, parent, generation, feeds = [root, hilum], [-1, 0], [0, 0], [0, 0]
    stack: list[tuple[Array, int, int, int]] = []

    def branch(points: Array, at: int, depth: int, cloud: int) -> None:
        leaf = len(points) < leaf_points
        share = 0.95 if leaf else min(0.26 + 0.025 * depth, 0.45)
        nodes.append(nodes[at] + share * (points.mean(axis=0) - nodes[at]))
        parent.append(at)
        generation.append(depth)
        feeds.append(cloud)
        if not leaf:
            stack.append((points, len(nodes) - 1, depth + 1, cloud))

    if len(clouds) == 1:
        stack.append((clouds[0], 1, 1, 0))
    else:
        for n, points in enumerate(clouds):
            branch(points, 1, 1, n)
    while stack:
        points, at, depth, cloud = stack.pop()
        for half in _halves(points, nodes[at] - nodes[parent[at]]):
            branch(half, at, depth, cloud)
    radius = _radii(np.array(parent), leaf_radius, exponent)
    return Tree(np.array(nodes), np.array(parent), radius, np.array(generation), np.array(feeds))


def _halves(points: Array, along: Array) -> tuple[Array, Array]:
    centred = points - points.mean(axis=0)
    direction = along / max(float(np.linalg.norm(along)), 1e-9)
    flat = centred - np.outer(centred @ direction, direction)
    _, axes = np.linalg.eigh(flat.T @ flat)
    side = centred @ axes[:, -1] > 0
    return points[side], points[~side]


def _radii(parent: Array, leaf_radius: float, exponent: float) -> Array:
    power = np.zeros(len(parent))
    leaf = np.bincount(parent[parent >= 0], minlength=len(parent)) == 0
    power[leaf] = leaf_radius**exponent
    for n in range(len(parent) - 1, 0, -1):
        power[parent[n]] += power[n]
    return power ** (1 / exponent)


def tubes(tree: Tree, wiggle: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Centre lines of a tree as three tapering pieces a branch: ends (n, 2, 3) mm and radii (n, 2) mm.

    The bend of a branch is `wiggle` times its length.
    """
    child = np.flatnonzero(tree.parent >= 0)
    a, b = tree.nodes[tree.parent[child]], tree.nodes[child]
    length = np.linalg.norm(b - a, axis=1, keepdims=True)
    bend = rng.standard_normal(a.shape) * wiggle * length
    inner = [a + t * (b - a) + bend * 4 * t * (1 - t) for t in (1 / 3, 2 / 3)]
    path = np.stack([a, *inner, b], axis=1)
    parent_radius = np.minimum(tree.radius[tree.parent[child]], 1.25 * tree.radius[child])
    r = np.stack(
        [parent_radius + t * (tree.radius[child] * 0.92 - parent_radius) for t in (0, 1 / 3, 2 / 3, 1)], axis=1
    )
    ends = np.stack([path[:, :-1], path[:, 1:]], axis=2).reshape(-1, 2, 3)
    return ends, np.stack([r[:, :-1], r[:, 1:]], axis=2).reshape(-1, 2)


def draw_tubes(share: Array, grid: Grid, ends: Array, radii: Array, width_mm: float) -> None:
    """Raise `share` (0..1, one value a voxel) to the share of each voxel that tubes fill; the grid is parallel to RAS.

    Tubes thinner than `width_mm`, the edge of a voxel, fill less than all of it.
    """
    step = np.diag(grid.ras_from_ijk[:3, :3]).copy()
    origin = grid.ras_from_ijk[:3, 3].copy()
    _fill(
        share, origin, step, np.ascontiguousarray(ends, dtype=float), np.ascontiguousarray(radii, dtype=float), width_mm
    )


@numba.njit(cache=True)
def _fill(share, origin, step, ends, radii, width):
    low, high = np.empty(3, dtype=np.int64), np.empty(3, dtype=np.int64)
    for n in range(len(ends)):
        p, q, rp, rq = ends[n, 0], ends[n, 1], radii[n, 0], radii[n, 1]
        reach = max(rp, rq) + width / 2
        dd = 1e-12
        for m in range(3):
            a = (min(p[m], q[m]) - reach - origin[m]) / step[m]
            b = (max(p[m], q[m]) + reach - origin[m]) / step[m]
            low[m] = max(int(np.ceil(min(a, b))), 0)
            high[m] = min(int(np.floor(max(a, b))) + 1, share.shape[m])
            dd += (q[m] - p[m]) ** 2
        for i in range(low[0], high[0]):
            x = origin[0] + step[0] * i - p[0]
            for j in range(low[1], high[1]):
                y = origin[1] + step[1] * j - p[1]
                for k in range(low[2], high[2]):
                    z = origin[2] + step[2] * k - p[2]
                    t = (x * (q[0] - p[0]) + y * (q[1] - p[1]) + z * (q[2] - p[2])) / dd
                    t = min(max(t, 0.0), 1.0)
                    u, v, w = x - t * (q[0] - p[0]), y - t * (q[1] - p[1]), z - t * (q[2] - p[2])
                    r = rp + t * (rq - rp)
                    fill = 0.5 - (np.sqrt(u * u + v * v + w * w) - r) / width
                    if fill > 0:
                        fill = min(fill, 1.0) * min(1.0, (2 * r / width) ** 1.2)
                        if fill > share[i, j, k]:
                            share[i, j, k] = fill
