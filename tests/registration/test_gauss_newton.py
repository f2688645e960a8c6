"""Conjugate gradients and Gauss-Newton: exact where quadratic, and honest about how they ended."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from registration.terms.gauss_newton import SolveStatus, Stop, conjugate_gradients, gauss_newton
from registration.terms.objective import QuadraticModel
from registration.volume import Array

SHAPE = (3, 2, 2, 2)
ROOT = np.random.default_rng(3).normal(size=(24, 24))
HESSIAN = ROOT @ ROOT.T + 5 * np.eye(24)
LOWEST = np.random.default_rng(4).normal(size=24)


class Bowl:
    """(c - lowest)^T H (c - lowest) / 2."""

    def __init__(self, hessian: Array) -> None:
        self.hessian = hessian

    def value(self, c: Array) -> float:
        off = c.ravel() - LOWEST
        return float(0.5 * off @ self.hessian @ off)

    def model(self, c: Array) -> QuadraticModel:
        gradient = (self.hessian @ (c.ravel() - LOWEST)).reshape(SHAPE)
        diagonal = np.abs(np.diag(self.hessian)).reshape(SHAPE)
        return QuadraticModel(self.value(c), gradient, lambda d: (self.hessian @ d.ravel()).reshape(SHAPE), diagonal)


def test_a_quadratic_is_solved_to_the_residual_that_is_asked_for() -> None:
    model = Bowl(HESSIAN).model(np.zeros(SHAPE))
    solve = conjugate_gradients(model, tolerance=1e-4)
    assert solve.status is SolveStatus.SOLVED
    assert_allclose(solve.step.ravel(), LOWEST, atol=1e-3)
    assert solve.residuals[0] == 1.0
    assert solve.residuals[-1] <= 1e-4 < solve.residuals[-2]
    left = np.linalg.norm(model.apply(solve.step) + model.gradient) / np.linalg.norm(model.gradient)
    assert left == pytest.approx(solve.residuals[-1], abs=2e-5)


def test_too_few_iterations_are_said() -> None:
    solve = conjugate_gradients(Bowl(HESSIAN).model(np.zeros(SHAPE)), tolerance=1e-6, iterations=3)
    assert solve.status is SolveStatus.ITERATIONS
    assert len(solve.residuals) == 4
    assert solve.residuals[-1] > 1e-6


def test_negative_curvature_ends_the_solve_with_a_step_downhill() -> None:
    model = Bowl(-HESSIAN).model(np.zeros(SHAPE))
    solve = conjugate_gradients(model)
    assert solve.status is SolveStatus.NEGATIVE_CURVATURE
    assert len(solve.residuals) == 1
    assert np.vdot(model.gradient, solve.step) < 0


def test_a_descent_keeps_how_each_of_its_steps_was_solved() -> None:
    descent = gauss_newton(Bowl(HESSIAN), np.zeros(SHAPE), residual=1e-3)
    assert descent.stop in (Stop.CONVERGED, Stop.SMALL_STEP)
    assert_allclose(descent.coefficients.ravel(), LOWEST, atol=1e-3)
    assert len(descent.solves) == len(descent.history) - 1
    assert all(status is SolveStatus.SOLVED and residuals[-1] <= 1e-3 for status, residuals in descent.solves)
