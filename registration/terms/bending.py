"""Bending energy of a B-spline field as a quadratic form of its coefficients, exact and separable.

Ref: Rueckert 1999, eq. 8.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial.legendre import leggauss

from registration.kernels.banded import Banded, along_axis
from registration.volume import Array, Grid


class BendingEnergy:
    """Mean over the control box of sum_ab |d2u / dx_a dx_b|^2, in 1/mm^2: c^T R c, R a sum of Kronecker products."""

    def __init__(self, control: Grid) -> None:
        h, cells = control.spacing, float(np.prod(np.array(control.shape) - 3))
        self._gram = [
            [Banded(_gram(n, order) / (h[m] ** (2 * order) * cells ** (1 / 3))) for order in range(3)]
            for m, n in enumerate(control.shape)
        ]

    def apply(self, c: Array) -> Array:
        """R c for coefficients (q, ni, nj, nk) in mm; the energy is vdot(c, R c), its gradient 2 R c.

        The six products of Gram matrices share what they have in common: 12 passes instead of 18.
        """
        gi, gj, gk = self._gram
        i0, i1, i2 = (along_axis(c, 1, g) for g in gi)
        both = along_axis(i0, 2, gj[0])
        once = along_axis(i1, 2, gj[0]) + along_axis(i0, 2, gj[1])
        plane = along_axis(i2, 2, gj[0]) + along_axis(i0, 2, gj[2]) + 2 * along_axis(i1, 2, gj[1])
        return along_axis(plane, 3, gk[0]) + 2 * along_axis(once, 3, gk[1]) + along_axis(both, 3, gk[2])

    def diagonal(self) -> Array:
        """Diagonal of R, (ni, nj, nk)."""
        total = np.zeros(())
        for orders in ((2, 0, 0), (0, 2, 0), (0, 0, 2), (1, 1, 0), (1, 0, 1), (0, 1, 1)):
            factors = [self._gram[m][order].diagonal() for m, order in enumerate(orders)]
            total = total + (2 if 1 in orders else 1) * np.einsum("i,j,k->ijk", *factors)
        return total


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
