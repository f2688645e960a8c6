"""The scene of an inspiration: an expired lung that fills the inspired cavity, sliding on its wall, and guided by what
is known of its way.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix, diags

from poro.arrays import Array
from poro.breathing.elastic import WALL_KPA_PER_MM, Breathing, Lung, caudal, hilum, spread_map
from poro.breathing.equilibrium import Cavity, ConstraintTerms, Scene, tree_of
from poro.contact.levelset import level_set
from poro.fem.constitutive import ConstitutiveModel, neo_hookean
from poro.fem.solid import anchor
from poro.fem.tissue import GRAVITY_KPA_PER_MM, Tissue
from poro.linalg.dissection import Tree
from poro.mesh.tetmesh import TetMesh

STEP_MM, SMOOTH_MM = 5.0, 2.5
"""Of the samples of the cavity's distance."""
TISSUE = Tissue(poisson=0.42)
"""Of air-filled lung that keeps its gas: bulk modulus 4 P, shear modulus 0.7 P. Ref: Lai-Fook 1979. Over a deep breath
the volume of every part then changes more evenly than with the 0.35 of a lung that is emptied."""
PULL = 1.0
"""Fluid keeps the pleurae together as firmly as they push: no gas lets the lung leave its wall."""


@dataclass(frozen=True)
class Inflating:
    """Everything about one lung's inspiration that no phase changes.

    guess: (n, 3) mm, the lung laid out by its spread; load: (n, 3) kPa mm2 at the end of the way; full_mm3: volume of
    the inspired lung. The cavity's offsets say how far border nodes lie from the wall at the start.
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
        """What acts at a share of the way: the wall is that far from its expired to its inspired shape."""
        (_, expired), (_, inspired) = self.cavity.level
        level = ((1 - share, expired), (share, inspired))
        cavity = replace(self.cavity, level=level, offset=(1 - share) * self.cavity.offset)
        return Scene(
            self.mesh, self.material, ConstraintTerms(self.matrix, share * self.load), cavity=cavity, tree=self.tree
        )


def inflating(lung: Lung, known: ConstraintTerms | None = None) -> Inflating:
    """The scene of a lung's inspiration, of neo-Hookean tissue; known: constraints at its end that guide it."""
    mesh, border = lung.expired, lung.expired.boundary
    expired, inspired = (level_set(mesh.boundary, STEP_MM, SMOOTH_MM) for mesh in (lung.expired, lung.inspired))
    start = expired.evaluate(border.points)[0]
    acts = ConstraintTerms(diags(anchor(mesh, TISSUE)).tocsr(), np.zeros_like(mesh.points))
    acts = acts if known is None else acts + known
    return Inflating(
        mesh,
        neo_hookean(TISSUE),
        Cavity(((1.0, expired), (0.0, inspired)), border.nodes, WALL_KPA_PER_MM * border.node_areas, start, PULL),
        acts.matrix,
        acts.force,
        spread_map(mesh, lung.inspired)(mesh.points) - mesh.points,
        float(lung.inspired.volumes.sum()),
        tree_of(mesh),
    )


def rising(lung: Lung, acting: Breathing, tissue: Tissue) -> tuple[csr_matrix, Array]:
    """Stiffness (3n, 3n) of what holds the expired lung's bronchi, and forces (n, 3) kPa mm2 at the end of its
    inspiration: the weight that no longer sags it, and the front's rise with the ribs, as in `elastic` turned round.
    """
    mesh = lung.expired
    root = hilum(mesh, lung.side)
    near = np.exp(-(((mesh.points - root) / acting.held_mm) ** 2).sum(axis=1)) * mesh.node_volumes
    held = acting.held_kpa_mm * near / near.sum()
    lost = np.clip(1 - np.ptp(mesh.points[:, 1]) / np.ptp(lung.inspired.points[:, 1]), -0.5, 0.5)
    load = np.zeros_like(mesh.points)
    load[:, 2] = -held * caudal(lung.inspired) * acting.turn * lost / (1 - lost) * (mesh.points[:, 1] - root[1])
    load[:, 1] = acting.mass_kg * 1e9 * GRAVITY_KPA_PER_MM * mesh.node_volumes / mesh.volumes.sum()
    along = np.column_stack([np.zeros_like(held), np.zeros_like(held), held]).ravel()
    return diags(anchor(mesh, tissue) + along).tocsr(), load
