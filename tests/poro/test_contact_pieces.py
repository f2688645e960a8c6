"""Contact between two bodies: patch test across meshes that do not match, Hertz, balance, a wall in the same set."""

from __future__ import annotations

import numpy as np
import pytest
from blocks import Pair, Spheres, stacked
from numpy.testing import assert_allclose, assert_array_equal
from scipy.sparse import identity
from shapes import box, compliance_of, order
from test_contact import _floor

from poro.arrays import Array
from poro.contact import ContactStatus, Facing, contact_sensitivity
from poro.contact.mortar import Reach, mortar
from poro.fem import Tissue, solid
from poro.fem.forms import body_load, deformation_gradient
from poro.fem.tissue import GRAVITY_KPA_PER_MM
from poro.mesh import TetMesh

HEIGHTS, WIDTH = (30.0, 20.0), 40.0
CELLS = ((4, 4, 3), (5, 3, 2))
TURNED = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
TURNED = TURNED * np.sign(np.linalg.det(TURNED))
SPHERES = Spheres(Tissue(), (600.0, 1200.0), 8.0)


def _square(corner: tuple[float, float], side: float, height: float, up: bool) -> tuple[Array, Array]:
    """Two triangles of a square, facing up or down."""
    x, y = corner
    points = np.array([[x, y, height], [x + side, y, height], [x + side, y + side, height], [x, y + side, height]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    return points, triangles if up else triangles[:, ::-1]


@pytest.mark.parametrize("shift", [(0.0, 0.0), (3.0, 1.0), (-4.0, 5.5), (20.0, 0.0)])
def test_the_common_part_of_two_squares_is_measured_exactly(shift: tuple[float, float]) -> None:
    low, first = _square((0, 0), 10.0, 0.0, up=True)
    high, second = _square(shift, 8.0, 2.0, up=False)
    points = np.concatenate([low, high])
    found = mortar(points, first, second + 4, Reach(5.0, 5.0))
    sides = [max(0.0, min(10.0, s + 8.0) - max(0.0, s)) for s in shift]
    assert found.own.sum() == pytest.approx(sides[0] * sides[1])
    assert_allclose(np.asarray(found.other.sum(axis=1)).ravel(), found.own, atol=1e-12)
    assert found.other[4:].nnz == 0


def test_a_node_faces_itself_where_meshes_match_and_a_plane_as_it_lies_where_they_do_not() -> None:
    """Dual weights reproduce linear functions where a triangle is covered whole."""
    pair = stacked(CELLS, WIDTH, HEIGHTS, np.eye(3))
    points = pair.mesh.points[pair.nodes]
    found = mortar(points, pair.below, pair.above, Reach(5.0, 5.0))
    mine = np.unique(pair.below)
    assert_allclose((found.other @ points)[mine] / found.own[mine, None], points[mine], atol=1e-10)
    same = stacked((CELLS[0], CELLS[0]), WIDTH, HEIGHTS, np.eye(3))
    points = same.mesh.points[same.nodes]
    found = mortar(points, same.below, same.above, Reach(5.0, 5.0))
    weights = found.other[np.unique(same.below)].toarray() / found.own[np.unique(same.below), None]
    assert_allclose(weights[:, np.unique(same.above)], np.eye(len(weights)), atol=1e-12)


@pytest.mark.parametrize("apart", [-3.0, 0.0, 3.0])
def test_gap_is_the_distance_of_two_planes_and_its_derivative_is_exact(apart: float) -> None:
    pair = stacked(CELLS, WIDTH, HEIGHTS, TURNED)
    facing, above = pair.facing(), ~pair.lower[pair.nodes]
    u = apart * above[:, None] * TURNED[:, 2]
    gaps = facing.gaps(u)
    assert gaps.meets.all()
    assert_allclose(gaps.gap, apart, atol=1e-10)
    assert gaps.area.sum() == pytest.approx(WIDTH**2)
    assert gaps.overlap_mm3 == pytest.approx(max(-apart, 0) * WIDTH**2, abs=1e-6)
    rng = np.random.default_rng(4)
    step = 1e-4 * rng.normal(size=(len(u), 1)) * TURNED[:, 2]
    flat = 1e-4 * above[:, None] * TURNED[:, 2]
    assert_allclose(facing.gaps(u + flat).gap - gaps.gap, gaps.matrix @ flat.ravel(), atol=1e-12)
    assert_allclose(facing.gaps(u + step).gap - gaps.gap, gaps.matrix @ step.ravel(), atol=2e-7)


def test_surfaces_too_far_too_deep_or_turned_away_do_not_face_each_other() -> None:
    pair = stacked(CELLS, WIDTH, HEIGHTS, np.eye(3))
    facing, above = pair.facing(), ~pair.lower[pair.nodes]
    for height in (facing.reach.apart + 0.1, -facing.reach.deep - 0.1):
        assert not facing.gaps(height * above[:, None] * np.eye(3)[2]).meets.any()
    turned = Facing.of(facing.rest, facing.first, facing.second[:, ::-1])
    assert not turned.gaps(np.zeros_like(facing.rest)).meets.any()
    assert (turned.gaps(np.zeros_like(facing.rest)).gap > 100).all()


def test_where_pieces_share_nodes_no_gap_is_asked_for() -> None:
    pair = stacked(CELLS, WIDTH, HEIGHTS, np.eye(3))
    one = pair.below[0, 0]
    grown = Facing.of(
        pair.mesh.points[pair.nodes], pair.below, np.concatenate([pair.above, [[one, *pair.above[0, :2]]]])
    )
    assert one not in grown.nodes
    assert len(grown.nodes) == len(np.unique(pair.below)) - 1


def test_among_some_nodes_the_triangles_stay_that_have_all_their_corners_there() -> None:
    pair = stacked(CELLS, WIDTH, HEIGHTS, np.eye(3))
    whole = pair.facing()
    nodes = np.flatnonzero(whole.rest[:, 0] < 0.6 * WIDTH)
    part = whole.among(nodes)
    assert_allclose(part.rest, whole.rest[nodes])
    for kept, all_of_them in ((part.first, whole.first), (part.second, whole.second)):
        inside = np.isin(all_of_them, nodes).all(axis=1)
        assert 0 < inside.sum() < len(all_of_them)
        assert_array_equal(nodes[kept], all_of_them[inside])
    assert_array_equal(nodes[part.nodes], np.intersect1d(whole.nodes, nodes[part.first]))


@pytest.mark.parametrize("swapped", [False, True])
@pytest.mark.parametrize("turn", [np.eye(3), TURNED])
def test_stress_is_constant_across_meshes_that_do_not_match(turn: Array, swapped: bool) -> None:
    """Patch test, nu = 0: pressure E d / H at every node and one strain in every element, to rounding."""
    tissue, push = Tissue(poisson=0.0), 3.0
    pair = stacked(CELLS, WIDTH, HEIGHTS, turn)
    height = pair.mesh.points @ turn[:, 2]
    top, bottom = np.isclose(height, sum(HEIGHTS)), np.isclose(height, 0)
    held = np.flatnonzero(top | bottom)
    body = solid(pair.mesh, tissue, held)
    free = body.solve(np.zeros_like(pair.mesh.points), -push * top[held, None] * turn[:, 2])
    state, u = pair.solve(body, free, swapped)
    assert state.status is ContactStatus.CONVERGED
    assert state.between is not None
    strain = push / sum(HEIGHTS)
    assert_allclose(state.force[len(pair.nodes) :] / state.between.area, tissue.young_kpa * strain, rtol=1e-10)
    expected = np.eye(3) - strain * np.outer(turn[:, 2], turn[:, 2])
    assert_allclose(
        deformation_gradient(pair.mesh, u), np.broadcast_to(expected, (len(pair.mesh.tets), 3, 3)), atol=1e-12
    )
    assert_allclose(state.between.gap, 0, atol=1e-11)


def test_bodies_that_part_do_not_pull_at_each_other() -> None:
    pair = stacked(CELLS, WIDTH, HEIGHTS, TURNED)
    height = pair.mesh.points @ TURNED[:, 2]
    top, bottom = np.isclose(height, sum(HEIGHTS)), np.isclose(height, 0)
    held = np.flatnonzero(top | bottom)
    body = solid(pair.mesh, Tissue(), held)
    free = body.solve(np.zeros_like(pair.mesh.points), 2.0 * top[held, None] * TURNED[:, 2])
    state, u = pair.solve(body, free)
    assert not state.force.any()
    assert_allclose(u, free)


def test_forces_of_the_bodies_on_each_other_balance_and_only_press() -> None:
    """Action and reaction on curved surfaces: no force in sum, and no moment but that of the last gap's error."""
    pair, state, _ = SPHERES.pressed((8, 7), (2.0, 2.5))
    force, points = state.nodal_force, pair.mesh.points[pair.nodes] + state.u
    below = pair.lower[pair.nodes]
    one, other = force[below].sum(axis=0), force[~below].sum(axis=0)
    assert np.linalg.norm(one) > 0.9 * SPHERES.force
    assert_allclose(one, -other, atol=1e-12 * SPHERES.force)
    moment = np.cross(points, force).sum(axis=0)
    assert np.linalg.norm(moment) < 1e-3 * SPHERES.force * SPHERES.contact
    assert state.between is not None
    pressing = state.force[len(pair.nodes) :]
    assert (pressing >= 0).all()
    assert state.between.gap.min() > -1e-5 * SPHERES.approach
    assert_allclose(state.between.gap[pressing > 0], 0, atol=1e-5 * SPHERES.approach)


@pytest.fixture(scope="module")
def presses() -> list[tuple[float, float, float, float]]:
    """(finest edge, errors of force, peak pressure and contact radius, relative) on three pairs of meshes."""
    found = []
    for cells, per_radius in ((8, 4), (11, 6), (13, 8)):
        finest = SPHERES.contact / per_radius
        pair, state, _ = SPHERES.pressed((cells, cells - 1), (finest, 1.25 * finest))
        assert state.status is ContactStatus.CONVERGED
        assert state.between is not None
        force, area = state.force[len(pair.nodes) :], state.between.area
        pressure = force / np.where(area > 0, area, 1)
        radius = np.sqrt(area[force > 0].sum() / np.pi)
        found.append(
            (
                finest,
                abs(force.sum() / SPHERES.force - 1),
                abs(pressure.max() / SPHERES.peak - 1),
                abs(radius / SPHERES.contact - 1),
            )
        )
    return found


def test_two_spheres_press_as_hertz_says(presses: list[tuple[float, float, float, float]]) -> None:
    """Force at a given approach and peak pressure to first order; the radius to a third of an element."""
    steps, force, peak, radius = (list(column) for column in zip(*presses, strict=True))
    assert order(steps, force).min() > 1.0
    assert order(steps, peak).min() > 1.0
    assert force[-1] < 0.035
    assert peak[-1] < 0.03
    assert (np.array(radius) * SPHERES.contact < np.array(steps) / 3).all()


def test_weight_passes_from_a_block_through_another_one_to_the_floor() -> None:
    """Wall and pieces in one active set: the floor carries both blocks, the lower block carries the upper one."""
    tissue, density = Tissue(poisson=0.0), 30.0
    lower, upper = box((3, 3, 3), (30.0, 30.0, 30.0)), box((4, 4, 2), (30.0, 30.0, 20.0))
    height = np.concatenate([lower.points[:, 2], upper.points[:, 2] + 30.0])
    pair = Pair.of(lower, TetMesh(upper.points + 30.0 * np.eye(3)[2], upper.tets), (height == 0) | (height == 30))
    count, size = len(pair.nodes), pair.mesh.points.size
    weight = density * GRAVITY_KPA_PER_MM * 30.0**2 * np.array([30.0, 20.0])
    spring = weight.sum() / len(height) / 5.0  # at every node, by which the blocks alone would sink by some 5 mm
    body = solid(pair.mesh, tissue, np.zeros(0, int), spring * identity(size, format="csr"))
    free = body.solve(body_load(pair.mesh, np.array([0, 0, -density * GRAVITY_KPA_PER_MM])))
    assert free[:, 2].max() < -2
    state, u = pair.solve(body, free, level=_floor(0.0))
    assert state.status is ContactStatus.CONVERGED
    sprung = [-spring * u[side, 2].sum() for side in (pair.lower, ~pair.lower)]
    lifted = [state.nodal_force[pair.lower[pair.nodes] == side, 2].sum() for side in (True, False)]
    assert lifted[1] == pytest.approx(weight[1] - sprung[1], rel=1e-9)
    assert sum(lifted) == pytest.approx(weight.sum() - sum(sprung), rel=1e-9)
    assert state.force[:count].sum() == pytest.approx(sum(lifted), rel=1e-9)
    assert sum(sprung) < 0.2 * weight.sum()
    assert u[height == 0, 2].min() > -1e-5  # what the last change of the normals between the blocks is worth
    assert state.between is not None
    assert_allclose(state.between.gap[state.between.meets], 0, atol=1e-6)


def test_derivatives_are_refused_for_two_pieces() -> None:
    pair, state, _ = SPHERES.pressed((5, 4), (3.2, 4.0))
    free = np.zeros((len(pair.nodes), 3, 1))
    body = solid(pair.mesh, SPHERES.tissue, np.flatnonzero(np.abs(pair.mesh.points[:, 2]) > 20))
    with pytest.raises(ValueError, match="one piece"):
        contact_sensitivity(compliance_of(body, pair.nodes), pair.wall(), state, free, np.zeros(1))
