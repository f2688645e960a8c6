"""Lattice fields: exact for linear functions, true distances."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from phantoms.fields import Lattice, as_distance, coverage, lattice_over, refine, smooth_noise, soft_max
from phantoms.voxels import Grid


def _linear(lattice: Lattice) -> Lattice:
    x, y, z = lattice.axes
    return lattice.like(2 * x - 3 * y + 0.5 * z + 7)


def test_values_and_gradient_of_a_linear_field_are_exact() -> None:
    field = _linear(lattice_over(np.array([-10, -5, 0]), np.array([11, 16, 17]), 3.0))
    points = np.random.default_rng(0).uniform([-9, -4, 1], [9, 14, 15], (50, 3))
    value, gradient = field.with_gradient(points)
    expected = points @ [2, -3, 0.5] + 7
    assert_allclose(value, expected, atol=1e-4)
    assert_allclose(field.at(points), expected, atol=1e-4)
    assert_allclose(gradient, np.tile([2, -3, 0.5], (50, 1)), atol=1e-5)


def test_field_on_a_flipped_image_equals_field_at_its_voxels() -> None:
    field = _linear(lattice_over(np.array([-10, -5, 0]), np.array([11, 16, 17]), 3.0))
    grid = Grid((5, 6, 4), np.array([[-2.0, 0, 0, 8], [0, -2, 0, 12], [0, 0, 3, 2], [0, 0, 0, 1]]))
    assert_allclose(field.on(grid), grid.points() @ [2, -3, 0.5] + 7, atol=1e-4)


def test_rotated_image_is_refused() -> None:
    field = lattice_over(np.zeros(3), np.full(3, 9.0), 3.0)
    turned = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    with pytest.raises(ValueError, match="parallel to RAS"):
        field.on(Grid((3, 3, 3), turned))


def test_refine_is_linear_between_samples() -> None:
    coarse = np.arange(4.0)[:, None, None] + np.zeros((4, 3, 3))
    assert_allclose(refine(coarse, 2, (7, 5, 5))[:, 2, 2], np.arange(7) / 2, atol=1e-6)


def test_distance_of_a_ball() -> None:
    lattice = lattice_over(np.full(3, -40.0), np.full(3, 40.0), 2.0)
    x, y, z = lattice.axes
    distance = as_distance(lattice, (x**2 + y**2 + z**2) / 400 - 1)
    points = np.random.default_rng(1).uniform(-20, 20, (200, 3))
    radius = np.linalg.norm(points, axis=1)
    near = np.abs(radius - 20) < 3
    assert_allclose(distance.at(points)[near], radius[near] - 20, atol=0.35)
    assert_allclose(distance.at(points), radius - 20, atol=1.5)


def test_crop_keeps_values_and_places() -> None:
    field = _linear(lattice_over(np.zeros(3), np.full(3, 30.0), 3.0))
    part = field.crop(field.values > 30, 3.0)
    at = part.points()[[0, -1]]
    assert_allclose(part.at(at), field.at(at), atol=1e-5)


def test_soft_max_is_the_maximum_away_from_the_edge_and_above_it_on_the_edge() -> None:
    a, b = np.array([1.0, 0.0]), np.array([9.0, 0.0])
    assert_allclose(soft_max(a, b, 4.0), [9.0, 1.0])


def test_coverage_counts_half_a_voxel_on_the_surface() -> None:
    assert_allclose(coverage(np.array([-2.0, -0.5, 0.0, 2.0]), 2.0), [1.0, 0.75, 0.5, 0.0])


def test_noise_has_unit_variance_and_the_length_asked_for() -> None:
    lattice = lattice_over(np.zeros(3), np.full(3, 240.0), 4.0)
    noise = smooth_noise(lattice, 16.0, np.random.default_rng(3))
    assert noise.std() == pytest.approx(1, abs=1e-3)
    # A Gaussian kernel of standard deviation L leaves the correlation exp(-d^2 / 4 L^2).
    lag = np.mean(noise[4:] * noise[:-4])
    assert lag == pytest.approx(np.exp(-0.25), abs=0.08)
