"""The correlation coefficient of two sets of values from their sums: one formula for blocks and for whole images.

Only compiled code calls it. Kernels of other modules inline it and are cached by their own file's date, so
`__pycache__` has to be cleared after a change here.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def coefficient(n, f, m, ff, mm, fm, flat_f, flat_m):
    """Correlation of n values f and m from the sums of f, m, f^2, m^2 and f m; -1 where either varies too little.

    flat_f, flat_m: variances up to which they show nothing.
    """
    vf, vm = ff - f * f / n, mm - m * m / n
    if vf <= n * flat_f or vm <= n * flat_m:
        return np.float32(-1)
    return (fm - f * m / n) / np.sqrt(vf * vm)
