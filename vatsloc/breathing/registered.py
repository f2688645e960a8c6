"""What two images tell of a lung's motion, by the registration of phase 1: it may drive any driver, and is scored
beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from poro.arrays import Array
from poro.breathing.affine import affine_to_points
from poro.breathing.elastic import acting_at, breathe_out
from poro.breathing.equilibrium import ConstraintTerms
from poro.breathing.guide import guide
from poro.fem import Tissue, extrapolate
from poro.mesh import TetMesh
from registration.ffd import FfdSettings, Weights
from registration.images.resample import resample_mask
from registration.sliding import LungImage, register_sliding
from registration.volume import Volume
from vatsloc.breathing.case import BreathCase
from vatsloc.breathing.lungs import Pair
from vatsloc.breathing.motion import OUT, LungMotion, Motion

FAST = FfdSettings(spacing_mm=8.0, levels=4, voxel_mm=2.0, window_mm=14.0, weights=Weights())
"""Coarser than a run's own settings: a lung in seconds, not minutes."""
BELIEVED = 100.0
"""Weight of the registration at every node, as in `extrapolate`; at the pleura as well, which both images show."""
FAR_MM = 12.0
"""Mean motion by the masks from which on the registration starts there, and not from no motion."""


@dataclass(frozen=True)
class Registered:
    """One lung's nodes: inspired mesh, and its nodes (n, 3) in the expiration, RAS mm, as the images show them."""

    pair: Pair
    expired: Array

    @property
    def inspired(self) -> TetMesh:
        """The inspired mesh."""
        return self.pair.lung.inspired

    def outward(self) -> ConstraintTerms:
        """Constraints that guide the inspired mesh to the expiration."""
        mesh = self.inspired
        return guide(mesh, mesh.points, self.expired - mesh.points, mesh.node_volumes)

    def inward(self) -> ConstraintTerms:
        """Constraints that guide the expired mesh to the inspiration."""
        mesh = self.inspired
        return guide(self.pair.lung.expired, self.expired, mesh.points - self.expired, mesh.node_volumes)


def register(case: BreathCase, pairs: Sequence[Pair], say: Callable[[str], None]) -> list[Registered] | None:
    """Every lung as the images show it; None where the case has no two images, or asks for its masks alone."""
    if case.images is None:
        return None
    found = []
    for pair in pairs:
        say(f"{pair.side} lung: registration ...")
        guess = breathe_out(pair.lung, acting_at(pair.depth))
        found.append(Registered(pair, by_registration(*case.images, pair, guess)))
    return found


def as_motion(found: Sequence[Registered] | None) -> Motion | None:
    """The registration as a motion of two states, to be scored."""
    if found is None:
        return None
    lungs = tuple(LungMotion(r.pair.side, r.inspired, (r.inspired.points, r.expired)) for r in found)
    return Motion("registration", OUT, lungs, (0.0, 0.0), 1)


def by_registration(inspired: Volume, expired: Volume, pair: Pair, guess: Array) -> Array:
    """Nodes (n, 3) where the images show them in the expiration; elastic where the registration would turn tissue
    inside out.

    guess: where the masks alone put them. The registration starts from an affine map fitted to that: the guess itself
    folds here and there outside of the mesh, and what starts folded is never let go.
    """
    mesh = pair.lung.inspired
    far = float(np.linalg.norm(guess - mesh.points, axis=1).mean()) > FAR_MM
    fit = register_sliding(
        LungImage(inspired, resample_mask(pair.inspired, inspired.grid)),
        LungImage(expired, resample_mask(pair.expired, expired.grid)),
        FAST,
        affine_to_points(mesh.points, guess) if far else None,
    )
    motion = fit.moving_from_fixed(mesh.points) - mesh.points
    every = np.arange(len(motion))
    return mesh.points + extrapolate(mesh, every, motion, Tissue(), np.full(len(motion), BELIEVED)).u
