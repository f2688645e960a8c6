"""Terms of polynomials in three coordinates."""

from __future__ import annotations

import numpy as np

from registration.volume import Array


def monomials(x: Array, degree: int) -> list[Array]:
    """1, the coordinates (3, ...) and, for degree 2, their products, each (...): 4 or 10 terms."""
    terms = [np.ones(x.shape[1:]), *x]
    if degree == 2:
        terms += [x[a] * x[b] for a in range(3) for b in range(a, 3)]
    return terms
