"""A height over a plane that bends to keypoints and gas, and no more than they ask for."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from registration.volume import Array
from vatsloc.workflow.bend import CLEARANCE_MM, REACH, STEP_MM, Bend, bend_to

CENTRE = np.array([40.0, -20.0, 100.0])
AXES = np.array([[0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
NORMAL = np.cross(*AXES)
NOTHING = np.zeros((0, 3)), np.zeros(0)


def at(along: Array, above: Array) -> Array:
    """Points (n, 3) at plane coordinates (n, 2) and heights (n,) mm."""
    return np.asarray(CENTRE + along @ AXES + above[:, None] * NORMAL)


def hill(along: Array) -> Array:
    """A height (n,) mm that a fissure may have: 8 mm at its top, 25 mm wide, and a slope."""
    return np.asarray(8 * np.exp(-((along / 35.0) ** 2).sum(axis=1)) + 0.05 * along[:, 0] - 1.0)


def scattered(n: int, seed: int) -> tuple[Array, Array]:
    """Plane coordinates (n, 2) mm within 80 mm, and standard normal numbers (n,)."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-80, 80, (n, 2)), rng.standard_normal(n)


def test_gas_tells_where_the_sheet_lies_and_strays_do_not() -> None:
    along, noise = scattered(900, 1)
    off = hill(along) + noise
    off[::10] += 30.0
    bend = bend_to(CENTRE, AXES, (*NOTHING, np.zeros(0)), (at(along, off), off))
    probe, _ = scattered(400, 2)
    wrong = np.abs(bend.height(at(probe, np.zeros(400))) - hill(probe))
    assert np.percentile(wrong, 95) < 1.5
    assert wrong.mean() < 0.6


def test_keypoints_push_the_sheet_to_their_other_side_and_not_beyond() -> None:
    along, noise = scattered(1500, 3)
    off = hill(along) + np.sign(noise) * (0.5 + 8 * np.abs(noise))
    points, side = at(along, off), np.sign(noise)
    bend = bend_to(CENTRE, AXES, (points, off, side), NOTHING)
    wrong_before, wrong = side * off < 0, side * (off - bend.height(points)) < 0
    assert wrong_before.mean() > 0.1
    assert wrong.mean() < 0.02


def test_what_already_holds_bends_nothing() -> None:
    along, noise = scattered(300, 4)
    side = np.sign(noise)
    off = side * (CLEARANCE_MM + 0.1 + np.abs(noise))
    gas = at(along, np.zeros(300)), np.zeros(300)
    bend = bend_to(CENTRE, AXES, (at(along, off), off, side), gas)
    assert_allclose(bend.coefficients, 0, atol=1e-9)
    none = bend_to(CENTRE, AXES, (*NOTHING, np.zeros(0)), NOTHING)
    assert_allclose(none.coefficients, 0, atol=1e-12)


def test_a_height_is_a_cubic_spline_that_stays_where_it_ends() -> None:
    """Coefficients that grow by 1 mm from one to the next are a slope of 1 mm in STEP_MM."""
    n = 2 * REACH + 1
    slope = np.tile(np.arange(n, dtype=float)[:, None] - REACH, (1, n))
    bend = Bend(CENTRE, AXES, slope)
    along = np.array([[0.0, 0.0], [30.0, 10.0], [-50.0, 70.0], [20.0, -40.0]])
    assert_allclose(bend.height(at(along, np.array([0.0, 5.0, -3.0, 40.0]))), along[:, 0] / STEP_MM, atol=1e-12)
    last = (REACH - 1) * STEP_MM
    beyond = bend.height(at(np.array([[last, 0.0], [last + 500.0, 0.0], [0.0, 1e4]]), np.zeros(3)))
    assert_allclose(beyond, [REACH - 1, REACH - 1, 0.0], atol=1e-9)
