"""Driver `surface`: the lung's border is carried from one scan to the other, the rest slides. Ref: Li 2008.

Where there are two images, their registration tells how the lung moved.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from poro.breathing.elastic import acting_at, breathe_out
from poro.breathing.pressure_volume import recoil_pa
from poro.fem import Tissue
from vatsloc.breathing.case import BreathCase
from vatsloc.breathing.lungs import both_scans
from vatsloc.breathing.motion import OUT, LungMotion, Motion, shares
from vatsloc.breathing.registered import as_motion, register


def drive(case: BreathCase, count: int, say: Callable[[str], None]) -> Motion:
    """From inspiration to expiration in `count` states."""
    pairs, notes = both_scans(case)
    found = register(case, pairs, say)
    lungs = []
    for n, pair in enumerate(pairs):
        say(f"{pair.side} lung: the expired wall pulls the inspired lung ...")
        moved = breathe_out(pair.lung, acting_at(pair.depth)) if found is None else found[n].expired
        rest = pair.lung.inspired
        lungs.append(LungMotion(pair.side, rest, tuple(rest.points + s * (moved - rest.points) for s in shares(count))))
    pressure = tuple(
        float(np.mean([recoil_pa(lung.mesh, lung.states[n], Tissue()) for lung in lungs])) for n in range(count)
    )
    return Motion("surface", OUT, tuple(lungs), pressure, count - 1, tuple(notes), registered=as_motion(found))
