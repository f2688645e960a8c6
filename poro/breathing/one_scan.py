"""A lung of which one scan is known: where it is held, where it slides, what pulls it. Ref: Li & Porikli 2014, sec. 3.

The apex is held; the flanks move in the axial plane alone; beside the spine tissue slides along the body alone; the
diaphragm is pulled towards the feet by a traction, and the whole surface outward by the transpulmonary pressure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import bsr_matrix, coo_matrix, diags
from scipy.sparse.csgraph import connected_components

from poro.arrays import Array
from poro.breathing.elastic import Side, caudal, depth_of
from poro.breathing.equilibrium import ConstraintTerms, Scene, tree_of
from poro.breathing.inflation import Filled, fill_to
from poro.fem.constitutive import ConstitutiveModel
from poro.fem.hyperelastic import ogden_lung
from poro.fem.tissue import GRAVITY_KPA_PER_MM, Tissue
from poro.mesh.tetmesh import TetMesh
from poro.mesh.trisurface import TriSurface

APEX_SHARE, FLANK_SHARE, SPINE_SHARE = 0.08, (0.1, 0.7), 0.4
"""Shares of the lung's height or depth: apex from the top; flanks, height from the bottom; spine from the back."""
FACING = 0.5
"""Least cosine between a surface and the way it is said to face."""
TRACTION = 0.25
"""Of the diaphragm over the pressure. Ref: Li & Porikli 2014, section 5 (0.005 beside 0.02)."""
CHEST_SHARE = 0.45
"""Of a breath's volume that the ribs make, supine; the diaphragm makes the rest. Ref: Konno & Mead 1967 (two ways)."""
WALL_KPA_PER_MM, DIAPHRAGM_KPA_PER_MM = 0.3, 0.03
"""Constraints that ask the border for that motion: along the normal of chest, back and mediastinum, along the body for
the diaphragm. The paper lets the border go free; nothing but the apex then keeps a lung from turning."""
MASS_KG = 0.23
"""Weight by which tissue sags at the end of a deep expiration, as in `elastic.Breathing`; none in a quiet one."""
FIRM = 1e3
"""Stiffness of what is held, over the tissue's own."""


@dataclass(frozen=True)
class Regions:
    """Parts of a lung's border, (n,) bool over the surface's nodes."""

    apex: Array
    flank: Array
    spine: Array
    diaphragm: Array


def regions(surface: TriSurface, side: Side, towards_feet: float) -> Regions:
    """Apex, flanks, spine's side and diaphragm of a lung; towards_feet: +1 where z grows to the feet, else -1.

    Told by height, depth and the way the surface faces, where the paper fits curves to slices. Raises ValueError where
    no part of the surface looks to the feet.
    """
    points, normal = surface.points, surface.node_normals
    up = -towards_feet * points[:, 2]
    height = (up - up.min()) / np.ptp(up)
    depth = (points[:, 1] - points[:, 1].min()) / np.ptp(points[:, 1])
    inward = normal[:, 0] * (1.0 if side == "left" else -1.0)
    down = (towards_feet * normal[:, 2] > FACING) & (height < 0.6)
    if not down.any():
        raise ValueError("no part of the lung's surface looks to the feet; give a whole lung")
    diaphragm = _largest_piece(surface, down)
    spine = (inward > FACING) & (depth < SPINE_SHARE) & ~diaphragm
    low, high = FLANK_SHARE
    flank = (inward < -0.7) & (height > low) & (height < high) & ~diaphragm & (depth > 0.5)
    return Regions(height > 1 - APEX_SHARE, flank, spine, diaphragm)


@dataclass(frozen=True)
class OneScan:
    """The scene of a lung that no other scan constrains. pull: (n, 3) kPa mm2 of a traction of 1 kPa;
    wanted: (n, 3) kPa mm2 of the constraints that ask for a breath of 1 mm3; weight: (n, 3) kPa mm2."""

    mesh: TetMesh
    material: ConstitutiveModel
    constraints: ConstraintTerms
    pull: Array
    regions: Regions
    bulk_kpa: float
    wanted: Array
    weight: Array

    def states(self, volumes_mm3: Sequence[float], traction: float = TRACTION) -> list[Filled]:
        """The lung at each volume, one after the other; traction: of the diaphragm, over the pressure."""
        rest, tree = float(self.mesh.volumes.sum()), tree_of(self.mesh)
        found: list[Filled] = []
        u, before = np.zeros_like(self.mesh.points), 0.0
        for wanted in volumes_mm3:
            share = wanted / rest - 1
            tension = traction * self.bulk_kpa * np.log(wanted / rest)
            start = u * (share / before) if abs(before) > 1e-6 and abs(share / before) < 3 else u
            sag = depth_of(wanted / rest) * (1.0 if wanted < rest else -1.0)
            force = tension * self.pull + (wanted - rest) * self.wanted + sag * self.weight
            constraints = ConstraintTerms(self.constraints.matrix, self.constraints.force + force)
            scene = Scene(self.mesh, self.material, constraints, tree=tree)
            filled = fill_to(scene, wanted, start)
            found.append(filled)
            u, before = filled.u, share
        return found

    def guided(self, known: ConstraintTerms, breath_mm3: float) -> OneScan:
        """The scene of a lung whose motion is known over a breath of `breath_mm3`: constraints that ask for it replace
        all that is supposed of border, traction and weight."""
        none = np.zeros_like(self.mesh.points)
        constraints = ConstraintTerms(known.matrix, none)
        return replace(self, constraints=constraints, pull=none, wanted=known.force / breath_mm3, weight=none)


def one_scan(mesh: TetMesh, side: Side) -> OneScan:
    """The scene of a lung's mesh, of Ogden's tissue. Raises ValueError without a diaphragm."""
    tissue, surface, feet = Tissue(), mesh.boundary, caudal(mesh)
    where = regions(surface, side, feet)
    size = np.sqrt(surface.node_areas)
    held = np.zeros_like(mesh.points)
    firm = FIRM * tissue.young_kpa * size
    nodes = surface.nodes
    held[nodes[where.apex]] = firm[where.apex, None]
    held[nodes[where.spine], :2] = firm[where.spine, None]
    held[nodes[where.flank], 2] = firm[where.flank]
    pull = np.zeros_like(mesh.points)
    pull[nodes[where.diaphragm], 2] = feet * surface.node_areas[where.diaphragm]
    anchors = held + 1e-6 * tissue.young_kpa * np.cbrt(mesh.node_volumes)[:, None]
    matrix, wanted = _wall(mesh, side, where, feet)
    constraints = ConstraintTerms((diags(anchors.ravel()) + matrix).tocsr(), np.zeros_like(mesh.points))
    bulk = tissue.lame_kpa + 2 * tissue.shear_kpa / 3
    weight = np.zeros_like(mesh.points)
    weight[:, 1] = -MASS_KG * 1e9 * GRAVITY_KPA_PER_MM * mesh.node_volumes / mesh.volumes.sum()
    return OneScan(mesh, ogden_lung(tissue), constraints, pull, where, bulk, wanted, weight)


def _wall(mesh: TetMesh, side: Side, where: Regions, feet: float) -> tuple[bsr_matrix, Array]:
    """Constraints of the border, and their forces (n, 3) when they ask for a breath of 1 mm3.

    The chest's front and flank go outward by one distance, the diaphragm towards the feet by another; back and
    mediastinum stay.
    """
    surface = mesh.boundary
    normal, area = surface.node_normals, surface.node_areas
    inward = normal[:, 0] * (1.0 if side == "left" else -1.0) > FACING
    back = normal[:, 1] < -FACING  # the patient lies on it
    chest = ~where.diaphragm & ~inward & ~back
    stiffness = np.where(where.diaphragm, DIAPHRAGM_KPA_PER_MM, WALL_KPA_PER_MM) * area
    along = np.where(where.diaphragm[:, None], [0.0, 0.0, feet], normal)
    down = float((area * feet * normal[:, 2])[where.diaphragm].sum())
    step = np.where(chest, CHEST_SHARE / area[chest].sum(), 0.0) + np.where(
        where.diaphragm, (1 - CHEST_SHARE) / down, 0.0
    )
    blocks, force = np.zeros((len(mesh.points), 3, 3)), np.zeros_like(mesh.points)
    blocks[surface.nodes] = stiffness[:, None, None] * along[:, :, None] * along[:, None, :]
    force[surface.nodes] = (stiffness * step)[:, None] * along
    n = len(mesh.points)
    return bsr_matrix((blocks, np.arange(n), np.arange(n + 1))), force


def _largest_piece(surface: TriSurface, chosen: Array) -> Array:
    edges = surface.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = edges[chosen[edges].all(axis=1)]
    n = len(surface.points)
    _, label = connected_components(coo_matrix((np.ones(len(edges)), edges.T), shape=(n, n)), directed=False)
    return chosen & (label == np.argmax(np.bincount(label, surface.node_areas * chosen)))
