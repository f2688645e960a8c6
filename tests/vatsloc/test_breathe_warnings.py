"""What `vatsloc breathe` tells and refuses: masks without their back, tumours outside of the lungs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from registration.volume import Mask
from tests.poro.breathing_shapes import pear
from tests.vatsloc.test_breathe import ORIGIN, SHAPE, SPACING, SQUEEZE, affine, lungs, person, save
from vatsloc.breathing.case import Tumour, read_breath
from vatsloc.breathing.images import _refuse_outside
from vatsloc.breathing.lungs import both_scans
from vatsloc.breathing.masks import back_seen
from vatsloc.breathing.motion import OUT, LungMotion, Motion
from vatsloc.breathing.run import run_driver
from vatsloc.errors import InputRefused

__all__ = ["person"]  # a fixture


def test_a_tumour_that_touches_no_lung_is_refused() -> None:
    mesh = pear()
    motion = Motion("surface", OUT, (LungMotion("right", mesh, (mesh.points,)),), (0.0,), None)
    x, y, z = mesh.points.max(axis=0)
    with pytest.raises(InputRefused, match="outside of the lungs and its radius is 10 mm"):
        _refuse_outside(Tumour(centre=(x + 20.0, y, z), radius_mm=10.0), motion)
    _refuse_outside(Tumour(centre=tuple(mesh.points.mean(axis=0)), radius_mm=10.0), motion)


def test_the_farthest_state_is_where_tissue_has_moved_most() -> None:
    mesh = pear()
    states = tuple(mesh.points + rise for rise in (0.0, 3.0, -5.0, 1.0))
    assert Motion("one-scan", OUT, (LungMotion("right", mesh, states),), (0.0,) * 4, None).farthest == 2


def test_a_back_that_a_threshold_lost_is_filled_in_again(person: Path) -> None:
    whole, notes = both_scans(read_breath(person))
    assert not notes
    lost = lungs(SQUEEZE)
    y = np.arange(SHAPE[1]) * SPACING + ORIGIN[1]
    lost[np.ix_(np.arange(SHAPE[0]), y < -15, np.arange(35, 60))] = False
    save(person / "lungs_expiration.nii.gz", lost)
    mended, notes = both_scans(read_breath(person))
    assert sum("lacks its back" in note for note in notes) == 2
    for before, after in zip(whole, mended, strict=True):
        assert after.side == before.side
        assert after.lung.expired.volumes.sum() == pytest.approx(before.lung.expired.volumes.sum(), rel=0.05)


def test_how_much_of_its_back_an_expired_mask_holds_is_told_by_storeys() -> None:
    full = lungs(sides=("right",))
    z = np.arange(SHAPE[2]) * SPACING + ORIGIN[2]
    y = np.arange(SHAPE[1]) * SPACING + ORIGIN[1]
    lost = full.copy()
    lost[:, :, z > 20] &= (y > -10)[None, :, None]
    a = affine()
    assert_allclose(back_seen(Mask(full, a), Mask(full, a)), 1)
    seen = back_seen(Mask(lost, a), Mask(full, a))
    assert seen[2] < 0.3
    assert_allclose(seen[0], 1)
    turned = a.copy()  # the same lung, its voxels stored from front to back
    turned[1, 1], turned[1, 3] = -a[1, 1], a[1, 3] + a[1, 1] * (SHAPE[1] - 1)
    again = back_seen(Mask(lost[:, ::-1], turned), Mask(full, a))
    assert_allclose(again, seen, atol=0.02)


def test_a_lung_that_lacks_its_back_behind_and_above_is_answered_with_a_warning(person: Path) -> None:
    lost = lungs(SQUEEZE)
    y, z = (np.arange(SHAPE[k]) * SPACING + ORIGIN[k] for k in (1, 2))
    lost[:, :, z > -10] &= (y > -10)[None, :, None]
    save(person / "lungs_expiration.nii.gz", lost)
    motion = run_driver(read_breath(person), "surface", 2, lambda _: None)
    assert any("expired right lung lacks its back" in warning for warning in motion.warnings)
    assert any("expired left lung lacks its back" in warning for warning in motion.warnings)
