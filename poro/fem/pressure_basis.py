"""Reduced basis of the pressure: it and the displacements it causes at any evacuation rate of one lung.

Ref: Quarteroni, Manzoni & Negri 2016 (reduced basis, residual as the test).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix

from poro.arrays import Array
from poro.fem.flow import Flow
from poro.fem.solid import Solid

TOLERANCE = 1e-9  # of the residual relative to the load, for the pressure and for its derivative


@dataclass(frozen=True)
class PressureSolution:
    """One evacuation rate. p: (n,) kPa; u: (n, 3) mm without wall; p_change, u_change: derivatives by ln kappa_b."""

    p: Array
    p_change: Array
    u: Array
    u_change: Array


class PressureBasis:
    """Pressure drops of the rates solved so far span a space; a new rate is solved in it, and in full, enriching it,
    where the residual shows that it does not suffice. load: (3n, n) nodal forces per kPa.
    """

    def __init__(self, flow: Flow, solid: Solid, load: csr_matrix) -> None:
        self.load = load
        self._flow, self._solid = flow, solid
        inner, nodes = len(flow.inner), len(flow.mesh.points)
        self._basis = np.zeros((inner, 0))
        self._conducted, self._stored = self._basis, self._basis
        self._response = np.zeros((nodes, 3, 0))

    @property
    def size(self) -> int:
        """Number of pressure fields in the basis."""
        return self._basis.shape[1]

    def solve(self, kappa_b: float) -> PressureSolution:
        """The lung at kappa_b in 1/(Pa s); raises ValueError for a negative one."""
        drop, steepening = self._coefficients(kappa_b).T
        p = np.full(len(self._flow.mesh.points), self._flow.tissue.pleural_kpa)
        change = np.zeros_like(p)
        p[self._flow.inner] -= self._basis @ drop
        change[self._flow.inner] -= self._basis @ steepening
        response = self._responses()
        return PressureSolution(p, change, response @ drop, response @ steepening)

    def enrich(self, rates: Iterable[float]) -> None:
        """Enrich the basis for several kappa_b, so that one elastic solution serves them together."""
        for kappa_b in rates:
            self._coefficients(kappa_b)

    def _coefficients(self, kappa_b: float) -> Array:
        """Coefficients (r, 2) of the drop and of its derivative in the basis, enriched where it does not suffice."""
        found = self._reduced(kappa_b)
        if found is None:
            p, change = self._flow.pressure(kappa_b)
            exact = np.stack([self._flow.tissue.pleural_kpa - p, -change], axis=1)[self._flow.inner]
            self._grow(exact)
            found = self._basis.T @ exact
        return found

    def _reduced(self, kappa_b: float) -> Array | None:
        """Coefficients (r, 2) of the drop and of its derivative in the basis, None where the basis does not suffice."""
        if self.size == 0 or not kappa_b > 0:
            return None
        sink = kappa_b * self._flow.sink
        whole = self._conducted + kappa_b * self._stored
        small = np.linalg.inv(self._basis.T @ whole)
        drop = small @ (self._basis.T @ sink)
        steeper = sink - kappa_b * (self._stored @ drop)
        steepening = small @ (self._basis.T @ steeper)
        residual = max(np.linalg.norm(sink - whole @ drop), np.linalg.norm(steeper - whole @ steepening))
        enough = residual < TOLERANCE * np.linalg.norm(sink)
        return np.stack([drop, steepening], axis=1) if enough else None

    def _grow(self, fields: Array) -> None:
        """Take pressure fields (ni, k) into the basis."""
        for column in fields.T:
            scale = np.linalg.norm(column)
            for _ in range(2):  # twice is enough, Ref: Giraud, Langou & Rozloznik 2005
                column = column - self._basis @ (self._basis.T @ column)
            if np.linalg.norm(column) <= 1e-13 * scale:
                continue
            self._basis = np.column_stack([self._basis, column / np.linalg.norm(column)])
        new = self._basis[:, self._stored.shape[1] :]
        if new.shape[1]:
            conduction, mass = self._flow.inner_rows
            self._conducted = np.column_stack([self._conducted, conduction @ new])
            self._stored = np.column_stack([self._stored, mass @ new])

    def _responses(self) -> Array:
        """Displacements (n, 3, r) per unit of every field of the basis."""
        new = self._basis[:, self._response.shape[2] :]
        if new.shape[1]:
            whole = np.zeros((len(self._response), new.shape[1]))
            whole[self._flow.inner] = -new
            force = (self.load @ whole).reshape(len(whole), 3, -1)
            self._response = np.concatenate([self._response, self._solid.solve(force)], axis=2)
        return self._response
