"""Gauss-Seidel sweeps over blocks of three: against dense triangular solutions, and the multigrid that uses them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import bsr_matrix

from poro.arrays import Array
from poro.linalg.relaxation import backward, forward_from_zero


@pytest.fixture
def system() -> tuple[bsr_matrix, Array, Array]:
    """A symmetric positive definite matrix of 5 nodes, two of them not connected; its diagonal's blocks, inverted."""
    rng = np.random.default_rng(3)
    dense = rng.normal(size=(15, 15))
    dense = dense @ dense.T + 20 * np.eye(15)
    dense[0:3, 9:12] = dense[9:12, 0:3] = 0
    inverses = np.stack([np.linalg.inv(dense[n : n + 3, n : n + 3]) for n in range(0, 15, 3)])
    return bsr_matrix(dense, blocksize=(3, 3)), inverses, rng.normal(size=15)


def lower(dense: Array) -> Array:
    """What lies on and below the diagonal, by blocks of three."""
    node = np.arange(len(dense)) // 3
    return np.where(node[:, None] >= node, dense, 0)


def test_a_forward_sweep_from_zero_solves_what_lies_on_and_before_the_diagonal(
    system: tuple[bsr_matrix, Array, Array],
) -> None:
    matrix, inverses, right = system
    x, left = forward_from_zero(matrix, inverses, right)
    assert_allclose(x, np.linalg.solve(lower(matrix.toarray()), right), rtol=1e-12)
    assert_allclose(left, right - matrix @ x, atol=1e-12)


def test_a_backward_sweep_goes_on_from_what_there_is(system: tuple[bsr_matrix, Array, Array]) -> None:
    matrix, inverses, right = system
    dense = matrix.toarray()
    upper = lower(dense.T).T
    start = np.linspace(-1, 1, 15)
    x = start.copy()
    backward(matrix, inverses, right, x)
    assert_allclose(x, start + np.linalg.solve(upper, right - dense @ start), rtol=1e-12)
