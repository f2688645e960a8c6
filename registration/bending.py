"""Bending energy of a B-spline field as a quadratic form of its coefficients, exact and separable.

Ref: Rueckert 1999, eq. 8.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial.legendre import leggauss

from registration.banded import Banded, along_axes
from registration.volume import Array, Grid


class BendingEnergy:
    """Mean over the control box of sum_ab |d2u / dx_a dx_b|^2, in 1/mm^2: c^T R c, R a sum of Kronecker products."""

    def __init__(self, control: Grid) -> None:
        g0, g1, g2 = ([Banded(_gram(n, order)) for n in control.shape] for order in range(3))
        h = control.spacing
        cells = float(np.prod(np.array(control.shape) - 3))
        self._terms: list[tuple[float, list[Banded]]] = []
        for a in range(3):
            self._terms.append((1 / (h[a] ** 4 * cells), [g2[m] if m == a else g0[m] for m in range(3)]))
            b = (a + 1) % 3
            cross = [g1[m] if m in (a, b) else g0[m] for m in range(3)]
            self._terms.append((2 / (h[a] ** 2 * h[b] ** 2 * cells), cross))

    def apply(self, c: Array) -> Array:
        """R c for coefficients (q, ni, nj, nk) in mm; the energy is vdot(c, R c), its gradient 2 R c."""
        out = np.zeros_like(c)
        for weight, matrices in self._terms:
            out += weight * along_axes(c, matrices)
        return out

    def diagonal(self) -> Array:
        """Diagonal of R, (ni, nj, nk)."""
        return sum(w * np.einsum("i,j,k->ijk", *(m.diagonal() for m in matrices)) for w, matrices in self._terms)


def _gram(n: int, order: int) -> Array:
    """Integrals over [1, n - 2] of products of the order-th derivatives of the n cubic B-splines, (n, n)."""
    t, w = leggauss(4)
    t, w = (t + 1) / 2, w / 2
    pieces = {
        0: [(1 - t) ** 3 / 6, (3 * t**3 - 6 * t**2 + 4) / 6, (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6, t**3 / 6],
        1: [-((1 - t) ** 2) / 2, (3 * t**2 - 4 * t) / 2, (-3 * t**2 + 2 * t + 1) / 2, t**2 / 2],
        2: [1 - t, 3 * t - 2, -3 * t + 1, t],
    }[order]
    cell = np.einsum("aq,bq,q->ab", pieces, pieces, w)
    gram = np.zeros((n, n))
    for i in range(n - 3):
        gram[i : i + 4, i : i + 4] += cell
    return gram
