"""The correction finds what a model left, ignores outliers, and leaves sliding along the wall free."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
from shapes import box, ellipsoid

from poro.fem import Tissue
from poro.fit import FitSettings, Target, constraints_to, elastic_correction
from poro.fit.elastic_correction import PointConstraints, elastic_pull
from poro.mesh import interpolate, locate

TISSUE = Tissue()
GRADIENT = np.array([[-0.1, 0.02, 0.0], [0.03, -0.05, 0.04], [0.0, -0.02, 0.08]])


def test_correction_recovers_a_smooth_residual_and_ignores_outliers() -> None:
    mesh = ellipsoid(10.0)
    rng = np.random.default_rng(4)
    u = mesh.points @ GRADIENT.T

    def hidden(x: np.ndarray) -> np.ndarray:
        return 3 * np.stack([np.sin(x[:, 1] / 40), np.cos(x[:, 2] / 50), x[:, 0] / 40], 1)

    inside = rng.uniform(-25, 25, (120, 3))
    wanted = hidden(inside)
    wanted[:10] += rng.normal(size=(10, 3)) * 30
    constraints = PointConstraints(inside, wanted, np.full(120, 0.5), np.zeros((120, 3)))
    found = elastic_correction(mesh, u, TISSUE, constraints)
    fresh = rng.uniform(-25, 25, (200, 3))
    left = interpolate(locate(mesh, fresh), found.u) - hidden(fresh)
    assert np.linalg.norm(left, axis=1).mean() < 0.25 * np.linalg.norm(hidden(fresh), axis=1).mean()
    assert (found.influence[:10] < 0.2).all()
    assert (found.influence[10:] > 0.5).mean() > 0.9
    assert found.det_f.min() > 0.5


def test_normal_constraints_leave_sliding_free() -> None:
    mesh = ellipsoid(12.0)
    s = mesh.boundary
    constraints = PointConstraints(
        s.points, np.broadcast_to([0.0, 4.0, 0.0], s.points.shape).copy(), np.full(len(s.points), 1.0), s.node_normals
    )
    found = elastic_correction(mesh, np.zeros_like(mesh.points), TISSUE, constraints, robust=np.inf, rounds=1)
    assert_allclose(found.u.mean(axis=0), [0, 4, 0], atol=0.2)
    along = np.einsum("nd,nd->n", found.u[s.nodes] - [0, 4, 0], s.node_normals)
    assert np.abs(along).max() < 0.4


def test_a_moved_target_draws_the_lung_onto_itself() -> None:
    mesh = ellipsoid(10.0)
    s = mesh.boundary
    u = mesh.points @ GRADIENT.T
    shift = np.array([1.5, -1.0, 2.0])
    x = np.random.default_rng(8).uniform(-22, 22, (30, 3))
    moved = s.moved(s.points + u[s.nodes] + shift)
    target = Target(
        moved.points, moved.node_normals, np.ones(len(s.points)), x, x + x @ GRADIENT.T + shift, np.ones(30)
    )
    constraints = constraints_to(target, mesh, u, FitSettings())
    assert_allclose(constraints.offset[-30:], np.broadcast_to(shift, (30, 3)), atol=1e-9)
    found = elastic_correction(mesh, u, TISSUE, constraints)
    left = np.linalg.norm(found.u - shift, axis=1)
    assert left.mean() < 0.25
    assert left.max() < 0.8


def test_standard_deviations_are_those_of_the_fit_but_for_the_share_of_a_keypoints() -> None:
    mesh = ellipsoid(16.0)
    s = mesh.boundary
    x = np.array([[0.0, 0, 0], [10, 5, 0]])
    target = Target(s.points, s.node_normals, np.ones(len(s.points)), x, x + 1.0, np.array([1.0, 0.25]))
    still = np.zeros_like(mesh.points)
    plain, other = (
        constraints_to(target, mesh, still, FitSettings(surface_sigma_mm=surface, keypoint_sigma_mm=inner))
        for surface, inner in ((2.0, 2.0), (3.0, 5.0))
    )
    assert_allclose(plain.sigma_mm[-2:], [1.5, 3.0])
    assert_allclose(other.sigma_mm[-2:], [3.75, 7.5])
    assert_allclose(other.sigma_mm[:-2], 1.5 * plain.sigma_mm[:-2])


def test_which_surface_points_count_is_not_left_to_rounding() -> None:
    """Points over the edges of a box, whose faces they face at 45 degrees or less: either face lies nearest."""
    mesh = box((4, 4, 4), (40.0, 40.0, 40.0))
    rng = np.random.default_rng(0)
    along = rng.uniform(5, 35, 60)
    points = np.stack([np.full(60, 43.0), np.full(60, 43.0), along], axis=1)
    normals = np.array([np.cos(a) * np.eye(3)[0] + np.sin(a) * np.eye(3)[1] for a in rng.uniform(-0.1, 0.1, 60)])
    target = Target(points, normals, np.ones(60))
    chosen = set()
    for _ in range(5):
        u = 1e-9 * rng.normal(size=mesh.points.shape)
        chosen.add(len(constraints_to(target, mesh, u, FitSettings()).points))
    assert chosen == {60}


def test_a_pull_follows_other_offsets_at_the_same_points_as_the_first_round_of_a_correction_does() -> None:
    mesh, rng = ellipsoid(10.0), np.random.default_rng(6)
    s = mesh.boundary
    points = np.concatenate([rng.uniform(-25, 25, (40, 3)), s.points[:30]])
    normals = np.concatenate([np.zeros((40, 3)), s.node_normals[:30]])
    sigma = rng.uniform(0.5, 3.0, 70)
    first, second = (rng.normal(0, 2, (70, 3)) for _ in range(2))
    pull = elastic_pull(mesh, TISSUE, PointConstraints(points, first, sigma, normals), 0.02)
    for offset in (first, second):
        alone = PointConstraints(points, offset, sigma, normals)
        exact = elastic_correction(mesh, np.zeros_like(mesh.points), TISSUE, alone, 0.02, rounds=1).u
        assert np.abs(exact).max() > 0.5
        assert_allclose(pull(offset), exact, rtol=0, atol=1e-9)
    assert_allclose(pull.operator @ mesh.points, interpolate(locate(mesh, points), mesh.points), atol=1e-9)
