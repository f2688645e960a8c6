"""The inverse at chosen unknowns against dense algebra, for every solver, and contact on it in single precision."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import identity
from shapes import compliance_of, ellipsoid

import poro.contact.compliance
from poro.contact import ChestWall, Compliance, ContactStatus, level_set, solve_contact
from poro.fem import Tissue, solid
from poro.fem.forms import body_load, stiffness
from poro.fem.solid import unknowns_of
from poro.fem.tissue import GRAVITY_KPA_PER_MM
from poro.linalg import inverse_at, linear_solver


@pytest.mark.parametrize(("limit", "tolerance"), [(10**9, 1e-11), (0, 1e-8)])
def test_inverse_at_chosen_unknowns(limit: int, tolerance: float) -> None:
    mesh, tissue = ellipsoid(22.0), Tissue()
    free = np.setdiff1d(np.arange(len(mesh.points)), np.flatnonzero(mesh.points[:, 2] < -40))
    rows = unknowns_of(free)
    matrix = stiffness(mesh, tissue.lame_kpa, tissue.shear_kpa)[rows][:, rows].tocsr()
    solver = linear_solver(matrix, mesh.points[free], limit=limit)
    chosen = np.random.default_rng(2).permutation(len(rows))[:200]
    expected = np.linalg.inv(matrix.toarray())[np.ix_(chosen, chosen)]
    scale = np.abs(expected).max()
    assert_allclose(inverse_at(solver, chosen, len(rows), np.float64), expected, atol=tolerance * scale)
    single = inverse_at(solver, chosen, len(rows), np.float32)
    assert single.dtype == np.float32
    assert_allclose(single, expected, atol=2e-6 * scale)


def test_contact_in_single_precision_moves_nodes_by_less_than_a_micron(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = ellipsoid(16.0)
    held = np.flatnonzero(np.linalg.norm(mesh.points - [-30, 0, 0], axis=1) < 16)
    body = solid(mesh, Tissue(), held)
    nodes = np.setdiff1d(mesh.boundary.nodes, held)
    level, rest = level_set(mesh.boundary, 6.0, 10.0), mesh.points[nodes]
    still = np.zeros(len(nodes), bool)
    wall = ChestWall(level, rest, still, np.array([0, 0, 1.0]), np.minimum(level.evaluate(rest)[0], 0))
    free = body.solve(body_load(mesh, np.array([0.6, 0, -0.8]) * 200 * GRAVITY_KPA_PER_MM))[nodes]
    states = []
    for double in (10**6, 0):
        monkeypatch.setattr(poro.contact.compliance, "DOUBLE_UNKNOWNS", double)
        compliance = compliance_of(body, nodes)
        states.append(solve_contact(compliance, wall, free, 0.0, tolerance_mm=1e-6))
        assert compliance.matrix.dtype == (np.float64 if double else np.float32)
    exact, single = states
    assert exact.active.sum() > 20
    assert (exact.active == single.active).all()
    assert 0 < np.abs(exact.u - single.u).max() < 1e-3
    for state in states:
        assert state.status is ContactStatus.CONVERGED
        assert_allclose(state.gap[state.active], 0, atol=1e-9)


def test_means_over_groups_lose_nothing_to_single_precision(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounding in them would load the geometric stiffness of a solution at rest."""
    monkeypatch.setattr(poro.contact.compliance, "GROUPS", 4)
    rng = np.random.default_rng(0)
    matrix = rng.uniform(0.5, 1.5, (600, 600)).astype(np.float32)
    matrix = np.tril(matrix) + np.tril(matrix, -1).T
    monkeypatch.setattr(Compliance, "matrix", matrix)
    solver = linear_solver(identity(600, format="csr"), rng.normal(size=(200, 3)))
    groups = Compliance(solver, np.zeros((200, 3)), 600).groups(rng.normal(size=(200, 3)))
    assert_allclose(1 / groups.share, 50)
    columns = matrix.astype(float).reshape(200, 3, 200, 3)
    exact = np.stack([columns[:, :, groups.label == g].mean(axis=2) for g in range(4)], axis=2)
    assert groups.motion.dtype == np.float32
    assert_allclose(groups.motion, exact, rtol=7e-8)
    mean = np.stack([exact[groups.label == g].mean(axis=0) for g in range(4)])
    assert_allclose(groups.mean, mean, rtol=7e-8)
