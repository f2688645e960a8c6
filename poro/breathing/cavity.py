"""The scene of an inspiration: an expired lung that fills the inspired cavity, sliding on its wall.

What acts besides is what acts in `elastic`, turned round: as the lung fills, the weight that it had sagged by lessens,
bronchi hold it lengthwise and the front rises with the ribs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix, diags

from poro.arrays import Array
from poro.breathing.elastic import WALL_KPA_PER_MM, Breathing, Lung, caudal, hilum, spread_map
from poro.breathing.equilibrium import Cavity, ConstraintTerms, Scene, tree_of
from poro.contact.levelset import level_set
from poro.fem.constitutive import ConstitutiveModel, neo_hookean
from poro.fem.tissue import GRAVITY_KPA_PER_MM, Tissue
from poro.linalg.dissection import Tree
from poro.mesh.tetmesh import TetMesh

STEP_MM, SMOOTH_MM = 5.0, 2.5
"""Of the samples of the cavity's distance."""


@dataclass(frozen=True)
class Inflating:
    """Everything about one lung's inspiration that no phase changes.

    guess: (n, 3) mm, the lung laid out by its spread; load: (n, 3) kPa mm2 at the end of the way; full_mm3: volume of
    the inspired lung. The cavity's offsets say how far border nodes lie behind the wall at the start.
    """

    mesh: TetMesh
    material: ConstitutiveModel
    cavity: Cavity
    matrix: csr_matrix
    load: Array
    guess: Array
    full_mm3: float
    tree: Tree

    def volume(self, share: float) -> float:
        """Volume in mm3 at a share of the way."""
        rest = float(self.mesh.volumes.sum())
        return rest + share * (self.full_mm3 - rest)

    def at(self, share: float) -> Scene:
        """What acts at a share of the way; nodes that start behind the wall are let back in little by little."""
        wall = self.cavity
        cavity = Cavity(wall.level, wall.nodes, wall.stiffness, (1 - share) * wall.offset)
        return Scene(
            self.mesh, self.material, ConstraintTerms(self.matrix, share * self.load), cavity=cavity, tree=self.tree
        )


def inflating(lung: Lung, acting: Breathing) -> Inflating:
    """The scene of a lung's inspiration; tissue is neo-Hookean with the moduli of `Tissue` where none is given."""
    tissue, mesh, border = Tissue(), lung.expired, lung.expired.boundary
    level = level_set(lung.inspired.boundary, STEP_MM, SMOOTH_MM)
    behind = np.minimum(level.evaluate(border.points)[0], 0)
    constraints, load = rising(lung, acting, tissue)
    return Inflating(
        mesh,
        neo_hookean(tissue),
        Cavity(level, border.nodes, WALL_KPA_PER_MM * border.node_areas, behind),
        constraints,
        load,
        spread_map(mesh, lung.inspired)(mesh.points) - mesh.points,
        float(lung.inspired.volumes.sum()),
        tree_of(mesh),
    )


def rising(lung: Lung, acting: Breathing, tissue: Tissue) -> tuple[csr_matrix, Array]:
    """Stiffness (3n, 3n) of what holds the expired lung's bronchi, and forces (n, 3) kPa mm2 at the end of its
    inspiration: the weight that no longer sags it, and the front's rise with the ribs.
    """
    mesh = lung.expired
    root = hilum(mesh, lung.side)
    near = np.exp(-(((mesh.points - root) / acting.held_mm) ** 2).sum(axis=1)) * mesh.node_volumes
    held = acting.held_kpa_mm * near / near.sum()
    lost = np.clip(1 - np.ptp(mesh.points[:, 1]) / np.ptp(lung.inspired.points[:, 1]), -0.5, 0.5)
    load = np.zeros_like(mesh.points)
    load[:, 2] = -held * caudal(lung.inspired) * acting.turn * lost / (1 - lost) * (mesh.points[:, 1] - root[1])
    load[:, 1] = acting.mass_kg * 1e9 * GRAVITY_KPA_PER_MM * mesh.node_volumes / mesh.volumes.sum()
    anchor = 1e-6 * tissue.young_kpa * np.cbrt(mesh.node_volumes)
    return diags(np.column_stack([anchor, anchor, anchor + held]).ravel()).tocsr(), load
