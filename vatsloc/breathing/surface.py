"""Driver `surface`: the lung's border is carried from one scan to the other, the rest slides. Ref: Li 2008.

Where there are images, their registration tells how the inside moved too.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from poro.arrays import Array
from poro.breathing.elastic import acting_at, breathe_out
from poro.fem import Tissue, neo_hookean
from poro.fem.forms import deformation_gradient
from poro.mesh import TetMesh
from registration.ffd import FfdSettings, Weights
from registration.images.resample import resample_mask
from registration.maps.rigid import RigidTransform
from registration.sliding import LungImage, register_sliding
from registration.volume import Mask, Volume
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
    images = [scan.image for scan in (case.inspiration, case.expiration) if scan is not None and scan.image is not None]
    lungs = []
    for pair in pairs:
        say(f"{pair.side} lung: the expired wall pulls the inspired lung ...")
        moved = breathe_out(pair.lung, acting_at(pair.depth))
        if len(images) == 2:
            say(f"{pair.side} lung: registration ...")
            moved = by_registration(images[0], images[1], pair, moved)
        rest = pair.lung.inspired
        lungs.append(LungMotion(pair.side, rest, tuple(rest.points + s * (moved - rest.points) for s in shares(count))))
    pressure = tuple(float(np.mean([_recoil_pa(lung, n) for lung in lungs])) for n in range(count))
    return Motion("surface", OUT, tuple(lungs), pressure, count - 1, tuple(notes))


def _recoil_pa(lung: LungMotion, state: int) -> float:
    """Mean of the tissue's hydrostatic stress over the first scan's: what the recoil rises by, less than 0 when it
    falls."""
    f = deformation_gradient(lung.mesh, lung.states[state] - lung.mesh.points)
    if not (np.linalg.det(f) > 0).all():
        f = f[np.linalg.det(f) > 0]
    _, stress, _ = neo_hookean(Tissue()).respond(f)
    det = np.linalg.det(f)
    pressure = np.einsum("mij,mij->m", stress, f) / det / 3
    return 1000 * float(np.average(pressure, weights=det))


def by_registration(inspired: Volume, expired: Volume, pair: Pair, guess: Array) -> Array:
    """Nodes (n, 3) where the images show them in the expiration; near the pleura the tissue continues elastically."""
    mesh = pair.lung.inspired
    prior = MeshMap(mesh, guess, RigidTransform.identity())
    far = float(np.linalg.norm(guess - mesh.points, axis=1).mean()) > FAR_MM
    fit = register_sliding(
        LungImage(inspired, _on(pair.inspired, inspired)),
        LungImage(expired, _on(pair.expired, expired)),
        FfdSettings(spacing_mm=8.0, levels=4, voxel_mm=2.0, window_mm=14.0, weights=Weights()),
        prior if far else None,
    )
    points = fit.moving_from_fixed(mesh.points)
    whole = np.ones(len(points), bool)
    return mesh.points + continued(mesh, TetMesh(mesh.points, mesh.tets), points, whole, whole).u


def _on(mask: Mask, image: Volume) -> Mask:
    return resample_mask(mask, image.grid)
