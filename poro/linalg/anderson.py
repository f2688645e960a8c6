"""Anderson's acceleration of a fixed-point iteration. Ref: Anderson 1965; Walker & Ni 2011."""

from __future__ import annotations

from collections import deque

import numpy as np

from poro.arrays import Array

DEPTH = 5


class Anderson:
    """Mixes the last iterates so that the change they would make next is smallest."""

    def __init__(self) -> None:
        self._seen: deque[tuple[Array, tuple[Array, ...]]] = deque(maxlen=DEPTH + 1)

    def restart(self) -> None:
        """Start anew, after something other than the iterate has changed."""
        self._seen.clear()

    def mix(self, change: Array, *following: Array) -> tuple[Array, ...]:
        """Better next iterates than `following`, which differ from the present ones by `change` in what counts.

        `following` may hold further arrays that go with the iterate; they are mixed alike.
        """
        self._seen.append((change.ravel(), following))
        if len(self._seen) < 2:
            return following
        last = self._seen[-1][0]
        older = list(self._seen)[:-1]
        differences = np.stack([last - past for past, _ in older], axis=1)
        share = np.linalg.lstsq(differences, last, rcond=1e-10)[0]
        mixed = [array.astype(float, copy=True) for array in following]
        for weight, (_, past) in zip(share, older, strict=True):
            for array, now, before in zip(mixed, following, past, strict=True):
                array -= weight * (now - before)
        return tuple(mixed)
