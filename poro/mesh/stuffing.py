"""Isosurface stuffing: a body-centred cubic lattice cut along the zero of a signed distance.

Ref: Labelle & Shewchuk 2007, "Isosurface stuffing: fast tetrahedral meshes with good dihedral angles".
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from poro.arrays import Array
from poro.mesh.tetmesh import FACES, TetMesh, dihedral_angles, signed_volumes

# Largest cut-to-vertex distance, as a share of the edge, at which a lattice vertex is pulled onto the surface.
WARP_LONG, WARP_SHORT = 0.24999, 0.41189
MIN_DIHEDRAL_DEG = 8.0
_MEAN_EDGE = (2 + 4 * np.sqrt(3) / 2) / 6


def signed_distance(inside: Array, ras_from_ijk: Array, step_mm: float, smooth_mm: float) -> tuple[Array, Array]:
    """Smoothed distance to the mask's border, positive inside, on an isotropic RAS grid of `step_mm`.

    Returns the samples (ni, nj, nk) in mm and the grid's affine (4, 4). Raises ValueError for an empty mask.
    """
    if inside.ndim != 3 or not inside.any():
        raise ValueError(f"mask must be a non-empty 3-D array, got shape {inside.shape} with {inside.sum()} voxels")
    lower, upper = _box(inside)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (upper - lower) + lower - 0.5
    corners_ras = corners @ ras_from_ijk[:3, :3].T + ras_from_ijk[:3, 3]
    margin = 4 * step_mm + 2 * smooth_mm
    origin = corners_ras.min(axis=0) - margin
    shape = np.ceil((corners_ras.max(axis=0) + margin - origin) / step_mm).astype(int) + 1
    affine = np.diag([step_mm, step_mm, step_mm, 1.0])
    affine[:3, 3] = origin
    ijk_from_grid = np.linalg.inv(ras_from_ijk) @ affine
    # Averaging over a step's width first keeps thin structures that point sampling would alias away.
    spacing = np.linalg.norm(ras_from_ijk[:3, :3], axis=0)
    width = np.maximum(np.rint(step_mm / spacing), 1).astype(int)
    first = np.maximum(lower - 2 * width, 0)
    i, j, k = (slice(a, b) for a, b in zip(first, upper + 2 * width, strict=True))
    occupied = ndimage.uniform_filter(inside[i, j, k].astype(np.float32), width)
    # An even number of voxels is averaged about a place half a voxel before the one it is stored at.
    offset = ijk_from_grid[:3, 3] - first + np.where(width % 2 == 0, 0.5, 0.0)
    occupied = ndimage.affine_transform(occupied, ijk_from_grid[:3, :3], offset, tuple(shape), order=1)
    solid = occupied > 0.5
    distance = ndimage.distance_transform_edt(solid) - ndimage.distance_transform_edt(~solid)
    distance = (distance - np.sign(distance) / 2) * step_mm
    return ndimage.gaussian_filter(distance, smooth_mm / step_mm), affine


def _box(inside: Array) -> tuple[Array, Array]:
    spans = [np.flatnonzero(inside.any(axis=tuple(a for a in range(3) if a != axis))) for axis in range(3)]
    return np.array([s[0] for s in spans]), np.array([s[-1] + 1 for s in spans])


def stuff(inside: Array, ras_from_ijk: Array, edge_mm: float) -> TetMesh:
    """Tetrahedra of mean edge `edge_mm` that fill a mask (ni, nj, nk) bool; the largest connected piece is kept.

    Raises ValueError when the mask is empty or too thin to hold one element, or when an angle falls below 8 degrees.
    """
    return stuff_level_set(*mask_level(inside, ras_from_ijk, edge_mm), edge_mm)


def mask_level(inside: Array, ras_from_ijk: Array, edge_mm: float) -> tuple[Callable[[Array], Array], Array, Array]:
    """Level that `stuff` fills for a mask, positive inside, and the corners (3,) mm of the box that holds it.

    Raises ValueError when the mask is empty or the edge is not positive.
    """
    if not edge_mm > 0:
        raise ValueError(f"edge_mm must be positive, got {edge_mm}")
    step = edge_mm / 4
    distance, affine = signed_distance(inside, ras_from_ijk, step, 0.8 * step)
    inverse = np.linalg.inv(affine)

    def level(points: Array) -> Array:
        ijk = points @ inverse[:3, :3].T + inverse[:3, 3]
        return ndimage.map_coordinates(distance, ijk.T, order=1, mode="nearest")

    lower = affine[:3, 3]
    upper = lower + (np.array(distance.shape) - 1) * step
    return level, lower, upper


def stuff_level_set(level: Callable[[Array], Array], lower: Array, upper: Array, edge_mm: float) -> TetMesh:
    """Tetrahedra that fill {level > 0} inside the box lower..upper (3,) mm; level maps points (n, 3) to (n,)."""
    points, tets = _lattice(np.asarray(lower, float), np.asarray(upper, float), edge_mm / _MEAN_EDGE)
    value = level(points)
    tets = tets[(value[tets] > 0).any(axis=1)]
    if len(tets) == 0:
        raise ValueError(f"no element of {edge_mm} mm fits inside; lower edge_mm or check the mask")
    mesh = _largest_piece(*_cut_tets(*_warp(points, value, tets)))
    lowest = dihedral_angles(mesh).min()
    if lowest < MIN_DIHEDRAL_DEG:
        raise ValueError(f"smallest dihedral angle is {lowest:.1f} degrees, {MIN_DIHEDRAL_DEG} needed; smooth the mask")
    return mesh


def _lattice(lower: Array, upper: Array, a: float) -> tuple[Array, Array]:
    """BCC points and tetrahedra whose nodes 0-1 and 2-3 are joined by long edges (length a)."""
    n = np.ceil((upper - lower) / a).astype(int) + 2
    start = (lower + upper) / 2 - n * a / 2
    corner = np.arange((n[0] + 1) * (n[1] + 1) * (n[2] + 1)).reshape(n + 1)
    centre = np.arange(n.prod()).reshape(n) + corner.size
    grid = np.stack(np.meshgrid(*(np.arange(k + 1) for k in n), indexing="ij"), -1).reshape(-1, 3)
    cell = np.stack(np.meshgrid(*(np.arange(k) for k in n), indexing="ij"), -1).reshape(-1, 3) + 0.5
    points = start + a * np.concatenate([grid, cell])
    tets = []
    for axis in range(3):
        b = np.moveaxis(centre, axis, 0)
        c = np.moveaxis(corner, axis, 0)[1:-1]
        ring = [c[:, :-1, :-1], c[:, 1:, :-1], c[:, 1:, 1:], c[:, :-1, 1:]]
        for k in range(4):
            tets.append(np.stack([b[:-1], b[1:], ring[k], ring[(k + 1) % 4]], -1).reshape(-1, 4))
    return points, np.concatenate(tets)


def _cut_share(value: Array, i: Array, j: Array) -> Array:
    """Where the level crosses zero between nodes i and j, as a share of the way from i."""
    return value[i] / (value[i] - value[j])


def _warp(points: Array, value: Array, tets: Array) -> tuple[Array, Array, Array, Array]:
    """Pull vertices that lie too near a cut onto it; returns moved points, new values, lattice points, kept tets."""
    pairs = [(0, 1, WARP_LONG), (2, 3, WARP_LONG), *((i, j, WARP_SHORT) for i in (0, 1) for j in (2, 3))]
    closest = np.full(len(points), np.inf)
    target = points.copy()
    edge = np.concatenate([tets[:, [i, j]] for i, j, _ in pairs])
    alpha_of = np.repeat([alpha for *_, alpha in pairs], len(tets))
    crossing = value[edge[:, 0]] * value[edge[:, 1]] < 0
    edge, alpha_of = edge[crossing], alpha_of[crossing]
    for a, b in (edge.T, edge[:, ::-1].T):
        share = _cut_share(value, a, b)
        length = share * np.linalg.norm(points[b] - points[a], axis=1)
        near = np.flatnonzero(share < alpha_of)
        near = near[np.argsort(-length[near], kind="stable")]
        better = near[length[near] < closest[a[near]]]
        # Later writes win, and the list runs from far to near, so every vertex ends at its nearest cut.
        target[a[better]] = (points[a] + share[:, None] * (points[b] - points[a]))[better]
        closest[a[better]] = length[better]
    new_value = np.where(np.isfinite(closest), 0.0, value)
    keep = (new_value[tets] > 0).any(axis=1)
    return target, new_value, points, tets[keep]


def _cut_tets(points: Array, value: Array, lattice: Array, tets: Array) -> tuple[Array, Array]:
    """Replace every lattice tetrahedron by the stencil of its signs; returns points and tets, not yet oriented."""
    sign = np.sign(value[tets]).astype(int)
    order = np.argsort(-sign, axis=1, kind="stable")
    node = np.take_along_axis(tets, order, axis=1)
    plus, minus = (sign > 0).sum(axis=1), (sign < 0).sum(axis=1)
    keys: list[Array] = []
    count = len(points)
    base = np.int64(count)

    def cut(a: Array, b: Array) -> Array:
        """Provisional number of the cut point between a and b: minus its edge code, replaced at the end."""
        code = np.minimum(a, b).astype(np.int64) * base + np.maximum(a, b)
        keys.append(code)
        return -1 - code

    def toward(rows: Array, i: int, j: int, k: int) -> Array:
        """Whether the quad of faces (i+, j+, k-) is split from node i to the cut on j-k."""
        long_j = (order[rows, j] ^ 1) == order[rows, k]
        long_i = (order[rows, i] ^ 1) == order[rows, k]
        return np.where(long_i | long_j, long_j, node[rows, i] < node[rows, j])

    out = [node[minus == 0]]
    rows = np.flatnonzero((minus > 0) & (plus == 1))
    p = node[rows].astype(np.int64)
    for k in (1, 2, 3):
        negative = sign[rows, order[rows, k]] < 0
        p[negative, k] = cut(p[negative, 0], p[negative, k])
    out.append(p)

    rows = np.flatnonzero((plus == 2) & (minus == 1))
    p1, p2, z, n = node[rows].T
    c1, c2 = cut(p1, n), cut(p2, n)
    first = toward(rows, 0, 1, 3)
    out.append(np.stack([p1, p2, np.where(first, c2, c1), z], 1))
    out.append(np.stack([np.where(first, p1, p2), c2, c1, z], 1))

    rows = np.flatnonzero((plus == 3) & (minus == 1))
    p = node[rows]
    a = p[:, :3]
    b = np.stack([cut(p[:, k], p[:, 3]) for k in range(3)], 1)
    ahead = [toward(rows, i, j, 3) for i, j in ((0, 1), (1, 2), (0, 2))]
    out += _prisms(a, b, *ahead)

    rows = np.flatnonzero((plus == 2) & (minus == 2))
    p1, p2, n1, n2 = node[rows].T
    a = np.stack([p1, cut(p1, n1), cut(p1, n2)], 1)
    b = np.stack([p2, cut(p2, n1), cut(p2, n2)], 1)
    ahead = [toward(rows, 0, 1, 2), np.ones(len(rows), bool), toward(rows, 0, 1, 3)]
    # The free quad follows the other two so that the three diagonals never form a cycle.
    ahead[1] = ~ahead[0] | ahead[2]
    out += _prisms(a, b, *ahead)

    result = np.concatenate([o.astype(np.int64) for o in out])
    code = np.unique(np.concatenate(keys)) if keys else np.zeros(0, np.int64)
    i, j = code // base, code % base
    cuts = lattice[i] + _cut_share(value, i, j)[:, None] * (lattice[j] - lattice[i])
    cut_rows = result < 0
    result[cut_rows] = count + np.searchsorted(code, -1 - result[cut_rows])
    return np.concatenate([points, cuts]), result


def _prisms(a: Array, b: Array, ahead01: Array, ahead12: Array, ahead02: Array) -> list[Array]:
    """Three tetrahedra per prism a (k, 3), b (k, 3); aheadij: the quad's diagonal runs from a_i to b_j."""
    rank = np.stack([2 - (ahead01 * 1 + ahead02), 2 - (~ahead01 * 1 + ahead12), 2 - (~ahead12 * 1 + ~ahead02)], 1)
    order = np.argsort(rank, axis=1)
    x, y, z = np.take_along_axis(a, order, axis=1).T
    u, v, w = np.take_along_axis(b, order, axis=1).T
    return [np.stack(q, 1) for q in ((x, y, z, w), (x, y, v, w), (x, u, v, w))]


def _largest_piece(points: Array, tets: Array) -> TetMesh:
    volume = signed_volumes(points, tets)
    tets = np.where((volume < 0)[:, None], tets[:, [0, 1, 3, 2]], tets)
    faces = np.sort(tets[:, FACES].reshape(-1, 3), axis=1)
    n = np.int64(len(points))
    code = (faces[:, 0] * n + faces[:, 1]) * n + faces[:, 2]
    order = np.argsort(code, kind="stable")
    twin = np.flatnonzero(code[order][1:] == code[order][:-1])
    owner = order // 4
    m = len(tets)
    graph = coo_matrix((np.ones(len(twin)), (owner[twin], owner[twin + 1])), shape=(m, m))
    _, label = connected_components(graph, directed=False)
    tets = tets[label == np.argmax(np.bincount(label, np.abs(volume)))]
    used, local = np.unique(tets, return_inverse=True)
    return TetMesh(points[used], local.reshape(-1, 4))
