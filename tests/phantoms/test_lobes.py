"""Two halves of a ball: they slide without friction, do not pass through each other, and hold where they have grown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from phantoms.descent import Status
from phantoms.fields import Lattice, as_distance, lattice_over
from phantoms.fissure_contact import contact_energy, make_joint
from phantoms.lobes import Fissures, LobedMap, Lobes, Sheet, cut, surface_points
from phantoms.spline import SplineMap
from phantoms.tissue import Equilibrium, Pleura, Scene, Tie, Tissue, _Problem, relax, tissue_points

RADIUS = 40.0
PLANE = Sheet(np.zeros(3), 0.0, 0.0, 0.0)
DOWN = np.array([0, 0, -1.0])


@pytest.fixture(scope="module")
def ball() -> Lattice:
    lattice = lattice_over(np.full(3, -68.0), np.full(3, 68.0), 2.0)
    x, y, z = lattice.axes
    return as_distance(lattice, np.sqrt(x**2 + y**2 + z**2) - RADIUS)


@pytest.fixture(scope="module")
def halves(ball: Lattice) -> Lobes:
    return cut(ball, Fissures(PLANE, None))


def _parts(lobes: Lobes, wall: Lattice, moved: np.ndarray, held: bool = False) -> tuple[Tissue, Pleura, list[Tie]]:
    """Halves at rest in `wall`, the upper one pulled by `moved` mm at all of its tissue beyond 20 mm of the fissure."""
    filled = [tissue_points(region, 8.0) for region in lobes.regions]
    lobe = np.repeat([0, 1], [len(p) for p, _ in filled])
    points, volume = (np.concatenate(column) for column in zip(*filled, strict=True))
    n = len(points)
    tissue = Tissue(points, volume, np.full(n, 0.5), np.ones(n), 0.0, lobe)
    skin = [surface_points(region, 2) for region in lobes.regions]
    pleura = Pleura(
        np.concatenate([p for p, _ in skin]),
        np.concatenate([a for _, a in skin]),
        wall,
        held,
        np.repeat([0, 1], [len(p) for p, _ in skin]),
    )
    tied = np.abs(points[:, 2]) > 20
    target = points[tied] + moved * (lobe[tied] == 0)[:, None]
    return tissue, pleura, [Tie(points[tied], target, 300.0, lobe[tied])]


def _moved(lobes: Lobes, ball: Lattice, moved: list[float]) -> Equilibrium:
    room = ball.like(ball.values - 25)
    parts = _parts(lobes, room, np.array(moved))
    return relax(Scene(*parts, lobes, DOWN), lambda p: p, None, 16.0, limit=1e-4)


def test_halves_share_the_ball_and_face_each_other_over_its_disc(ball: Lattice, halves: Lobes) -> None:
    volumes = [tissue_points(region, 4.0)[1].sum() for region in halves.regions]
    assert_allclose(volumes, 2 / 3 * np.pi * RADIUS**3, rtol=0.02)
    points, area, own, other = halves.facing()
    assert np.abs(points[:, 2]).max() < 2.5
    assert set(zip(own.tolist(), other.tolist(), strict=True)) == {(0, 1), (1, 0)}
    assert area[own == 0].sum() == pytest.approx(np.pi * RADIUS**2, rel=0.12)
    assert_allclose(halves.at(np.array([[0, 0, 9.0], [0, 0, -9]])), [0, 1])


def test_right_lung_has_a_middle_lobe_and_its_fused_share_is_around_the_hilum(ball: Lattice) -> None:
    sheets = Fissures(replace(PLANE, slope=1.0), replace(PLANE, offset=-2.0))
    lobes = cut(ball, sheets, 0.4)
    assert lobes.names == ("upper", "middle", "lower")
    assert_allclose(lobes.at(np.array([[0, 5, 20.0], [0, 25, -10], [0, -10, -20]])), [0, 1, 2])
    points, area, _, _ = lobes.facing()
    assert area[lobes.fissures.grown(points)].sum() == pytest.approx(0.4 * area.sum(), rel=0.02)
    assert_allclose(sheets.distance(np.array([[0, 30, 4.0], [0, 0, -5]])), [2.0, 5 / np.sqrt(2)])


def test_one_half_slides_along_the_other_without_pulling_it(ball: Lattice, halves: Lobes) -> None:
    end = _moved(halves, ball, [12.0, 0, 0])
    assert end.status is Status.CONVERGED
    x = np.array([[0.0, 0, 4], [-15, 5, 3], [10, -10, 6], [0, 0, -4], [-10, 5, -3], [15, 5, -6]])
    jump = np.array([[12.0, 0, 0]] * 3 + [[0.0, 0, 0]] * 3)
    assert_allclose(end.state_from_ct(x) - x, jump, atol=0.25)
    assert_allclose(end.state_from_ct.determinant(x), 1, atol=0.03)


def test_halves_that_have_grown_together_shear_instead(ball: Lattice, halves: Lobes) -> None:
    grown = replace(halves, fissures=replace(halves.fissures, grown_mm=100.0))
    pieces = _moved(grown, ball, [12.0, 0, 0]).state_from_ct.pieces
    x = np.array([[0.0, 0, 0], [-20, 5, 0], [10, -20, 0]])
    above, below = (piece(x) - x for piece in pieces)
    assert_allclose(above[:, 0], below[:, 0], atol=0.8)
    assert_allclose(0.5 * (above + below)[:, 0], 6, atol=0.8)


def test_pressed_halves_yield_but_do_not_pass_through_each_other(ball: Lattice, halves: Lobes) -> None:
    pieces = _moved(halves, ball, [0, 0, -5.0]).state_from_ct.pieces
    x = np.array([[0.0, 0, 0], [-20, 5, 0], [10, -20, 0]])
    above, below = (piece(x)[:, 2] for piece in pieces)
    assert_allclose(above, -2.5, atol=0.5)
    overlap = below - above
    assert overlap.min() > 0
    assert overlap.max() < 0.5


def test_parted_halves_leave_a_gap(ball: Lattice, halves: Lobes) -> None:
    pieces = _moved(halves, ball, [0, 0, 7.0]).state_from_ct.pieces
    x = np.array([[0.0, 0, 0], [-20, 5, 0]])
    assert_allclose(pieces[0](x) - pieces[1](x), [[0, 0, 7.0]] * 2, atol=0.1)


def test_pushes_between_lobes_cancel(halves: Lobes) -> None:
    rng = np.random.default_rng(2)
    maps = [SplineMap(rng.normal(0, 0.6, (10, 10, 10, 3)), np.full(3, -72.0), 16.0) for _ in halves.regions]
    energy, gradients, depths = contact_energy(make_joint(halves, held=False).sides, maps, halves.regions)
    assert energy > 0
    assert min(d.min() for _, d in depths) < -0.3
    scale = max(float(np.abs(g).sum()) for g in gradients)
    assert_allclose(sum(g.sum(axis=(0, 1, 2)) for g in gradients), 0, atol=1e-10 * scale)


@pytest.mark.parametrize("held", [True, False])
def test_energy_of_lobes_falls_along_its_gradient_at_the_rate_it_says(ball: Lattice, halves: Lobes, held: bool) -> None:
    some = replace(halves, fissures=replace(halves.fissures, grown_mm=15.0))
    tissue, pleura, ties = _parts(some, ball, np.array([3.0, 0, 0]), held)
    problem = _Problem(Scene(tissue, pleura, ties, some, DOWN), np.full(3, -80.0), 20.0, (9, 9, 9))
    rng = np.random.default_rng(1)
    u = rng.normal(0, 0.5, (len(problem.active), 3))
    way = rng.standard_normal(u.shape)
    up, down = (problem.energy(u + t * way)[0] for t in (1e-5, -1e-5))
    assert (up - down) / 2e-5 == pytest.approx(float((problem.energy(u)[1] * way).sum()), rel=2e-4)


def test_map_and_inverse_agree_on_either_side_of_the_jump(halves: Lobes) -> None:
    rng = np.random.default_rng(3)
    c = rng.normal(0, 0.5, (2, 10, 10, 10, 3))
    c[0] += [9.0, 0, 2]
    pieces = tuple(SplineMap(part, np.full(3, -72.0), 16.0) for part in c)
    jumping = LobedMap(pieces, halves)
    samples = np.concatenate([tissue_points(region, 7.0)[0] for region in halves.regions])
    points = samples[np.abs(samples[:, 2]) > 0.5]
    back, left = jumping.inverse(jumping(points), samples)
    assert_allclose(back, points, atol=1e-3)
    assert left.max() < 1e-3
    step = jumping(np.array([[0.0, 0, 1], [0, 0, -1]]))
    assert step[0, 0] - step[1, 0] > 7
