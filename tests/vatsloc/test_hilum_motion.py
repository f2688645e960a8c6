"""The hilum's motion where there is little to see of its airways."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from registration.rigid import RigidTransform
from registration.volume import Mask, Volume
from vatsloc.imaging.airways import TrackedAirways
from vatsloc.imaging.cbct import Cupping, FieldOfView, PreparedCbct
from vatsloc.imaging.hilum import Hilum
from vatsloc.workflow import hilum
from vatsloc.workflow.hilum import HilumSource, hilum_motion

AFFINE = np.diag([3.0, 3.0, 3.0, 1.0])
SHAPE = (30, 30, 30)
SHIFT = np.array([4.0, -3.0, 1.5])
POINTS = np.array([[40.0, 40, 40], [50, 45, 40]])


@pytest.fixture
def image() -> PreparedCbct:
    everywhere = Mask(np.ones(SHAPE, dtype=bool), AFFINE)
    field = FieldOfView(everywhere, everywhere, np.array([15.0, 15.0]), np.inf, 2)
    none = Cupping(np.zeros(2), np.zeros(2), 1.0, {}, {})
    hu = np.random.default_rng(0).normal(0, 100, SHAPE).astype(np.float32)
    return PreparedCbct(Volume(hu, AFFINE), field, none)


def motion(
    inflated: PreparedCbct, deflated: PreparedCbct, inside: np.ndarray, contrast: float, patch: pytest.MonkeyPatch
) -> hilum.HilumMotion:
    tracked = TrackedAirways(inside, SHIFT, contrast, 0.0)
    patch.setattr(hilum, "track_hilum", lambda *_: tracked)
    patch.setattr(hilum, "working_copy", lambda volume, _mm: volume)
    place = Hilum(POINTS[0], 20.0, True)
    return hilum_motion(inflated, deflated, Mask(inside, AFFINE), place, RigidTransform.identity(), POINTS)


def test_airways_that_the_inflated_image_does_not_see_move_the_hilum_as_a_whole_and_the_run_says_so(
    image: PreparedCbct, monkeypatch: pytest.MonkeyPatch
) -> None:
    inside = np.zeros(SHAPE, dtype=bool)
    inside[12:16, 12:16, 12:16] = True
    elsewhere = Mask(np.zeros(SHAPE, dtype=bool), AFFINE)
    elsewhere.inside[:3] = True
    blind = replace(image, field=replace(image.field, usable=elsewhere))
    found = motion(blind, image, inside, 200.0, monkeypatch)
    assert found.source is HilumSource.FEW
    np.testing.assert_allclose(found.displacement, np.tile(SHIFT, (2, 1)))


def test_airways_that_were_not_found_leave_the_hilum_to_the_spine(
    image: PreparedCbct, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = motion(image, image, np.zeros(SHAPE, dtype=bool), 200.0, monkeypatch)
    assert found.source is HilumSource.STILL
    np.testing.assert_array_equal(found.displacement, np.zeros((2, 3)))
