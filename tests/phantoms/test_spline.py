"""Spline maps: value, gradient and inverse agree with one another."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from phantoms.spline import SplineMap, basis, cofactors, determinant


@pytest.fixture(scope="module")
def wavy() -> SplineMap:
    rng = np.random.default_rng(2)
    return SplineMap(rng.normal(0, 2.5, (9, 8, 10, 3)), np.array([-30.0, -20, -50]), 15.0)


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return np.random.default_rng(3).uniform([-10, -5, -30], [70, 60, 60], (300, 3))


def test_gradient_is_the_slope_of_the_map(wavy: SplineMap, points: np.ndarray) -> None:
    _, f = wavy.with_gradient(points)
    for axis, step in enumerate(1e-4 * np.eye(3)):
        slope = (wavy(points + step) - wavy(points - step)) / 2e-4
        assert_allclose(f[:, :, axis], slope, atol=1e-6)


def test_inverse_leads_back_within_a_thousandth_of_a_millimetre(wavy: SplineMap, points: np.ndarray) -> None:
    axes = [np.arange(a, b, 5.0) for a, b in ((-15, 75), (-10, 65), (-35, 65))]
    samples = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    assert wavy.determinant(samples).min() > 0.2
    source, left = wavy.inverse(wavy(points), samples)
    assert_allclose(source, points, atol=1e-3)
    assert left.max() < 1e-3


def test_matrices_and_kernel_give_the_same_map(wavy: SplineMap, points: np.ndarray) -> None:
    value, *slopes = basis(points, wavy.origin, wavy.spacing, wavy.coefficients.shape[:3])
    u = wavy.coefficients.reshape(-1, 3)
    x, f = wavy.with_gradient(points)
    assert_allclose(points + value @ u, x, atol=1e-12)
    assert_allclose(np.stack([s @ u for s in slopes], axis=-1) + np.eye(3), f, atol=1e-12)
    assert_allclose(value.sum(axis=1), 1, atol=1e-12)


def test_cofactors_and_determinant_of_random_matrices() -> None:
    f = np.random.default_rng(4).standard_normal((20, 3, 3))
    assert_allclose(determinant(f), np.linalg.det(f), atol=1e-12)
    inverse = np.swapaxes(np.linalg.inv(f), 1, 2) * np.linalg.det(f)[:, None, None]
    assert_allclose(cofactors(f), inverse, atol=1e-10)
