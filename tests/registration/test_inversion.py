"""Maps turned round: known inverses, a field and its inverse within 0.1 mm, strong compression by Newton's steps."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from registration.maps.bspline import BSplineField, control_grid
from registration.maps.field import DisplacementField, compose, sample_map
from registration.maps.inversion import invert_at
from registration.maps.rigid import RigidTransform
from registration.volume import Array, Grid
from tests.registration.scenes import oriented

CENTRE = np.array([10.0, -30.0, 120.0])
GRID = oriented("LPS", (44, 40, 38), 2.5, CENTRE)


def bump(height_mm: float, seed: int = 0) -> BSplineField:
    control = control_grid(GRID, 20.0)
    c = np.random.default_rng(seed).normal(scale=height_mm, size=(*control.shape, 3))
    return BSplineField(c, control.ras_from_ijk)


def inner_points(n: int = 400) -> Array:
    return GRID.to_ras(np.random.default_rng(2).uniform(8, 30, (n, 3)))


def test_the_inverse_of_an_affine_map_by_value() -> None:
    a = np.array([[0.8, 0.1, 0.0], [-0.1, 0.9, 0.05], [0.0, 0.1, 1.2]])
    y = inner_points()
    found = invert_at(lambda x: x @ a.T + [5.0, -3.0, 2.0], y, tolerance_mm=1e-8)
    assert_allclose(found.points_fixed, (y - [5.0, -3.0, 2.0]) @ np.linalg.inv(a).T, atol=1e-6)


def test_the_inverse_of_a_shift_takes_one_step() -> None:
    found = invert_at(lambda x: x + np.array([5.0, -3.0, 2.0]), inner_points())
    assert found.iterations == 1


def test_residuals_are_what_is_left() -> None:
    field, y = bump(3.0), inner_points()
    found = invert_at(field, y)
    assert found.residual_mm.max() <= 0.01
    assert_allclose(np.linalg.norm(field(found.points_fixed) - y, axis=1), found.residual_mm, atol=1e-9)


def test_newton_takes_over_where_the_fixed_point_does_not_contract() -> None:
    squeeze = np.diag([2.6, 2.6, 2.6])
    y = inner_points() - CENTRE
    found = invert_at(lambda x: x @ squeeze, y, tolerance_mm=1e-6)
    assert_allclose(found.points_fixed, y / 2.6, atol=1e-5)


def test_a_point_without_an_origin_says_so() -> None:
    found = invert_at(lambda x: np.clip(x, -10, 10), np.array([[0.0, 0.0, 25.0], [1.0, 2.0, 3.0]]))
    assert_allclose(found.residual_mm, [15.0, 0.0], atol=0.02)


@pytest.mark.parametrize("height_mm", [2.0, 6.0])
def test_a_field_and_its_inverse_compose_to_nothing(height_mm: float) -> None:
    move = RigidTransform.about(CENTRE, np.array([0.1, -0.1, 0.2]), np.array([8.0, 4.0, -6.0]))
    forward = compose(move, bump(height_mm).dense(GRID))
    target = oriented("RAS", (26, 24, 22), 2.5, move(CENTRE[None])[0])
    y = target.points().reshape(-1, 3)
    found = invert_at(forward, y, move.inverse()(y))
    inverse = DisplacementField((found.points_fixed - y).reshape(*target.shape, 3), target.ras_from_ijk)
    assert np.linalg.norm(compose(forward, inverse).vectors, axis=3).max() < 0.1
    assert np.linalg.norm(inverse.vectors, axis=3).max() > 5
    points = inner_points(100) * 0.3 + CENTRE * 0.7
    assert np.linalg.norm(inverse(forward(points)) - points, axis=1).max() < 0.1


def test_composition_applies_the_inner_map_first() -> None:
    turn = RigidTransform.about(CENTRE, np.array([0.0, 0.0, np.pi / 2]), np.zeros(3))
    shift = sample_map(lambda x: x + np.array([4.0, 0.0, 0.0]), GRID)
    assert_allclose(compose(turn, shift)(CENTRE[None]), CENTRE[None] + np.array([0.0, 4.0, 0.0]), atol=1e-4)


def test_the_determinant_of_an_affine_field() -> None:
    a = np.array([[0.7, 0.1, 0.0], [-0.2, 1.1, 0.3], [0.1, 0.0, 0.9]])
    grid = Grid((9, 8, 7), np.array([[0, -2.0, 0, 1], [3.0, 0, 0, 2], [0, 0, 1.5, 3], [0, 0, 0, 1]]))
    field = sample_map(lambda x: x @ a.T, grid)
    assert_allclose(field.jacobian_determinant(), np.linalg.det(a), rtol=1e-4)


def test_a_mirror_has_a_negative_determinant() -> None:
    grid = Grid((5, 5, 5), np.eye(4))
    vectors = np.zeros((5, 5, 5, 3))
    vectors[..., 1] = -2 * np.arange(5.0)[None, :, None]
    assert_allclose(DisplacementField(vectors, np.eye(4)).jacobian_determinant(), -1.0)
    assert DisplacementField(vectors, grid.ras_from_ijk)(np.array([[1.0, 3.0, 2.0]])).tolist() == [[1.0, -3.0, 2.0]]
