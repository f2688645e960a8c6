"""How a lung's tissue moves when its owner, on the back, breathes out: an elastic lung that slides on its wall, sags
under its weight, is held lengthwise by its bronchi and turns with the ribs.

Of the breath only the shape before and after is known. Lengths in mm, RAS but for the sign of z, which the lung's own
shape decides; moduli are those of `poro.fem.tissue.Tissue`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, diags, vstack

from poro.arrays import Array
from poro.breathing.affine import Affine
from poro.fem import Tissue
from poro.fem.constraints import point_constraints
from poro.fem.forms import stiffness
from poro.fem.solid import anchor
from poro.fem.tissue import GRAVITY_KPA_PER_MM
from poro.linalg import linear_solver
from poro.mesh import TetMesh, closest_points
from poro.mesh.patches import INWARD

Side = Literal["left", "right"]

ROUNDS = 6
WALL_KPA_PER_MM = 0.3
"""Ten times what 100 mm of tissue resist with: the wall gives way by less than 2 mm."""
REACH_MM, ROBUST_MM = 40.0, 20.0
"""Wall farther than `REACH_MM` is not taken for the same wall; at `ROBUST_MM` a point pulls half as hard."""
SLIDES = 0.5
"""Cosine up to which two surfaces face the same way."""


@dataclass(frozen=True)
class Lung:
    """One lung of a person: inspired and expired shape, and no landmark."""

    side: Side
    inspired: TetMesh
    expired: TetMesh


@dataclass(frozen=True)
class Breathing:
    """What acts on a lung that breathes out, besides its wall.

    mass_kg: weight beyond what the inspired lung bears, of one lung and in units of the tissue's stiffness;
    held_kpa_mm: stiffness of the bronchi along the body, in all, within about `held_mm` of the hilum; turn: share of
    the ribs' turn that the tissue follows; mediastinal: trust in the mediastinal wall, where masks are cut at will.
    """

    mass_kg: float = 0.23
    held_kpa_mm: float = 300.0
    held_mm: float = 100.0
    turn: float = 1.0
    mediastinal: float = 0.15


WALL_ALONE = Breathing(0.0, 0.0, 100.0, 0.0, 1.0)
QUIET, DEEP = 0.8, 0.6
"""Volume left of the inspired one: a quiet breath leaves more than the first, an expiration to the end less than the
second."""


def depth_of(volume_ratio: float) -> float:
    """How far a breath goes beyond a quiet one, 0 to 1, by the volume of either state over the other's."""
    ratio = min(volume_ratio, 1 / volume_ratio)
    return float(np.clip((QUIET - ratio) / (QUIET - DEEP), 0, 1))


def acting_at(depth: float) -> Breathing:
    """What acts in a breath of a depth, 0 quiet to 1 to the end of expiration.

    A lung near its resting recoil follows its wall; one that has emptied sags, and its bronchi and ribs are felt.
    """
    quiet, deep = WALL_ALONE, Breathing()
    return Breathing(
        depth * deep.mass_kg,
        depth * deep.held_kpa_mm,
        deep.held_mm,
        depth * deep.turn,
        (1 - depth) * quiet.mediastinal + depth * deep.mediastinal,
    )


def breathe_out(lung: Lung, acting: Breathing) -> Array:
    """Nodes (n, 3) of the inspired lung's mesh after expiration.

    The lung stretched to the expired one's centre and spread rests without stress; from there the wall, both surfaces'
    nearest points along the normals alone, pulls it, and what acts within.
    """
    tissue = Tissue()
    start = spread_map(lung.inspired, lung.expired)
    rest = TetMesh(start(lung.inspired.points), lung.inspired.tets)
    held, pull = bronchi(lung, acting)
    weight = np.zeros_like(rest.points)
    weight[:, 1] = -acting.mass_kg * 1e9 * GRAVITY_KPA_PER_MM * rest.node_volumes / lung.expired.volumes.sum()
    within = stiffness(rest, tissue.lame_kpa, tissue.shear_kpa) + diags(anchor(rest, tissue))
    within = within + diags(np.column_stack([0 * held, 0 * held, held]).ravel())
    force = weight
    force[:, 2] += held * (lung.inspired.points[:, 2] + pull - rest.points[:, 2])
    u = np.zeros_like(rest.points)
    for number in range(ROUNDS):
        matrix, wall = _wall(lung, rest, u, acting.mediastinal, ROBUST_MM if number >= ROUNDS // 2 else np.inf)
        solver = linear_solver((within + matrix).tocsr(), rest.points)
        u = solver.solve((force + wall).ravel()).reshape(-1, 3)
    return rest.points + u


def spread_map(start: TetMesh, onto: TetMesh) -> Affine:
    """Stretch along the axes that gives a body another's centre and spread (standard deviations)."""
    (a, spread_a), (b, spread_b) = _moments(start), _moments(onto)
    return Affine(np.diag(spread_b / spread_a), b - spread_b / spread_a * a)


def caudal(lung: TetMesh) -> float:
    """+1 where z grows towards the feet, -1 in true RAS: the diaphragm faces the feet squarely, and what faces the head
    slants. Images whose slices are stacked the wrong way round are common.
    """
    surface = lung.boundary
    return float(np.sign(surface.areas @ surface.normals[:, 2] ** 3))


def hilum(lung: TetMesh, side: Side) -> Array:
    """Place (3,) of the hilum when only the shape is known: the innermost point beside the lung's centre."""
    inward = 1.0 if side == "left" else -1.0
    centre = np.average(lung.points, axis=0, weights=lung.node_volumes)
    beside = lung.points[(np.abs(lung.points - centre)[:, 1:] < 15).all(axis=1)]
    return np.array([inward * (inward * beside[:, 0]).max(), centre[1], centre[2]])


def bronchi(lung: Lung, acting: Breathing) -> tuple[Array, Array]:
    """Constraints along the body: stiffness (n,) kPa mm, which fades with distance from the hilum, and motion (n,) mm
    that they ask for: none at the hilum's height, and towards the feet in front of it.

    Ribs slant, about 45 degrees, and turn about the spine: as the front sinks it falls as far (pump handle), and the
    whole turns by what the chest loses of its depth.
    """
    mesh = lung.inspired
    root = hilum(mesh, lung.side)
    near = np.exp(-(((mesh.points - root) / acting.held_mm) ** 2).sum(axis=1)) * mesh.node_volumes
    lost = 1 - np.ptp(lung.expired.points[:, 1]) / np.ptp(mesh.points[:, 1])
    fall = caudal(mesh) * acting.turn * lost * (mesh.points[:, 1] - root[1])
    return acting.held_kpa_mm * near / near.sum(), fall


def _wall(lung: Lung, rest: TetMesh, u: Array, mediastinal: float, robust_mm: float) -> tuple[csr_matrix, Array]:
    """Constraints of the expired wall, from its points to the lung's surface and back, along the wall's normals."""
    inner, onto = rest.boundary, lung.expired.boundary
    moved = inner.moved(inner.points + u[inner.nodes])
    there, back = closest_points(moved, onto.points), closest_points(onto, moved.points)
    corners = inner.nodes[inner.triangles[there.triangle]]
    operator = vstack(
        [
            _rows(corners, there.barycentric, len(u)),
            _rows(inner.nodes[:, None], np.ones((len(inner.nodes), 1)), len(u)),
        ]
    ).tocsr()
    normal = np.concatenate([onto.node_normals, onto.normals[back.triangle]])
    facing = np.concatenate([moved.normals[there.triangle], moved.node_normals])
    gap = np.concatenate([onto.points - there.points, back.points - moved.points])
    near = np.linalg.norm(gap, axis=1) < REACH_MM
    used = near & (np.einsum("qd,qd->q", normal, facing) > SLIDES)
    along = np.einsum("qd,qd->q", gap, normal)
    inward = normal[:, 0] * (1.0 if lung.side == "left" else -1.0) > INWARD
    area = np.concatenate([onto.node_areas, moved.node_areas]) * used / 2
    weight = WALL_KPA_PER_MM * area * np.where(inward, mediastinal, 1.0) / (1 + (along / robust_mm) ** 2)
    wanted = along + np.einsum("qd,qd->q", operator @ u, normal)
    return point_constraints(
        operator, weight[:, None, None] * normal[:, :, None] * normal[:, None, :], wanted[:, None] * normal
    )


def _rows(nodes: Array, weights: Array, n: int) -> csr_matrix:
    rows = np.repeat(np.arange(len(nodes)), nodes.shape[1])
    return coo_matrix((weights.ravel(), (rows, nodes.ravel())), shape=(len(nodes), n)).tocsr()


def _moments(mesh: TetMesh) -> tuple[Array, Array]:
    centre = np.average(mesh.points, axis=0, weights=mesh.node_volumes)
    return centre, np.sqrt(np.average((mesh.points - centre) ** 2, axis=0, weights=mesh.node_volumes))
