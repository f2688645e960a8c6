"""Driver pressure-volume fills a lung back along the way on which the inspired one was emptied."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import vatsloc.breathing.pressure_volume as module
from poro.arrays import Array
from poro.breathing.elastic import Breathing, Lung
from registration.volume import Mask
from tests.vatsloc.test_breathe import BACK, CENTRES, SQUEEZE, affine, lungs
from vatsloc.breathing.case import BreathCase, Scan
from vatsloc.breathing.motion import IN

SHIFT = np.array([0.0, 0.0, 9.0])
"""Of tissue in the middle, fading towards the border: what no shape tells."""


def emptied(x: Array) -> Array:
    """Where inspired places (n, 3) of the right lung are when it has emptied unevenly."""
    centre = CENTRES["right"]
    middle = np.exp(-(((x - centre) / 25.0) ** 2).sum(axis=1))
    return np.asarray((x - centre) @ SQUEEZE + centre + BACK + middle[:, None] * SHIFT)


def test_an_unevenly_emptied_lung_fills_back_unevenly(monkeypatch: pytest.MonkeyPatch) -> None:
    def empties(lung: Lung, _: Breathing) -> Array:
        return emptied(lung.inspired.points)

    monkeypatch.setattr(module, "breathe_out", empties)
    scans = [
        Scan(name, None, Mask(lungs(squeeze, ("right",)), affine()))
        for name, squeeze in (("inspiration", None), ("expiration", SQUEEZE))
    ]
    motion = module.drive(BreathCase("drawn", Path(), scans[0], scans[1], None, None), 4, lambda _: None)
    assert motion.direction == IN
    assert motion.end == 3
    inspired = CENTRES["right"] + np.random.default_rng(5).uniform(-20, 20, (40, 3))
    off = motion.moved(emptied(inspired), motion.end) - inspired
    uneven = emptied(inspired) - (inspired - CENTRES["right"]) @ SQUEEZE - CENTRES["right"] - BACK
    assert np.linalg.norm(uneven, axis=1).mean() > 4.0
    assert np.linalg.norm(off, axis=1).mean() < 1.2
