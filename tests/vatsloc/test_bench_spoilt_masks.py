"""Masks spoilt the ways that people spoil them: each way does what it says, and what is made of it is told."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import ndimage

from poro.arrays import Array
from registration.volume import Mask
from vatsloc.breathing.case import BreathCase, Scan
from vatsloc.errors import InputRefused
from vatsloc.study.bench import real as bench
from vatsloc.study.bench.spoilt_masks import SPOILT, spoilt

SPACING = np.array([2.0, 2.0, 3.0])


def two_boxes() -> Array:
    """Two lungs beside each other, 60 mm wide, 100 deep and 180 high, 40 mm apart."""
    inside = np.zeros((100, 70, 70), bool)
    inside[10:40, 10:60, 5:65] = inside[60:90, 10:60, 5:65] = True
    return inside


def spoil(way: str, flipped: bool = False) -> Array:
    """The boxes' expired mask after one way, with the patient's back at low j."""
    affine = np.diag([2.0, -2.0 if flipped else 2.0, 3.0, 1.0])
    step = -1 if flipped else 1
    mask = Mask(two_boxes()[:, ::step], affine)
    scans = (Scan("inspiration", None, mask), Scan("expiration", None, mask))
    case = BreathCase("boxes", None, *scans, None, None)  # type: ignore[arg-type]
    after = spoilt(case, way)
    assert after.expiration is not None
    assert after.expiration.mask is not None
    return after.expiration.mask.inside[:, ::step]


def pieces(inside: Array) -> int:
    return int(ndimage.label(inside)[1])


@pytest.mark.parametrize("flipped", [False, True])
def test_each_way_spoils_as_it_says(flipped: bool) -> None:
    whole = two_boxes()
    joined = spoil("both lungs joined", flipped)
    assert pieces(joined) == 1
    assert (joined & ~whole)[40:60, 47:60].any()  # in front
    assert not joined[40:60, :40].any()
    assert pieces(spoil("in three pieces", flipped)) == 6
    missing = whole & ~spoil("parts missing", flipped)
    assert 10 < missing.sum() * SPACING.prod() / 1000 < 4 * 4.19 * 2.2**3
    stray = spoil("stray bits", flipped)
    assert (stray & whole).sum() == whole.sum()
    assert pieces(stray) > 5
    dropped = ~spoil("slices dropped", flipped).any(axis=(0, 1)) & whole.any(axis=(0, 1))
    assert 8 <= dropped.sum() <= 10  # six, and 12 mm together
    back = whole & ~spoil("dense back left out", flipped)
    assert back[20, 10:22, 10].all()  # 25 mm in front of the back wall
    assert not back[:, 23:].any()
    assert not back[:, :, 37:].any()


def test_what_is_made_of_spoilt_masks_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    def read(_folder: Any, way: str | None = None) -> Any:
        if way == "parts missing":
            raise InputRefused("too little is left")
        lung = SimpleNamespace(side="left", expired=SimpleNamespace(volumes=np.array([2e6])))
        notes = () if way is None else (f"{way} mended.",)
        pair = SimpleNamespace(side="left", lung=lung)
        return SimpleNamespace(lungs=[lung], pairs=[pair], marks=lambda _side: None, notes=notes)

    monkeypatch.setattr(bench, "read_person", read)
    monkeypatch.setattr(bench, "predicted", lambda _name, _pair: np.zeros((1, 3)))
    monkeypatch.setattr(bench, "errors", lambda *_given: (np.array([1.0, 3.0]), np.array([0.0])))
    rows = bench.spoilt_masks(tmp_path)
    assert [row["masks"] for row in rows] == ["as they come", *SPOILT]
    assert (rows[0]["expired_ml"], rows[0]["mean"], rows[0]["lungs"]) == (2000, 2, 1)
    told = bench._spoilt_table("someone", rows)
    assert "refused: too little is left" in told[1 + list(rows).index(next(r for r in rows if "refused" in r))]
    assert "slices dropped mended." in told[-2]
    json.dumps(rows)
