"""Steady air flow through the tissue with evacuation into the bronchi. Ref: Alvarez 2021, eq. 11."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix, diags

from poro.assembly import consistent_mass, laplacian
from poro.mesh.tetmesh import Array, TetMesh
from poro.solver import linear_solver
from poro.tissue import Tissue


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
        mass = diags(self.mesh.node_volumes).tocsr() if self.lumped else consistent_mass(self.mesh)
        return (self.tissue.mobility * laplacian(self.mesh))[self.inner], mass[self.inner]

    def pressure(self, kappa_b: float) -> tuple[Array, Array]:
        """Pressure (n,) kPa and its derivative (n,) by ln kappa_b; kappa_b in 1/(Pa s).

        Raises ValueError for a negative kappa_b.
        """
        if not kappa_b >= 0:
            raise ValueError(f"kappa_b must be 0 or more, got {kappa_b}")
        conduction, mass = self._rows
        p = np.full(len(self.mesh.points), self.tissue.pleural_kpa)
        change = np.zeros_like(p)
        if len(self.inner):
            matrix = conduction + kappa_b * mass
            solver = linear_solver(matrix[:, self.inner].tocsr(), self.mesh.points[self.inner])
            # Solved for the drop below the pleural pressure, so that no digit is lost where little air leaves.
            excess = self.tissue.pleural_kpa - self.tissue.bronchial_kpa
            sink = kappa_b * np.asarray(mass.sum(axis=1)).ravel() * excess
            p[self.inner] -= solver.solve(sink)
            change[self.inner] = solver.solve(-kappa_b * (mass @ (p - self.tissue.bronchial_kpa)))
        return p, change

    def resolved(self, kappa_b: float) -> float:
        """Layer thickness over mean element height: below 1 the layer is carried by a single row of elements."""
        return self.tissue.layer_mm(kappa_b) / float(np.cbrt(self.mesh.volumes.mean() * 6 * np.sqrt(2)))
