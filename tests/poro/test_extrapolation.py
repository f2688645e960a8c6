"""Elastic continuation: exact on affine data, soft tends to exact, inverted elements are caught, corrections obey
point constraints.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from shapes import ellipsoid

from poro.fem import Tissue, extrapolate
from poro.fem.extrapolation import ExtrapolationStatus

TISSUE = Tissue()
GRADIENT = np.array([[-0.1, 0.02, 0.0], [0.03, -0.05, 0.04], [0.0, -0.02, 0.08]])


def test_affine_motion_known_everywhere_but_the_apex_is_continued() -> None:
    """The middle is imposed and the ends are free, as beyond a field of view; the ends stay close to the affine map."""
    mesh = ellipsoid(11.0)
    known = np.flatnonzero(np.abs(mesh.points[:, 2]) < 45)
    exact = mesh.points @ GRADIENT.T + [3, -2, 5]
    found = extrapolate(mesh, known, exact[known], TISSUE)
    assert found.status is ExtrapolationStatus.SOLVED
    assert_allclose(found.u[known], exact[known], atol=1e-12)
    outside = np.setdiff1d(np.arange(len(mesh.points)), known)
    assert np.linalg.norm((found.u - exact)[outside], axis=1).max() < 2.5
    assert (
        np.linalg.norm((found.u - exact)[outside], axis=1).mean() < 0.15 * np.linalg.norm(exact[outside], axis=1).mean()
    )


def test_interior_constraints_equal_lagrange_multipliers() -> None:
    """Elimination is checked against the saddle-point system of the multipliers."""
    from scipy.sparse import bmat, coo_matrix
    from scipy.sparse.linalg import spsolve

    from poro.fem.forms import stiffness

    mesh = ellipsoid(20.0)
    nodes = np.array([3, 17, 40, 61, 90])
    values = np.random.default_rng(0).normal(size=(5, 3))
    rows = (nodes[:, None] * 3 + np.arange(3)).ravel()
    n = 3 * len(mesh.points)
    pick = coo_matrix((np.ones(15), (np.arange(15), rows)), shape=(15, n))
    saddle = bmat([[stiffness(mesh, TISSUE.lame_kpa, TISSUE.shear_kpa), pick.T], [pick, None]]).tocsc()
    exact = spsolve(saddle, np.concatenate([np.zeros(n), values.ravel()]))[:n].reshape(-1, 3)
    found = extrapolate(mesh, nodes, values, TISSUE, min_det=-np.inf)
    assert_allclose(found.u, exact, atol=1e-9)


def test_soft_constraints_tend_to_exact_ones() -> None:
    mesh = ellipsoid(14.0)
    nodes = np.flatnonzero(np.abs(mesh.points[:, 2]) < 30)
    values = 0.5 * np.sin(mesh.points[nodes] / 20)
    exact = extrapolate(mesh, nodes, values, TISSUE).u
    gaps = [
        np.abs(extrapolate(mesh, nodes, values, TISSUE, np.full(len(nodes), w)).u - exact).max()
        for w in (1e1, 1e3, 1e5)
    ]
    assert gaps[2] < 1e-4
    assert_allclose([gaps[0] / gaps[1], gaps[1] / gaps[2]], 100, rtol=0.35)


def test_values_that_would_fold_the_mesh_are_released() -> None:
    mesh = ellipsoid(12.0)
    nodes = np.flatnonzero(np.abs(mesh.points[:, 2]) < 40)
    values = np.zeros((len(nodes), 3))
    wrong = np.argmin(np.linalg.norm(mesh.points[nodes], axis=1))
    values[wrong] = [40, 0, 0]
    found = extrapolate(mesh, nodes, values, TISSUE)
    assert found.status is ExtrapolationStatus.RELEASED
    assert nodes[wrong] in found.released
    assert found.det_f.min() > 0.05
    assert np.abs(found.u).max() < 1


def test_too_few_nodes_are_refused() -> None:
    with pytest.raises(ValueError, match="three or more"):
        extrapolate(ellipsoid(25.0), np.array([0, 1]), np.zeros((2, 3)), TISSUE)
