"""Values carried from scattered points by quadratic fits."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from registration.maps import moving_least_squares as module
from registration.maps.moving_least_squares import moving_least_squares
from registration.volume import Array

RNG = np.random.default_rng(4)
POINTS = RNG.uniform(-60, 60, (3000, 3))
PLACES = RNG.uniform(-65, 65, (200, 3))
AFFINE = np.array([[0.7, 0.1, 0.0], [-0.1, 0.8, 0.05], [0.0, 0.1, 0.6]])


def bent(points: Array) -> Array:
    x, y, z = (points / 40.0).T
    return np.column_stack([x * y - 2 * z**2, x**2 + y * z, 3 * x * z - y**2])


def test_affine_fields_are_kept_to_rounding() -> None:
    found = moving_least_squares(POINTS, PLACES)(POINTS @ AFFINE.T + 5.0)
    assert_allclose(found, PLACES @ AFFINE.T + 5.0, atol=1e-10)


def test_quadratic_fields_are_kept_but_for_what_the_ridge_takes() -> None:
    found = moving_least_squares(POINTS, PLACES)(bent(POINTS))
    beyond = (np.abs(PLACES) > 60).any(axis=1)
    assert beyond.sum() > 20
    size = np.abs(bent(PLACES)).mean()
    assert np.abs(found - bent(PLACES))[~beyond].mean() < 0.02 * size
    assert np.abs(found - bent(PLACES))[beyond].mean() < 0.15 * size


def test_scatter_is_averaged() -> None:
    """Inside, a quadratic fit to some hundred points leaves about the root of ten in a hundred of their scatter."""
    scatter = RNG.normal(0, 1.0, POINTS.shape)
    inside = PLACES[(np.abs(PLACES) < 40).all(axis=1)]
    found = moving_least_squares(POINTS, inside)(scatter)
    assert 0.1 < found.std() < 0.35


def test_against_a_fit_done_one_place_at_a_time() -> None:
    place = np.array([[3.0, -8.0, 12.0]])
    fit = moving_least_squares(POINTS, place)
    far = np.linalg.norm(POINTS - place, axis=1)
    near = np.argsort(far)[: module.NEIGHBOURS]
    x = POINTS[near] - place
    terms = np.column_stack([np.ones(len(x)), x, *(x[:, [a]] * x[:, [b]] for a in range(3) for b in range(a, 3))])
    closeness = np.exp(-0.5 * ((far[near] - far.min()) / module.REACH_MM) ** 2)
    scale = np.sqrt(closeness / closeness.sum())[:, None]
    ridge = np.sqrt(module.RIDGE_MM2) * np.diag([0.0, 1, 1, 1, *(6 * [module.REACH_MM])])
    system = np.concatenate([scale * terms, ridge])
    values = np.sin(POINTS / 30.0)
    trend = np.linalg.lstsq(np.column_stack([np.ones(len(POINTS)), POINTS]), values)[0]
    beyond = values - np.column_stack([np.ones(len(POINTS)), POINTS]) @ trend
    fitted = np.linalg.lstsq(system, np.concatenate([scale * beyond[near], np.zeros((10, 3))]))[0][0]
    assert_allclose(fit(values)[0], fitted + np.concatenate([[1.0], place[0]]) @ trend, atol=1e-9)


@pytest.mark.parametrize("count", [40, 5])
def test_points_in_a_plane_say_nothing_across_it(count: int) -> None:
    """Fewer points than neighbours, and all in one plane: what is carried across stays as large as what they show."""
    flat = np.column_stack([RNG.uniform(-30, 30, (count, 2)), np.zeros(count)])
    values = RNG.normal(0, 1.0, (count, 3))
    found = moving_least_squares(flat, flat + np.array([0.0, 0.0, 15.0]))(values)
    assert np.abs(found).max() < 3 * np.abs(values).max()


def test_one_point_gives_its_value_everywhere() -> None:
    found = moving_least_squares(POINTS[:1], PLACES)
    assert_array_equal(found.near, np.zeros((len(PLACES), 1)))
    assert_allclose(found.weight, 1.0)
