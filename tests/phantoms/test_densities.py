"""Histograms of a phantom's CT beside those of real scans: lung, soft tissue, fat and bone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from phantoms import PhantomCase
from registration.volume import Volume
from vatsloc.formats.images import read_volume
from vatsloc.imaging.lungs import segment_lungs
from vatsloc.synthetic.voxels import to_volume

TISSUE_HU, VESSEL_HU, BONE_HU, HARD_BONE_HU = -300.0, -500.0, 200.0, 600.0


def _figures(ct: Volume) -> dict[str, float]:
    """HU of lung tissue 4 mm and more below its surface, of the rest at the lungs' level, and shares of voxels."""
    found = segment_lungs(ct, "right")
    both = found.right.inside | found.left.inside
    steps = np.maximum(np.rint(4 / ct.grid.spacing), 1).astype(int)
    deep = both
    for axis, n in enumerate(steps):
        deep = ndimage.binary_erosion(deep, np.ones([3 if m == axis else 1 for m in range(3)]), iterations=int(n))
    levels = np.flatnonzero(both.any(axis=(0, 1)))
    chest = ct.hu[:, :, levels[0] : levels[-1]]
    tissue, bone = (chest > TISSUE_HU).sum(), chest[chest > BONE_HU]
    lung = ct.hu[deep]
    quantiles = {f"lung {q} %": float(np.percentile(lung, q)) for q in (5, 25, 50, 75)}
    return quantiles | {
        "vessels in the lung": float((lung > VESSEL_HU).mean()),
        "soft tissue": _peak(chest, 0, 110),
        "fat": _peak(chest, -150, -50),
        "bone": float(np.median(bone)),
        "share of bone": float(bone.size / tissue),
        "share of hard bone": float((bone > HARD_BONE_HU).sum() / tissue),
    }


def _peak(hu: np.ndarray, low: float, high: float) -> float:
    """HU that is met most often between two bounds, to 5 HU."""
    count, edges = np.histogram(hu, np.arange(low, high + 5, 5))
    return float(edges[count.argmax()] + 2.5)


BOUNDS = {
    "lung 5 %": 20.0,
    "lung 25 %": 20.0,
    "lung 50 %": 20.0,
    "lung 75 %": 20.0,
    "vessels in the lung": 0.025,
    "soft tissue": 15.0,
    "fat": 15.0,
    "bone": 100.0,
    "share of bone": 0.02,
    "share of hard bone": 0.006,
}
"""How far a phantom's figure may lie outside the range that the real scans span."""


@pytest.mark.shared
def test_histograms_are_those_of_real_scans(demo: PhantomCase, shared: Path) -> None:
    real = [_figures(read_volume(shared / "cases" / name / "ct.nii.gz")) for name in ("twin-a", "twin-b")]
    ours = _figures(to_volume(demo.ct))
    outside = {
        name: (round(ours[name], 4), [round(r[name], 4) for r in real])
        for name, bound in BOUNDS.items()
        if not min(r[name] for r in real) - bound <= ours[name] <= max(r[name] for r in real) + bound
    }
    assert outside == {}
