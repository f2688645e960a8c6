"""The hilum's motion by value, and every reason to fall back."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from registration.volume import Array, Mask, Volume
from tests.vatsloc import ball_scene as scene
from vatsloc.imaging.airways import TrackedAirways
from vatsloc.imaging.hilum import Hilum, track_hilum
from vatsloc.workflow import hilum
from vatsloc.workflow.hilum import HilumMotion, HilumSource, _Shifted, hilum_motion

INF_FROM_DEF = scene.DEF_FROM_INF.inverse()
AT = scene.CENTRE_DEF + np.array([-30.0, 5.0, -10.0])
POINTS = AT + np.random.default_rng(2).uniform(-8, 8, (15, 3))
AS_A_WHOLE = np.array([6.0, -4.0, 2.0])


def motion(points: Array) -> Array:
    """Of tissue that the spine places at points (n, 3) of the deflated CBCT: stretched along R about the hilum."""
    return AS_A_WHOLE + 0.1 * (points - AT) * np.array([1.0, 0, 0])


def before(points: Array) -> Array:
    """The way back: which points (n, 3) moved to these."""
    return AT + (points - AT - AS_A_WHOLE) / np.array([1.1, 1, 1])


class Registration:
    """Stands in for `register_ffd`."""

    def __init__(self, moving_from_fixed: Any, min_det: float = 0.5) -> None:
        self.found = SimpleNamespace(moving_from_fixed=moving_from_fixed, min_det=min_det)
        self.calls: list[dict[str, Any]] = []

    def __call__(self, fixed: Any, moving: Any, settings: Any, **rest: Any) -> Any:
        self.calls.append({"fixed": fixed, "moving": moving, "settings": settings, **rest})
        return self.found


def right(points: Array) -> Array:
    return INF_FROM_DEF(before(points))


def found(
    monkeypatch: pytest.MonkeyPatch,
    registration: Registration,
    contrast_hu: float = 300.0,
    lumen: bool = True,
    usable: Array | None = None,
) -> HilumMotion:
    """With airways 6 mm wide found at the hilum."""
    inflated, deflated = scene.cbct(scene.inflated()), scene.cbct(scene.deflated(), usable)
    work = deflated.volume.grid
    inside = scene.ball_of(work, AT + AS_A_WHOLE, 6.0) & lumen
    airways, place = scene.empty(scene.deflated()), Hilum(AT, 20.0, True)

    def track(cbct: Any, expected: Mask, hilum_ras: Array) -> TrackedAirways:
        assert cbct is deflated
        assert expected is airways
        assert_array_equal(hilum_ras, AT)
        return TrackedAirways(inside, AS_A_WHOLE, contrast_hu, 0.0)

    monkeypatch.setattr(hilum, "track_hilum", track)
    monkeypatch.setattr(hilum, "register_ffd", registration)
    return hilum_motion(inflated, deflated, airways, place, INF_FROM_DEF, POINTS)


def test_points_move_as_the_registration_of_their_airways_says(monkeypatch: pytest.MonkeyPatch) -> None:
    known = Registration(right)
    moved = found(monkeypatch, known)
    assert moved.source is HilumSource.AIRWAYS
    assert_allclose(moved.displacement, motion(POINTS), atol=0.02)


def test_the_inflated_scan_is_registered_inside_the_rim_of_the_airways_from_their_shift(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    known = Registration(right)
    grid = scene.deflated().grid
    usable = grid.points()[..., 2] < AT[2] + AS_A_WHOLE[2] + 3.0
    found(monkeypatch, known, usable=usable)
    (call,) = known.calls
    assert_array_equal(call["fixed"].ras_from_ijk, scene.deflated().ras_from_ijk)
    assert_array_equal(call["moving"].ras_from_ijk, scene.inflated().ras_from_ijk)
    region = call["fixed_mask"].inside
    assert not (region & ~usable).any()
    off = np.linalg.norm(grid.points() - AT - AS_A_WHOLE, axis=-1)
    assert region[usable & (off < 9.0)].all()
    assert not region[off > 13.0].any()
    assert call["moving_mask"].inside.all()
    assert_array_equal(call["moving_mask"].ras_from_ijk, scene.inflated().ras_from_ijk)
    assert_allclose(call["prior"](POINTS), INF_FROM_DEF(POINTS - AS_A_WHOLE))


def test_the_prior_takes_the_shift_back_before_the_spine() -> None:
    assert_allclose(_Shifted(INF_FROM_DEF, AS_A_WHOLE)(scene.DEF_FROM_INF(POINTS) + AS_A_WHOLE), POINTS)


@pytest.mark.parametrize(
    ("case", "source"),
    [
        ({"lumen": False}, HilumSource.STILL),
        ({"contrast_hu": 59.0}, HilumSource.STILL),
        ({"contrast_hu": 61.0}, HilumSource.AIRWAYS),
        ({"usable": np.zeros(scene.deflated().hu.shape, bool)}, HilumSource.FEW),
    ],
)
def test_what_is_seen_of_the_airways_decides(
    monkeypatch: pytest.MonkeyPatch, case: dict[str, Any], source: HilumSource
) -> None:
    moved = found(monkeypatch, Registration(right), **case)
    assert moved.source is source
    expected = {
        HilumSource.STILL: np.zeros_like(POINTS),
        HilumSource.FEW: np.broadcast_to(AS_A_WHOLE, POINTS.shape),
        HilumSource.AIRWAYS: motion(POINTS),
    }
    assert_allclose(moved.displacement, expected[source], atol=0.02)


def test_a_registration_that_goes_astray_folds_or_cannot_be_turned_round_gives_way_to_the_shift(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def off(distance_mm: float) -> Any:
        """The registration ends so far from the shift, along S."""
        return lambda points: INF_FROM_DEF(points - AS_A_WHOLE - [0, 0, distance_mm])

    for distance, source in ((29.0, HilumSource.AIRWAYS), (31.0, HilumSource.SHIFT)):
        moved = found(monkeypatch, Registration(off(distance)))
        assert moved.source is source
        assert_allclose(moved.displacement[:, 2], AS_A_WHOLE[2] + (distance if distance < 30 else 0), atol=0.02)
    folded = found(monkeypatch, Registration(right, min_det=0.0))
    assert folded.source is HilumSource.SHIFT
    assert_allclose(folded.displacement, np.broadcast_to(AS_A_WHOLE, POINTS.shape))
    # All of space on one plane: most points are not reached.
    flat = found(monkeypatch, Registration(lambda points: right(points) * [1, 1, 0] + [0, 0, scene.CENTRE_INF[2]]))
    assert flat.source is HilumSource.SHIFT


def test_of_the_airways_those_about_the_hilum_alone_tell_how_far_it_went() -> None:
    """A tube of 6 mm at the hilum, and a thicker one 60 mm beside it that went another way."""
    grid = scene.grid_about(AT, 64, 2.5)
    off = grid.points() - AT

    def tubes(near: Array, far: Array) -> Array:
        along = np.abs(off[..., 2]) < 25.0
        thin = np.linalg.norm((off - near)[..., :2], axis=-1) < 6.0
        return along & (thin | (np.linalg.norm((off - far - [0.0, 60.0, 0.0])[..., :2], axis=-1) < 9.0))

    went = np.array([7.5, -5.0, 0.0])
    hu = np.where(tubes(went, np.array([-7.5, 5.0, 0.0])), -950.0, 0.0).astype(np.float32)
    expected = Mask(tubes(np.zeros(3), np.zeros(3)), grid.ras_from_ijk)
    tracked = track_hilum(scene.cbct(Volume(hu, grid.ras_from_ijk)), expected, AT)
    assert_allclose(tracked.shift_mm[:2], went[:2], atol=1.3)
    assert tracked.contrast_hu > 700.0
    assert np.linalg.norm(off[tracked.inside], axis=1).max() < 40.0


def test_airways_that_the_inflated_scan_does_not_see_move_the_hilum_as_a_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    def training_only(*_args: Any, **_rest: Any) -> Any:
        raise ValueError("no sample")

    moved = found(monkeypatch, training_only)  # type: ignore[arg-type]
    assert moved.source is HilumSource.FEW
    assert_allclose(moved.displacement, np.broadcast_to(AS_A_WHOLE, POINTS.shape))
