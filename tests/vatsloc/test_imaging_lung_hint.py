"""A lung mask given by hand, beside lungs that are known exactly: kept, parted, completed or refused."""

from __future__ import annotations

import numpy as np
import pytest

from registration.volume import Grid, Mask
from vatsloc.errors import InputRefused
from vatsloc.imaging.lung_hint import operated_lung
from vatsloc.imaging.lungs import Lungs

GRID = Grid((60, 30, 40), np.array([[5.0, 0, 0, -147.5], [0, 5, 0, -72.5], [0, 0, 5, -97.5], [0, 0, 0, 1]]))
X = GRID.points()
NODULE_RAS = np.array([70.0, 0.0, 0.0])


def ball(x: float, radius: float) -> Mask:
    return Mask(np.linalg.norm(X - [x, 0.0, 0.0], axis=-1) < radius, GRID.ras_from_ijk)


def both(*masks: Mask) -> Mask:
    return Mask(np.any([mask.inside for mask in masks], axis=0), GRID.ras_from_ijk)


LEFT, RIGHT = ball(-70.0, 55.0), ball(70.0, 55.0)
LUNGS = Lungs(LEFT, RIGHT, ball(0.0, 8.0), 0.0, {"left": 697.0, "right": 697.0})


def test_a_mask_of_the_operated_lung_is_taken_as_it_is() -> None:
    lung, warnings = operated_lung(ball(68.0, 52.0), LUNGS, "right", NODULE_RAS, ball(70.0, 10.0))
    assert np.array_equal(lung.inside, ball(68.0, 52.0).inside)
    assert warnings == []


@pytest.mark.parametrize(("side", "own", "nodule_ras"), [("right", RIGHT, NODULE_RAS), ("left", LEFT, -NODULE_RAS)])
def test_of_a_mask_of_both_lungs_the_operated_one_is_kept(side, own: Mask, nodule_ras: np.ndarray) -> None:
    """Both masks are wider than the CT's lungs and joined by a bridge, which is cut in the middle."""
    bridge = Mask((np.abs(X[..., 1:]) < 10).all(axis=-1) & (np.abs(X[..., 0]) < 30), GRID.ras_from_ijk)
    given = both(ball(-70.0, 58.0), ball(70.0, 58.0), bridge)
    lung, warnings = operated_lung(given, LUNGS, side, nodule_ras, None)
    assert warnings == [f"The lung mask given by hand holds both lungs; its part nearer to the {side} one was kept."]
    sign = 1 if side == "right" else -1
    assert (lung.inside & own.inside).sum() == own.inside.sum()
    assert (sign * X[lung.inside][:, 0]).min() >= -5.0
    assert np.array_equal(lung.inside[sign * X[..., 0] > 10], given.inside[sign * X[..., 0] > 10])


def test_a_mask_of_the_other_lung_is_refused() -> None:
    with pytest.raises(
        InputRefused, match=r"marks 0 voxels of the right lung, which is operated, and \d{4} of the oth"
    ):
        operated_lung(LEFT, LUNGS, "right", NODULE_RAS, None)


def test_a_tiny_mask_is_refused() -> None:
    with pytest.raises(
        InputRefused, match=r"marks 35 ml, 250 ml needed of a lung; give a mask of the whole right lung"
    ):
        operated_lung(ball(70.0, 20.0), LUNGS, "right", NODULE_RAS, None)


def test_a_nodule_that_the_mask_leaves_out_is_added_and_said() -> None:
    nodule = ball(70.0, 10.0)
    hole = Mask(RIGHT.inside & ~nodule.inside, GRID.ras_from_ijk)
    lung, warnings = operated_lung(hole, LUNGS, "right", NODULE_RAS, nodule)
    assert np.array_equal(lung.inside, RIGHT.inside)
    n = int(nodule.inside.sum())
    assert warnings == [f"The lung mask given by hand leaves out {n} voxels of the nodule; they were added."]


def test_a_nodule_far_from_the_mask_is_refused() -> None:
    with pytest.raises(InputRefused, match=r"leaves the nodule 3\d mm outside, 15 mm allowed; give a mask of the lung"):
        operated_lung(RIGHT, LUNGS, "right", np.array([70.0, 0.0, 90.0]), None)
    _, warnings = operated_lung(RIGHT, LUNGS, "right", np.array([70.0, 0.0, 62.5]), None)
    assert warnings == ["The nodule lies 11 mm outside the lung mask given by hand."]
