"""Pieces of a lung that were registered each for itself and now overlap are pressed apart, without friction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from poro.fem import Tissue
from poro.mesh.pieces import Pieces
from poro.separation import Held, Separation, facing_pieces, hold_apart
from registration.volume import Array
from vatsloc.workflow.choices import weigh
from vatsloc.workflow.pneumothorax import Collapse
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import Stages

CONTACT = "contact between pieces"
KEYPOINT_SIGMA_MM = 1.5
"""How well keypoints are where the registered pieces have them."""

MOST_LEFT = 0.5
"""Of the overlap; where more is left, contact has not settled."""


def held_apart(collapse: Collapse, settings: Settings, stages: Stages) -> Collapse:
    """The collapse after its pieces were pressed apart; what was given for one piece, or where they hardly overlap."""
    if collapse.parted is None:
        stages.skip(CONTACT, "the lung is in one piece")
        return collapse
    overlap_ml = overlap_mm3(collapse.parted.pieces, collapse.points_after) / 1e3
    limit = settings.leave_out.overlap_ml
    if not stages.choose(weigh(CONTACT, overlap_ml, limit, f"the pieces overlap by {overlap_ml:.2f} ml", "ml")):
        return collapse
    with stages.stage(CONTACT):
        found = pressed_apart(collapse)
    if found.after_mm3 > MOST_LEFT * found.before_mm3:
        left = f"{found.after_mm3 / 1e3:.2f} of {found.before_mm3 / 1e3:.2f} ml"
        stages.warn(
            f"The pieces of the lung overlap and could not be pressed apart ({left} left); they stay as they are."
        )
        return collapse
    return replace(collapse, points_after=collapse.points_after + found.u)


def overlap_mm3(pieces: Pieces, points: Array) -> float:
    """Volume that two pieces whose nodes are at points (n, 3) mm share."""
    return facing_pieces(pieces, points).gaps(np.zeros_like(points)).overlap_mm3


def pressed_apart(collapse: Collapse) -> Separation:
    """What presses the pieces of a parted lung apart: both give way where no keypoint holds them, and neither is
    pushed through the chest wall.
    """
    if collapse.parted is None:
        raise ValueError("a lung in one piece has nothing to press apart")
    pieces, before = collapse.parted.pieces, collapse.mesh_before
    known = collapse.model.correspondences.moving
    return hold_apart(
        replace(pieces, mesh=before),
        collapse.points_after - before.points,
        Tissue(),
        Held(known, np.full(len(known), KEYPOINT_SIGMA_MM)),
        collapse.system.wall.level,
    )
