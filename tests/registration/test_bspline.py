"""Cubic B-splines: three evaluations agree, refinement is exact, polynomials and bending energies are known values."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from registration.maps.bspline import BSplineField, Lattice, basis_rows, control_grid
from registration.terms.bending import BendingEnergy
from registration.volume import Array, Grid
from tests.registration.scenes import oriented


@pytest.fixture(scope="module")
def grid() -> Grid:
    return oriented("LPS", (33, 29, 27), 2.0, np.array([5.0, -8.0, 60.0]))


@pytest.fixture(scope="module")
def spline(grid: Grid) -> BSplineField:
    control = control_grid(grid, 16.0)
    c = np.random.default_rng(0).normal(size=(*control.shape, 3))
    return BSplineField(c, control.ras_from_ijk)


def scattered(grid: Grid, n: int = 500) -> Array:
    return grid.to_ras(np.random.default_rng(1).uniform(0, np.array(grid.shape) - 1, (n, 3)))


def test_dense_pointwise_and_sparse_evaluation_agree(grid: Grid, spline: BSplineField) -> None:
    points = grid.points().reshape(-1, 3)
    u = spline.displacement(points)
    assert_allclose(spline.dense(grid).vectors.reshape(-1, 3), u, atol=2e-6)
    assert_allclose(basis_rows(spline.control, points) @ spline.coefficients.reshape(-1, 3), u, atol=1e-12)
    assert_allclose(spline(points), points + u)


def test_refinement_is_the_same_map(grid: Grid, spline: BSplineField) -> None:
    fine = spline.refined()
    assert_allclose(fine.control.spacing, 8.0)
    points = scattered(grid)
    assert_allclose(fine.displacement(points), spline.displacement(points), atol=1e-12)
    assert_allclose(fine.refined().displacement(points), spline.displacement(points), atol=1e-12)


def test_linear_coefficients_give_that_linear_displacement(grid: Grid) -> None:
    control = control_grid(grid, 16.0)
    a = np.array([[0.1, 0.0, -0.05], [0.02, -0.2, 0.0], [0.0, 0.03, 0.15]])
    spline = BSplineField(control.points() @ a.T + [1.0, 2.0, 3.0], control.ras_from_ijk)
    points = scattered(grid)
    assert_allclose(spline.displacement(points), points @ a.T + [1.0, 2.0, 3.0], atol=1e-10)
    assert_allclose(spline.dense(grid).jacobian_determinant(), np.linalg.det(np.eye(3) + a), rtol=1e-4)


def test_beyond_the_grid_the_nearest_displacement_holds(grid: Grid, spline: BSplineField) -> None:
    edge = spline.control.to_ras(np.array([[1.0, 2.0, 2.5]]))
    beyond = spline.control.to_ras(np.array([[-9.0, 2.0, 2.5]]))
    assert_allclose(spline.displacement(beyond), spline.displacement(edge), atol=1e-12)


def test_the_adjoint_is_the_transpose(grid: Grid, spline: BSplineField) -> None:
    lattice = Lattice(spline.control, grid)
    rng = np.random.default_rng(2)
    c, y = rng.normal(size=(3, *spline.control.shape)), rng.normal(size=(3, *grid.shape))
    assert_allclose(np.vdot(lattice.forward(c), y), np.vdot(c, lattice.adjoint(y)), rtol=1e-10)
    weights = rng.uniform(size=grid.shape)
    diagonal = lattice.adjoint_squared(weights[None])[0]
    unit = np.zeros((1, *spline.control.shape))
    unit[0, 2, 3, 2] = 1.0
    assert_allclose(diagonal[2, 3, 2], np.sum(weights * lattice.forward(unit)[0] ** 2), rtol=1e-5)


def test_a_turned_control_grid_is_refused(grid: Grid) -> None:
    turned = Grid(grid.shape, grid.ras_from_ijk @ np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
    with pytest.raises(ValueError, match="parallel"):
        Lattice(control_grid(grid, 16.0), turned)


def test_bending_energy_of_quadratics_by_value(grid: Grid) -> None:
    control = control_grid(grid, 16.0)
    energy, p = BendingEnergy(control), control.points()
    square = np.zeros((3, *control.shape))
    square[0] = 0.5 * 0.004 * p[..., 2] ** 2  # d2u/dz2 = 0.004; the spline adds a constant alone
    assert_allclose(np.vdot(square, energy.apply(square)), 0.004**2, rtol=1e-9)
    saddle = np.zeros_like(square)
    saddle[1] = 0.003 * p[..., 0] * p[..., 2]  # counted twice, as xz and zx
    assert_allclose(np.vdot(saddle, energy.apply(saddle)), 2 * 0.003**2, rtol=1e-9)
    plane = np.moveaxis(p @ np.array([[0.1, 0.2, 0.0], [0.0, 0.1, 0.3], [0.2, 0.0, 0.1]]), 3, 0)
    assert abs(np.vdot(plane, energy.apply(plane))) < 1e-12


def test_bending_diagonal_is_that_of_its_matrix(grid: Grid) -> None:
    control = control_grid(grid, 16.0)
    energy = BendingEnergy(control)
    unit = np.zeros((1, *control.shape))
    unit[0, 1, 2, 3] = 1.0
    assert_allclose(energy.diagonal()[1, 2, 3], energy.apply(unit)[0, 1, 2, 3], rtol=1e-12)
