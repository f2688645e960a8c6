"""Points dealt out to threads, for kernels compiled with `nogil` that are told which of them are theirs.

numba's own parallel loops compile two to four times longer, and serve one caller at a time.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import get_num_threads

PARTS = 8
"""For each thread, so that one that is done early takes part of what is left."""


def share_out(kernel: Callable[[int, int], object], n: int, few: int) -> None:
    """Call kernel(first, end) for ranges that make up 0..n, on all threads, or on this one for fewer than `few`.

    No index may depend on another. Raises what the kernel raises.
    """
    threads = get_num_threads()
    if threads == 1 or n < few:
        kernel(0, n)
        return
    ends = np.linspace(0, n, PARTS * threads + 1).astype(int)
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(kernel, ends[:-1], ends[1:]))
