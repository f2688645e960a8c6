"""Quality of tetrahedra, the regional pressures and the body around the lung: by value and by sign."""

from __future__ import annotations

import numpy as np
import pytest
from breathing_shapes import HALF, pear
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from poro.arrays import Array
from poro.breathing import pressure_fit
from poro.breathing.body import Body, body, border_motion, network, spring_stiffness
from poro.breathing.elastic import WALL_ALONE, Lung
from poro.breathing.mesh_quality import _slopes, quality, smooth, violations
from poro.breathing.pressure_fit import balanced, fit_pressures
from poro.breathing.regional import QUARTERS, SECTORS, STOREYS, Thorax, _contact, _patches, _turned, press, thorax
from poro.mesh import TetMesh, stuff

REGULAR = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])


def test_a_regular_tetrahedron_has_quality_one_whatever_its_size() -> None:
    tets = np.array([[0, 1, 2, 3]])
    assert_allclose(np.abs(quality(7 * REGULAR, tets)), 1)
    flat = REGULAR * [1, 1, 0.1]
    assert abs(quality(flat, tets)[0]) < 0.6


def test_elements_are_counted_beyond_their_limits_and_not_at_them() -> None:
    """Edges of 5 to 10 mm are at the limit of a ratio of 2, of 4 to 10 beyond it; a regular element breaks none."""
    tets = np.array([[0, 1, 2, 3]])
    at = np.array([[0.0, 0, 0], [5, 0, 0], [6, 8, 0], [3, 4, 5]])
    assert violations(TetMesh(at, tets)).aspect == 0
    assert violations(TetMesh(at - [[0, 0, 0], [1, 0, 0], [0, 0, 0], [0, 0, 0]], tets)).aspect == 1
    upright = tets if quality(REGULAR, tets)[0] > 0 else tets[:, [1, 0, 2, 3]]
    regular = violations(TetMesh(REGULAR, upright))
    assert regular == pytest.approx((0, 0, 0, 0, 1))


def test_the_slope_of_the_quality_is_its_derivative() -> None:
    mesh = pear(25.0)
    rng = np.random.default_rng(0)
    direction = rng.normal(size=mesh.points.shape)
    h = 1e-5
    ahead, behind = (quality(mesh.points + t * direction, mesh.tets) for t in (h, -h))
    _, slope = _slopes(mesh.points, mesh.tets)
    assert_allclose((ahead - behind) / (2 * h), np.einsum("mki,mki->m", slope, direction[mesh.tets]), atol=1e-7)


def test_descent_lifts_the_worst_element_and_leaves_the_surface() -> None:
    mesh = pear(18.0)
    better = smooth(mesh)
    border = mesh.boundary.nodes
    assert violations(better).worst > violations(mesh).worst
    assert_allclose(better.points[border], mesh.points[border])
    assert better.volumes.sum() == pytest.approx(mesh.volumes.sum())


def test_a_node_next_to_its_best_place_is_not_moved_past_it() -> None:
    """Eight elements about the middle of an octahedron: every step that is tried goes too far."""
    corners = np.concatenate([np.eye(3), -np.eye(3)])
    faces = [(i, j, k) for i in (0, 3) for j in (1, 4) for k in (2, 5)]
    for off in ([0.004, 0, 0], [0.003, -0.003, 0.002]):
        points = np.concatenate([corners, [off]])
        tets = np.array([(6, *face) for face in faces])
        mesh = TetMesh(points, np.where((quality(points, tets) > 0)[:, None], tets, tets[:, [0, 2, 1, 3]]))
        assert violations(smooth(mesh)).worst >= violations(mesh).worst - 1e-12


def ball_mask(margin: int = 6) -> tuple[Array, Array]:
    step = 5.0
    n = np.ceil(HALF / step).astype(int) + margin
    x = step * np.stack(np.meshgrid(*(np.arange(-k, k + 1) for k in n), indexing="ij"), -1)
    affine = np.diag([step, step, step, 1.0])
    affine[:3, 3] = -step * n
    return (np.linalg.norm(x / HALF, axis=-1) < 1) & (x[..., 2] > -30), affine


@pytest.fixture(scope="module")
def chest() -> tuple[Thorax, Lung]:
    inside, affine = ball_mask()
    expired, stretch = pear(20.0), np.array([1.04, 1.06, 1.05])
    fixed = np.array([expired.points[:, 0].min(), expired.points[:, 1].min(), 0.0])  # inner side and back stay
    inspired = TetMesh(fixed + stretch * (expired.points - fixed), expired.tets)
    lung = Lung("right", inspired, expired)
    return thorax(inside, affine, lung, WALL_ALONE), lung


def test_chest_and_abdomen_reach_30_mm_about_the_lung_s_voxels(chest: tuple[Thorax, Lung]) -> None:
    scene, lung = chest
    inside, affine = ball_mask()
    voxels = np.argwhere(inside) * affine[0, 0] + affine[:3, 3]
    far = cKDTree(voxels).query(scene.mesh.points[len(lung.expired.points) :])[0]
    assert 29.0 < far.max() < 32.0  # 33.4 with the voxels that are 30 mm off
    assert far.min() > 0.5


def test_patches_of_the_chest_are_sectors_of_one_angle_in_storeys_of_one_height() -> None:
    lung = pear(12.0)
    walls = lung.boundary
    x, y, z = walls.points[walls.triangles].mean(axis=1).T
    centre = np.average(lung.points, axis=0, weights=lung.node_volumes)
    turn = (np.degrees(np.arctan2(y - centre[1], x - centre[0])) + 180) % 360
    patch = _patches(walls, np.zeros(len(walls.points), bool), lung)
    assert_array_equal(np.unique(patch), np.arange(SECTORS * STOREYS))
    assert_array_equal(patch % SECTORS, turn // (360 / SECTORS))
    lowest, highest = (np.array([f(z[patch // SECTORS == k]) for k in range(STOREYS)]) for f in (np.min, np.max))
    assert (lowest[1:] >= highest[:-1]).all()


def test_the_diaphragm_has_a_middle_and_four_quarters_about_it() -> None:
    lung = pear(12.0)
    walls = lung.boundary
    is_below = walls.points[:, 2] < -25
    patch = _patches(walls, is_below, lung)
    below = is_below[walls.triangles].sum(axis=1) >= 2
    assert patch.max() + 1 == SECTORS * STOREYS + QUARTERS + 1
    aside = (walls.points[walls.triangles].mean(axis=1))[below]
    x, y = (aside - aside.mean(axis=0))[:, :2].T
    of_diaphragm = patch[below] - SECTORS * STOREYS
    assert of_diaphragm.min() == 0
    inner = of_diaphragm == QUARTERS
    assert np.hypot(x, y)[inner].max() < np.hypot(x, y)[~inner].max()
    assert_allclose([x[inner].mean(), y[inner].mean()], 0, atol=6)
    for quarter in range(QUARTERS):
        here = of_diaphragm == quarter
        assert len(np.unique(np.sign(x[here]))) == len(np.unique(np.sign(y[here]))) == 1
    assert (patch[~below] < SECTORS * STOREYS).all()


def test_contact_finds_its_balance_round_by_round(chest: tuple[Thorax, Lung]) -> None:
    """Each round moves the bodies less than the one before; over flat triangles' normals they go on for ever."""
    scene, _ = chest
    u, moved = np.zeros_like(scene.mesh.points), []
    for _ in range(9):
        found = press(scene, np.full(scene.patches, 1.0), u, rounds=1)
        moved.append(found.moving_mm)
        u = found.u
    assert moved[0] > 1
    assert moved[-1] < 0.02 * moved[0]
    assert found.settled


def test_contact_changes_nothing_along_the_wall_once_it_is_in_balance(chest: tuple[Thorax, Lung]) -> None:
    scene, lung = chest
    still = np.zeros_like(scene.mesh.points)
    slid = still.copy()
    nodes, normal = lung.expired.boundary.nodes, lung.expired.boundary.node_normals
    slid[nodes] = 2.0 * np.cross(normal, [0.0, 0.0, 1.0])
    contact = _contact(scene, slid)
    force = contact.force - (contact.matrix @ slid.ravel()).reshape(-1, 3)
    along = np.linalg.norm(np.cross(force[nodes], scene.walls.node_normals), axis=1).mean()
    assert along < 0.2 * np.linalg.norm(force[nodes], axis=1).mean() + 1e-6


def test_a_fit_that_finds_no_balance_shortens_its_step(
    chest: tuple[Thorax, Lung], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, lung = chest
    steps: list[float] = []

    def never(scene: Thorax, p: Array, start: Array, share: float = 1.0) -> None:
        steps.append(float(np.abs(p).max()))

    monkeypatch.setattr(pressure_fit, "balanced", never)
    fit = fit_pressures(scene, lung.inspired.boundary)
    assert len(steps) == pressure_fit.REFUSALS
    assert steps[-1] < 0.5 * steps[0]
    assert_allclose(fit.state.p, 0)
    assert len(fit.history) == 1


def test_pressures_beyond_any_breath_find_no_balance(chest: tuple[Thorax, Lung]) -> None:
    scene, _ = chest
    still = np.zeros_like(scene.mesh.points)
    assert balanced(scene, np.full(scene.patches, 0.2), still) is not None
    assert balanced(scene, np.full(scene.patches, 60.0), still) is None


def test_pressures_pull_lung_and_wall_outward_and_their_derivative_is_what_they_do(chest: tuple[Thorax, Lung]) -> None:
    scene, lung = chest
    still = np.zeros_like(scene.mesh.points)
    rest = press(scene, np.zeros(scene.patches), still, rounds=1)
    p = np.full(scene.patches, 0.05)
    found = press(scene, p, still, rounds=1)
    assert_allclose(found.u - rest.u, rest.by_pressure @ p, atol=1e-9)
    border = lung.expired.boundary
    outward = np.einsum("nd,nd->n", found.u[border.nodes] - rest.u[border.nodes], border.node_normals)
    assert np.average(outward, weights=border.node_areas) > 0.05
    assert scene.patches >= 12


def test_bodies_that_turn_as_one_are_free_of_stress(chest: tuple[Thorax, Lung]) -> None:
    scene, _ = chest
    turn = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix()
    _, stress = _turned(scene, scene.mesh.points @ turn.T - scene.mesh.points)
    assert_allclose(stress, 0, atol=1e-12)


def test_stress_in_a_turned_frame_is_linear_in_the_stretch_and_the_moduli_are_its_derivative(
    chest: tuple[Thorax, Lung],
) -> None:
    scene, _ = chest
    x = scene.mesh.points
    turn = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix()
    strain = np.array([[0.1, 0.02, 0.0], [0.02, -0.05, 0.01], [0.0, 0.01, 0.03]])
    way = np.array([[0.3, -0.2, 0.5], [-0.2, 0.1, 0.4], [0.5, 0.4, -0.6]])
    moduli, stress = _turned(scene, x @ (turn @ (np.eye(3) + strain)).T - x)
    lame, shear = scene.moduli[0]
    assert_allclose(stress[0], turn @ (2 * shear * strain + lame * np.trace(strain) * np.eye(3)), atol=1e-12)
    step = 1e-6
    ahead = _turned(scene, x @ (turn @ (np.eye(3) + strain + step * way)).T - x)[1]
    assert_allclose((ahead - stress) / step, np.einsum("mijkl,kl->mij", moduli, turn @ way), atol=1e-6)


def test_walls_lie_on_the_lung_and_move_as_the_bodies_about_it(chest: tuple[Thorax, Lung]) -> None:
    scene, lung = chest
    assert_allclose(scene.walls.points, lung.expired.boundary.points)
    assert_allclose(scene.carried.sum(axis=1), 1.0)
    u = np.zeros_like(scene.mesh.points)
    u[len(lung.expired.points) :] = [1.0, -2.0, 3.0]
    assert_allclose(
        scene.moved_walls(u).points - scene.walls.points, np.tile([1.0, -2.0, 3.0], (len(u[scene.walls.nodes]), 1))
    )


def test_the_fit_brings_the_border_nearer_to_the_inspired_one(chest: tuple[Thorax, Lung]) -> None:
    scene, lung = chest
    fit = fit_pressures(scene, lung.inspired.boundary)
    assert fit.history[-1] < 0.75 * fit.history[0]
    assert fit.evaluations < 20


@pytest.fixture(scope="module")
def around() -> tuple[Body, TetMesh]:
    inside, affine = ball_mask(margin=14)
    shell = np.ones_like(inside)
    shell[:3], shell[-3:], shell[:, :3], shell[:, -3:], shell[:, :, :3], shell[:, :, -3:] = (False,) * 6
    mesh = stuff(shell & ~inside, affine, 26.0)
    still = mesh.points[:, 1] < np.quantile(mesh.points[:, 1], 0.1)
    lung = pear(20.0)
    return body(mesh, np.zeros(len(mesh.points)), still, [lung.boundary]), lung


def test_a_body_whose_lungs_rest_rests(around: tuple[Body, TetMesh]) -> None:
    scene, _ = around
    wanted = np.zeros((len(scene.near), 3))
    assert_allclose(scene.follow(wanted), 0, atol=1e-12)
    assert_allclose(network(scene, wanted)[0], 0, atol=1e-12)


def test_a_sliding_lung_leaves_the_elastic_body_and_a_swelling_one_moves_it(around: tuple[Body, TetMesh]) -> None:
    scene, lung = around
    border = lung.boundary
    swollen = border_motion([border], [0.1 * border.points], scene.mesh.points[scene.near])
    u = scene.follow(swollen)
    along = np.einsum("qd,qd->q", u[scene.near] - swollen, scene.normals)
    assert np.abs(along).mean() < 0.2 * np.abs(np.einsum("qd,qd->q", swollen, scene.normals)).mean()
    assert np.abs(u[scene.still]).max() < 0.3
    tangent = swollen - np.einsum("qd,qd->q", swollen, scene.normals)[:, None] * scene.normals
    slid = scene.follow(tangent)
    assert np.linalg.norm(slid, axis=1).mean() < 0.05 * np.linalg.norm(u, axis=1).mean()
    by_springs, steps = network(scene, swollen)
    assert steps <= 500
    assert np.abs(by_springs[scene.still]).max() == 0
    assert np.linalg.norm(by_springs - u, axis=1).mean() < np.linalg.norm(u, axis=1).mean()


def test_springs_are_as_stiff_as_their_grey_values_say() -> None:
    hu = np.array([-1200.0, -1000, -150, 700, 1200])
    assert_allclose(spring_stiffness(hu), [0.001, 0.001, 0.4005, 0.8, 1 - 0.2 / np.e])
