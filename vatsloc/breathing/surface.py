"""Driver `surface`: the lung's border is carried from one scan to the other, the rest slides. Ref: Li 2008.

Where there are images, their registration tells how the inside moved too.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from poro.arrays import Array
from poro.breathing.elastic import Breathing, breathe_out
from poro.mesh import TetMesh
from registration.ffd import FfdSettings, Weights
from registration.maps.rigid import RigidTransform
from registration.sliding import register_sliding
from vatsloc.breathing.case import BreathCase
from vatsloc.breathing.lungs import Pair, both_scans
from vatsloc.breathing.motion import OUT, LungMotion, Motion, shares
from vatsloc.maps import MeshMap
from vatsloc.workflow.pose import continued

FAR_MM = 12.0
"""Mean motion by the masks from which on the registration starts there, and not from no motion."""


def drive(case: BreathCase, count: int, say: Callable[[str], None]) -> Motion:
    """From inspiration to expiration in `count` states."""
    pairs, notes = both_scans(case)
    images = case.inspiration is not None and case.expiration is not None
    registered = images and case.inspiration.image is not None and case.expiration.image is not None
    lungs = []
    for pair in pairs:
        say(f"{pair.side} lung: the expired wall pulls the inspired lung ...")
        moved = breathe_out(pair.lung, Breathing())
        if registered:
            say(f"{pair.side} lung: registration ...")
            moved = by_registration(case, pair, moved)
        rest = pair.lung.inspired
        lungs.append(LungMotion(pair.side, rest, tuple(rest.points + s * (moved - rest.points) for s in shares(count))))
    motion = Motion("surface", OUT, tuple(lungs), (0.0,) * count, count - 1, tuple(notes))
    return motion


def by_registration(case: BreathCase, pair: Pair, guess: Array) -> Array:
    """Nodes (n, 3) where the images show them in the expiration; near the pleura the tissue continues elastically."""
    mesh = pair.lung.inspired
    prior = MeshMap(mesh, guess, RigidTransform.identity())
    far = float(np.linalg.norm(guess - mesh.points, axis=1).mean()) > FAR_MM
    fit = register_sliding(
        case.inspiration.image,
        case.expiration.image,
        on(pair.expired, case.expiration.image),
        FfdSettings(spacing_mm=8.0, levels=4, voxel_mm=2.0, window_mm=14.0, weights=Weights()),
        fixed_lung=on(pair.inspired, case.inspiration.image),
        prior=prior if far else None,
    )
    points = fit.moving_from_fixed(mesh.points)
    whole = np.ones(len(points), bool)
    return mesh.points + continued(mesh, TetMesh(mesh.points, mesh.tets), points, whole, whole).u


def on(mask, image):  # type: ignore[no-untyped-def]
    from registration.images.resample import resample_mask

    return resample_mask(mask, image.grid)
