"""Correspondences: what belongs together stays together, and weights count."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from registration.correspondences import Correspondences

FIXED = np.arange(12.0).reshape(4, 3)
MATCHES = Correspondences.of(FIXED, FIXED + 10, np.linspace(0.6, 0.9, 4), np.array([1.0, 2, 0, 4]))


def test_weights_are_one_and_correlation_unknown_unless_given() -> None:
    plain = Correspondences.of(FIXED, FIXED)
    assert_array_equal(plain.weights, np.ones(4))
    assert np.isnan(plain.ncc).all()
    assert len(Correspondences.none()) == 0


def test_choosing_and_joining_keep_rows_together() -> None:
    chosen = MATCHES.only(np.array([False, True, False, True]))
    assert_array_equal(chosen.moving - chosen.fixed, np.full((2, 3), 10.0))
    assert_array_equal(chosen.weights, [2, 4])
    joined = chosen.joined(MATCHES.only(np.array([0])))
    assert_array_equal(joined.fixed, FIXED[[1, 3, 0]])
    assert_array_equal(joined.ncc, MATCHES.ncc[[1, 3, 0]])
    assert_array_equal(joined.weights, [2, 4, 1])


def test_one_side_goes_to_another_frame_and_the_rest_stays() -> None:
    moved = MATCHES.mapped(moving=lambda points: 2 * points)
    assert_array_equal(moved.fixed, FIXED)
    assert_array_equal(moved.moving, 2 * FIXED + 20)
    assert_array_equal(moved.weights, MATCHES.weights)
    turned = MATCHES.mapped(fixed=lambda points: points - 1).swapped()
    assert_array_equal(turned.moving, FIXED - 1)
    assert_array_equal(turned.fixed, FIXED + 10)


def test_what_does_not_belong_together_is_refused() -> None:
    with pytest.raises(ValueError, match=r"must be \(n, 3\), \(n, 3\), \(n,\) and \(n,\), got"):
        Correspondences.of(FIXED, FIXED[:3])
    with pytest.raises(ValueError, match="must not be negative"):
        Correspondences.of(FIXED, FIXED, weights=-np.ones(4))
