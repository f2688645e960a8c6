"""Steady air flow through the tissue with evacuation into the bronchi. Ref: Alvarez 2021, eq. 11."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix

from poro.arrays import Array
from poro.fem.forms import consistent_mass, laplacian, lumped_mass
from poro.fem.tissue import Tissue
from poro.linalg.dissection import Tree
from poro.linalg.solver import elimination_tree, linear_solver
from poro.mesh.tetmesh import TetMesh


@dataclass(frozen=True)
class Flow:
    """Pressure problem of one mesh and tissue, pleural pressure on the whole surface.

    lumped: whether the reaction is lumped, which keeps the pressure in its physical range whatever the layer's
    thickness.
    """

    mesh: TetMesh
    tissue: Tissue
    lumped: bool = True

    @cached_property
    def inner(self) -> Array:
        """Nodes off the surface."""
        free = np.ones(len(self.mesh.points), bool)
        free[self.mesh.boundary.nodes] = False
        return np.flatnonzero(free)

    @cached_property
    def _rows(self) -> tuple[csr_matrix, csr_matrix]:
        mass = lumped_mass(self.mesh) if self.lumped else consistent_mass(self.mesh)
        return (self.tissue.mobility * laplacian(self.mesh))[self.inner], mass[self.inner]

    @cached_property
    def inner_rows(self) -> tuple[csr_matrix, csr_matrix]:
        """Conduction and reaction among the inner nodes, (ni, ni) each."""
        conduction, mass = self._rows
        return conduction[:, self.inner].tocsr(), mass[:, self.inner].tocsr()

    @cached_property
    def sink(self) -> Array:
        """Air (ni,) that unit evacuation takes from every inner node at pleural pressure."""
        excess = self.tissue.pleural_kpa - self.tissue.bronchial_kpa
        return np.asarray(self._rows[1].sum(axis=1)).ravel() * excess

    @cached_property
    def _tree(self) -> Tree:
        return elimination_tree(self.inner_rows[0], self.mesh.points[self.inner])

    def pressure(self, kappa_b: float) -> tuple[Array, Array]:
        """Pressure (n,) kPa and its derivative (n,) by ln kappa_b; kappa_b in 1/(Pa s).

        Raises ValueError for a negative kappa_b.
        """
        if not kappa_b >= 0:
            raise ValueError(f"kappa_b must be 0 or more, got {kappa_b}")
        p = np.full(len(self.mesh.points), self.tissue.pleural_kpa)
        change = np.zeros_like(p)
        if len(self.inner):
            conduction, mass = self.inner_rows
            solver = linear_solver((conduction + kappa_b * mass).tocsr(), self.mesh.points[self.inner], self._tree)
            # Solved for the drop below the pleural pressure, so that no digit is lost where little air leaves.
            drop = solver.solve(kappa_b * self.sink)
            p[self.inner] -= drop
            change[self.inner] = solver.solve(kappa_b * (mass @ drop - self.sink))
        return p, change

    def resolved(self, kappa_b: float) -> float:
        """Layer thickness over mean element height: below 1 the layer is carried by a single row of elements."""
        return self.tissue.layer_mm(kappa_b) / float(np.cbrt(self.mesh.volumes.mean() * 6 * np.sqrt(2)))

    def layer(self, kappa_b: float) -> str:
        """How the layer compares with the elements, as a sentence that says when the mesh is too coarse for it."""
        spans, thick = self.resolved(kappa_b), self.tissue.layer_mm(kappa_b)
        if spans >= 1:
            return f"The pressure layer, {thick:.1f} mm, spans {spans:.1f} elements."
        coarse = f"is thinner than an element, {spans:.2f} of it: the mesh is too coarse."
        return f"The pressure layer, {thick:.1f} mm, {coarse}"
