"""Lung, chest and what lies below the diaphragm as three elastic bodies that slide on each other, moved by pressures
on patches of the chest's inner wall and of the diaphragm; and the fit of those pressures.

Ref: Fuerst et al. (A Personalized Biomechanical Model for Respiratory Motion Prediction), eqs. 1-3, section 2.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix, csr_matrix, diags, hstack

from poro.arrays import Array
from poro.breathing.cavity import rising
from poro.breathing.elastic import Breathing, Lung, Side, caudal, hilum
from poro.breathing.equilibrium import ConstraintTerms
from poro.fem.constraints import interpolation_matrix, point_constraints
from poro.fem.forms import deformation_gradient, eigenstress_load, tangent_stiffness
from poro.fem.tissue import Tissue
from poro.linalg.solver import linear_solver
from poro.mesh import TetMesh, TriSurface, closest_points, stuff
from poro.mesh.locate import locate

LUNG, BODY = Tissue(young_kpa=0.9, poisson=0.4), Tissue(young_kpa=7.8, poisson=0.43)
"""Ref: Fuerst, section 2.2."""
SHELL_MM, APART_MM = 30.0, 5.0
"""Thickness of the chest about the lung, and the gap between it and the body below the diaphragm."""
SECTORS, STOREYS, QUARTERS = 3, 3, 4
"""Patches about the lung and along it, nine as in the paper, and on the diaphragm: its middle and four quarters about
it, since it falls farther on one side than on the other. 14 pressures."""
STICK_KPA_PER_MM = 0.5
"""Sliding contact that neither lets bodies part nor enter each other: it gives way by 1 mm at 0.5 kPa."""
BEND_MM = 10.0
"""Least radius of the walls' bend."""
ANCHOR, FIRM = 0.2, 30.0
"""Stiffness, over the tissue's own, by which chest and body below are held everywhere; back and mediastinum are held
`FIRM` times as firmly, and so is the body below, sideways."""
TETHER, HILUM_MM = 0.3, 25.0
"""Stiffness, over the tissue's own, by which the hilum is held, and how far that reaches; Fuerst misses it."""
ROUNDS = 10
"""Of contact, at most."""
STILL_MM, UNSTEADY_MM = 0.05, 0.5
"""Mean motion of the nodes in a round of contact at which the bodies have settled, and from which on they do not."""


@dataclass(frozen=True)
class Thorax:
    """Three bodies in one mesh that share no node. moduli: (m, 2) kPa, Lame's of every tetrahedron; lung: its nodes
    come first in the mesh; walls: what the lung slides on, its own border at rest, as chest and the body below carry
    it; carried: (w, n) weights of the mesh's nodes in the walls'; patch: (t,) of every triangle of `walls`; anchors:
    constraints that hold chest, body below and the lung's bronchi; load: (n, 3) kPa mm2 on the lung at the end of an
    inspiration.
    """

    mesh: TetMesh
    moduli: Array
    lung: TetMesh
    walls: TriSurface
    carried: csr_matrix
    patch: Array
    anchors: csr_matrix
    load: Array

    @property
    def patches(self) -> int:
        """Number of pressures."""
        return int(self.patch.max()) + 1

    def moved_walls(self, u: Array) -> TriSurface:
        """The walls where displacements u (n, 3) mm of the mesh carry them."""
        return self.walls.moved(self.walls.points + self.carried @ u)


@dataclass(frozen=True)
class Pressed:
    """Bodies under pressures p (k,) kPa. u: (n, 3) mm; by_pressure: (n, 3, k) mm/kPa; moving_mm: mean motion of the
    nodes in the last round of contact.
    """

    p: Array
    u: Array
    by_pressure: Array
    moving_mm: float

    @property
    def settled(self) -> bool:
        """Whether the bodies have found their balance."""
        return self.moving_mm < UNSTEADY_MM


EDGE_MM = 22.0
"""Of the tetrahedra of the chest and of what lies below."""


def thorax(inside: Array, ras_from_ijk: Array, pair: Lung, acting: Breathing) -> Thorax:
    """Chest and sub-diaphragm bodies about the mask of an expired lung, voxels along R, A, S.

    What lies below the lung is found by casting the lung towards the feet. Raises ValueError where a body is too thin.
    """
    lung, towards = pair.expired, caudal(pair.expired)
    spacing = np.linalg.norm(ras_from_ijk[:3, :3], axis=0)
    step = np.maximum(np.rint(4.0 / spacing).astype(int), 1)
    margin = np.ceil((SHELL_MM + 8) / spacing / step).astype(int)
    coarse = np.pad(inside[:: step[0], :: step[1], :: step[2]], [(m, m) for m in margin])
    affine = ras_from_ijk.copy()
    affine[:3, :3] = ras_from_ijk[:3, :3] * step
    affine[:3, 3] -= affine[:3, :3] @ margin
    spacing = spacing * step
    away = ndimage.distance_transform_edt(~coarse, sampling=spacing)
    near = away < SHELL_MM
    # A spike of chest in a cleft of the lung, as thin as its mesh is coarse, would swing about under pressure.
    cleft = ndimage.distance_transform_edt(away < EDGE_MM / 2, sampling=spacing) > EDGE_MM / 2
    towards_feet = (towards > 0) == (ras_from_ijk[2, 2] > 0)
    order = slice(None) if towards_feet else slice(None, None, -1)
    above = np.logical_or.accumulate(coarse[:, :, order], axis=2)[:, :, order]
    last = np.logical_or.accumulate(coarse[:, :, order][:, :, ::-1], axis=2)[:, :, ::-1][:, :, order]
    below = near & above & ~last & ~coarse
    below = _largest(below)
    chest = near & ~coarse & ~cleft & (ndimage.distance_transform_edt(~below, sampling=spacing) > APART_MM)
    bodies = [stuff(chest, affine, EDGE_MM), stuff(below, affine, EDGE_MM)]
    starts = np.cumsum([0, len(lung.points), len(bodies[0].points), len(bodies[1].points)])
    points = np.concatenate([lung.points, *(body.points for body in bodies)])
    tets = np.concatenate([mesh.tets + start for mesh, start in zip((lung, *bodies), starts[:-1], strict=True)])
    kinds = np.repeat([0, 1, 1], [len(lung.tets), *(len(body.tets) for body in bodies)])
    mesh = TetMesh(points, tets)
    walls = lung.boundary
    carried, is_below = _carried(walls, bodies, len(lung.points))
    constraints, load = np.zeros(3 * len(points)), np.zeros_like(points)
    bronchi, load[: len(lung.points)] = rising(pair, acting, LUNG)
    constraints[: 3 * len(lung.points)] = bronchi.diagonal()
    anchors = (_anchors(bodies, starts, points, pair, towards) + diags(constraints)).tocsr()
    moduli = np.array([[tissue.lame_kpa, tissue.shear_kpa] for tissue in (LUNG, BODY)])[kinds]
    return Thorax(mesh, moduli, lung, walls, carried, _patches(walls, is_below, lung), anchors, load)


def press(scene: Thorax, p: Array, start: Array, share: float = 1.0, rounds: int = ROUNDS) -> Pressed:
    """Balance of the bodies under pressures p (k,) kPa from displacements (n, 3) mm, and its derivative by them.

    Tissue is linear in a frame that turns with every element; that frame, contact and the pressures' direction follow
    the bodies, round by round. Ref: Mueller & Gross 2004 (corotational elasticity).
    """
    u, k, moving = start, len(p), np.inf
    answers = np.zeros((*start.shape, k + 1))
    for _ in range(rounds):
        forces = _patch_forces(scene, u)
        contact = _contact(scene, u)
        moduli, stress = _turned(scene, u)
        tangent = tangent_stiffness(scene.mesh, moduli)
        matrix = (tangent + contact.matrix + scene.anchors).tocsr()
        known = (tangent @ u.ravel()).reshape(-1, 3) - eigenstress_load(scene.mesh, stress)
        right = np.concatenate([(known + contact.force + share * scene.load)[:, :, None], forces], axis=2)
        answers = linear_solver(matrix, scene.mesh.points).solve(right.reshape(-1, k + 1)).reshape(answers.shape)
        last, u = u, answers[:, :, 0] + answers[:, :, 1:] @ p
        moving = float(np.linalg.norm(u - last, axis=1).mean())
        if moving < STILL_MM:
            break
    return Pressed(p, u, answers[:, :, 1:], moving)


def _turned(scene: Thorax, u: Array) -> tuple[Array, Array]:
    """Moduli (m, 3, 3, 3, 3) and first Piola-Kirchhoff stress (m, 3, 3), kPa, of elements that turn as they are."""
    f = deformation_gradient(scene.mesh, u)
    left, _, right = np.linalg.svd(f)
    left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
    turn = left @ right
    strain = np.einsum("mai,maj->mij", turn, f) - np.eye(3)
    strain = (strain + strain.transpose(0, 2, 1)) / 2
    lame, shear = scene.moduli.T
    stress = 2 * shear[:, None, None] * strain + (lame * np.trace(strain, axis1=1, axis2=2))[:, None, None] * np.eye(3)
    pairs = np.einsum("mij,mkl->mijkl", turn, turn)
    along = shear[:, None, None, None, None] * (
        np.einsum("ik,jl->ijkl", np.eye(3), np.eye(3)) + pairs.transpose(0, 1, 4, 3, 2)
    )
    return lame[:, None, None, None, None] * pairs + along, turn @ stress


def _contact(scene: Thorax, u: Array) -> ConstraintTerms:
    """Contact along the walls' normals that keeps the lung's border on the walls, wherever it slid to.

    Normals are interpolated between the walls' nodes: those of flat triangles turn at once where a node slides over an
    edge, and it then goes back and forth for ever. What the walls' bend adds to the tangent is bounded from above, as a
    spring along the walls to where the node is: it slows a round down and changes no balance.
    """
    border, walls = scene.lung.boundary, scene.moved_walls(u)
    here = border.points + u[border.nodes]
    near = closest_points(walls, here)
    normal = np.einsum("qk,qkd->qd", near.barycentric, walls.node_normals[walls.triangles[near.triangle]])
    normal = normal / np.linalg.norm(normal, axis=1)[:, None]
    rows, n = np.arange(len(here)), len(u)
    at_wall = coo_matrix(
        (near.barycentric.ravel(), (np.repeat(rows, 3), walls.triangles[near.triangle].ravel())),
        shape=(len(here), len(walls.points)),
    )
    operator = (
        coo_matrix((np.ones(len(here)), (rows, border.nodes)), (len(here), n)) - at_wall @ scene.carried
    ).tocsr()
    apart = np.einsum("qd,qd->q", here - near.points, normal)
    area = border.moved(here).node_areas
    along = normal[:, :, None] * normal[:, None, :]
    bent = (np.abs(apart) / BEND_MM)[:, None, None] * (np.eye(3) - along)
    stiffness = STICK_KPA_PER_MM * area[:, None, None] * (along + bent)
    return ConstraintTerms(*point_constraints(operator, stiffness, operator @ u - apart[:, None] * normal))


def _patch_forces(scene: Thorax, u: Array) -> Array:
    """Nodal forces (n, 3, k) kPa mm2 per kPa of every patch, pulling the walls away from the lung."""
    walls = scene.moved_walls(u)
    forces = np.zeros((len(walls.points), scene.patches, 3))
    for corner in range(3):
        np.add.at(forces, (walls.triangles[:, corner], scene.patch), walls.area_vectors / 3)
    carried = (scene.carried.T @ forces.reshape(len(walls.points), -1)).reshape(len(u), scene.patches, 3)
    return np.asarray(np.moveaxis(carried, 1, 2))


def _carried(walls: TriSurface, bodies: Sequence[TetMesh], lung_nodes: int) -> tuple[csr_matrix, Array]:
    """Weights (w, n) by which the nearer body carries every point of the walls, and whether (w,) it is the one below.

    Bodies are coarser than the lung: what it slides on is as smooth as itself.
    """
    held = [locate(body, walls.points) for body in bodies]
    is_below = held[1].distance < held[0].distance
    weights = [
        diags((is_below == below).astype(float)) @ interpolation_matrix(where, len(body.points))
        for where, body, below in zip(held, bodies, (False, True), strict=True)
    ]
    return hstack([csr_matrix((len(walls.points), lung_nodes)), *weights]).tocsr(), is_below


def _patches(walls: TriSurface, is_below: Array, lung: TetMesh) -> Array:
    """Patch (t,) of every triangle: sectors and storeys of the chest; quarters of the diaphragm about its middle."""
    below = is_below[walls.triangles].sum(axis=1) >= 2
    middle = walls.points[walls.triangles].mean(axis=1)
    centre = np.average(lung.points, axis=0, weights=lung.node_volumes)
    height = np.zeros(len(middle), int)
    height[~below] = np.argsort(np.argsort(middle[~below, 2])) * STOREYS // (~below).sum()
    patch = _sector(middle - centre, SECTORS) + SECTORS * height
    if below.any():
        aside = middle - middle[below].mean(axis=0)
        inner = np.linalg.norm(aside[:, :2] / aside[below, :2].std(axis=0), axis=1) < 1
        patch = np.where(below, SECTORS * STOREYS + np.where(inner, QUARTERS, _sector(aside, QUARTERS)), patch)
    return np.asarray(np.unique(patch, return_inverse=True)[1])


def _sector(offset: Array, count: int) -> Array:
    """Sector (t,) of offsets (t, 3) by their angle about the body's axis."""
    angle = np.arctan2(offset[:, 1], offset[:, 0])
    return np.asarray(np.floor((angle + np.pi) / (2 * np.pi) * count).astype(int) % count)


def _anchors(bodies: Sequence[TetMesh], starts: Array, points: Array, pair: Lung, towards: float) -> csr_matrix:
    """Constraints that hold the chest, firmly at its back, and the far side of what is below."""
    held = np.zeros((len(points), 3))
    chest, below = bodies
    lung, side = pair.expired, pair.side
    size = BODY.young_kpa * np.cbrt(chest.node_volumes)
    inward = chest.points[:, 0] * (1.0 if side == "left" else -1.0)
    firm = (chest.points[:, 1] < np.quantile(chest.points[:, 1], 0.12)) | (inward > np.quantile(inward, 0.85))
    held[starts[1] : starts[2]] = (ANCHOR * size * np.where(firm, FIRM, 1.0))[:, None]
    size = BODY.young_kpa * np.cbrt(below.node_volumes)
    depth = towards * below.points[:, 2]
    along = np.where(depth > np.quantile(depth, 0.7), 1.0, 0.1)
    # Ribs and belly wall, which no body here stands for, keep it from moving sideways.
    aside = np.full(len(along), FIRM)
    held[starts[2] : starts[3]] = (ANCHOR * size)[:, None] * np.column_stack([aside, aside, along])
    held[: starts[1]] = (TETHER * LUNG.young_kpa * np.cbrt(lung.node_volumes) * _near_hilum(lung, side))[:, None]
    return diags(held.ravel()).tocsr()


def _near_hilum(lung: TetMesh, side: Side) -> Array:
    """How near (n,) the lung's nodes lie to where bronchi and vessels tether it, 1 at the hilum."""
    return np.exp(-(((lung.points - hilum(lung, side)) / HILUM_MM) ** 2).sum(axis=1)) + 1e-6


def _largest(inside: Array) -> Array:
    labels, count = ndimage.label(inside)
    if count == 0:
        return inside
    size = np.bincount(labels.ravel())
    size[0] = 0
    return labels == np.argmax(size)
