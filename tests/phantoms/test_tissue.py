"""Equilibrium of finite-strain tissue: known shapes, signs of loads, and energy against its own gradient."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from phantoms.descent import Status
from phantoms.fields import Lattice, as_distance, lattice_over
from phantoms.lobes import Fissures, Lobes, Sheet, surface_points, whole
from phantoms.tissue import Pleura, Scene, Tie, Tissue, _Problem, relax, tissue_points

RADIUS = 40.0
DOWN = np.array([0, 0, -1.0])


@pytest.fixture(scope="module")
def ball() -> Lattice:
    lattice = lattice_over(np.full(3, -66.0), np.full(3, 66.0), 3.0)
    x, y, z = lattice.axes
    return as_distance(lattice, np.sqrt(x**2 + y**2 + z**2) - RADIUS)


def _parts(ball: Lattice, rest: float, density: float, held: bool) -> tuple[Tissue, Pleura, list[Tie]]:
    points, volume = tissue_points(ball, 8.0)
    surface, area = surface_points(ball, 2)
    n = len(points)
    tied = points[np.linalg.norm(points, axis=1) < 12]
    tissue = Tissue(points, volume, np.full(n, 0.5), np.full(n, rest), density, np.zeros(n, dtype=int))
    one = np.zeros(len(surface), dtype=int), np.zeros(len(tied), dtype=int)
    return tissue, Pleura(surface, area, ball, held, one[0]), [Tie(tied, tied, 1.0, one[1])]


def _one(ball: Lattice) -> Lobes:
    return whole(ball, Fissures(Sheet(np.zeros(3), 0.0, 0.0, 0.0), None, np.inf))


def _same(points: np.ndarray) -> np.ndarray:
    return points


def test_points_and_surface_measure_a_ball(ball: Lattice) -> None:
    assert tissue_points(ball, 8.0)[1].sum() == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)
    assert surface_points(ball, 2)[1].sum() == pytest.approx(4 * np.pi * RADIUS**2, rel=0.02)


def test_free_weightless_lung_takes_its_rest_shape(ball: Lattice) -> None:
    tissue, pleura, ties = _parts(ball, 0.8, 0.0, held=False)
    end = relax(Scene(tissue, pleura, ties, _one(ball), DOWN), _same, None, 16.0)
    assert end.status is Status.CONVERGED
    inner = tissue.points[np.linalg.norm(tissue.points, axis=1) < 30]
    assert_allclose(end.state_from_ct.determinant(inner), 0.8**3, rtol=0.03)
    assert_allclose(end.state_from_ct(inner), 0.8 * inner, atol=0.4)


def test_held_lung_keeps_to_the_wall_although_it_pulls(ball: Lattice) -> None:
    tissue, pleura, ties = _parts(ball, 0.8, 0.0, held=True)
    end = relax(Scene(tissue, pleura, ties, _one(ball), DOWN), _same, None, 16.0)
    gap = ball.at(end.state_from_ct(pleura.points))
    assert_allclose(gap, 0, atol=0.5)
    # Tension pulls the pleura inwards: a negative distance.
    assert gap.mean() < 0


def test_weight_pulls_a_collapsed_lung_down_onto_the_wall(ball: Lattice) -> None:
    tissue, pleura, ties = _parts(ball, 0.8, 600.0, held=False)
    ties = [replace(ties[0], stiffness=1e-3)]
    end = relax(Scene(tissue, pleura, ties, _one(ball), DOWN), _same, None, 16.0)
    moved = end.state_from_ct(tissue.points)
    fall = (moved[:, 2] * tissue.volume).sum() / tissue.volume.sum()
    assert -20 < fall < -2
    gap = ball.at(end.state_from_ct(pleura.points))
    assert gap.max() < 1.0
    assert gap.min() < -10


def test_rest_shape_is_scaled_to_the_volume_asked_for(ball: Lattice) -> None:
    tissue, pleura, ties = _parts(ball, 0.9, 200.0, held=False)
    end = relax(Scene(tissue, pleura, ties, _one(ball), np.array([0, -1.0, 0])), _same, 0.5, 16.0)
    ratio = end.state_from_ct.determinant(tissue.points) @ tissue.volume / tissue.volume.sum()
    assert ratio == pytest.approx(0.5, rel=0.01)


def test_energy_falls_along_its_gradient_at_the_rate_it_says(ball: Lattice) -> None:
    tissue, pleura, ties = _parts(ball, 0.8, 300.0, held=True)
    scene = Scene(tissue, pleura, ties, _one(ball), np.array([0.6, 0, -0.8]))
    problem = _Problem(scene, np.full(3, -80.0), 20.0, (9, 9, 9))
    rng = np.random.default_rng(1)
    u = rng.normal(0, 0.8, (len(problem.active), 3))
    way = rng.standard_normal(u.shape)
    # The wall's distance is piecewise trilinear: a small step stays within its pieces for nearly all points.
    up, down = (problem.energy(u + t * way)[0] for t in (1e-5, -1e-5))
    assert (up - down) / 2e-5 == pytest.approx(float((problem.energy(u)[1] * way).sum()), rel=1e-4)


def test_tissue_turned_inside_out_has_no_finite_energy(ball: Lattice) -> None:
    tissue, pleura, ties = _parts(ball, 0.8, 0.0, held=True)
    problem = _Problem(Scene(tissue, pleura, ties, _one(ball), DOWN), np.full(3, -80.0), 20.0, (9, 9, 9))
    u = problem.fit(lambda p: p * [-1, 1, 1])
    assert problem.energy(u)[0] == np.inf
