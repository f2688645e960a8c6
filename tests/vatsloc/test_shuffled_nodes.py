"""The order of nodes is nobody's business: shuffled together with their values they give every point the same answer,
and values in another order than their nodes give another one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from poro.collapse import Theta, assemble, solve
from poro.collapse.solution import sensitivity
from poro.fem import Tissue, extrapolate
from poro.fit import FitSettings, Target, constraints_to, elastic_correction, fit_collapse
from poro.mesh import TetMesh, interpolate, locate
from registration.correspondences import Correspondences
from registration.volume import Array
from tests.vatsloc import ball_scene as scene
from vatsloc.formats.meshes import TetraMesh, read_vtu, write_vtu
from vatsloc.imaging.surface import Border, SurfacePoints
from vatsloc.maps import MeshMap, covered, sampled
from vatsloc.workflow.model_selection import misfit
from vatsloc.workflow.observe import held_nodes
from vatsloc.workflow.residual import _border_offsets

BALL = scene.lung_mesh(14.0)
ORDER = np.random.default_rng(11).permutation(len(BALL.points))
TETS = np.random.default_rng(12).permutation(len(BALL.tets))
PLACE = np.argsort(ORDER)
"""Where a node went: node i of BALL is node PLACE[i] of SHUFFLED."""
SHUFFLED = TetMesh(BALL.points[ORDER], PLACE[BALL.tets][TETS])
INNER = scene.CENTRE_CT + np.random.default_rng(13).uniform(-19, 19, (60, 3))
GRAVITY = np.array([1.0, 0.0, 0.0])


def wavy(points: Array) -> Array:
    """A smooth motion of a few millimetres that no affine map makes."""
    x = (points - scene.CENTRE_CT) / 25.0
    return 3.0 * np.stack([np.sin(x[:, 1]), np.cos(x[:, 2]) + x[:, 0], x[:, 0] * x[:, 1]], axis=1)


MOVED = scene.INF_FROM_CT(BALL.points + wavy(BALL.points))
MESHES: dict[str, tuple[TetMesh, Array]] = {"as made": (BALL, MOVED), "shuffled": (SHUFFLED, MOVED[ORDER])}


def differs(answer: Callable[[TetMesh, Array], Array], by: float) -> None:
    """Shuffled together both give one answer; with nodes alone shuffled it is off by more than `by` somewhere."""
    right = answer(*MESHES["as made"])
    assert_allclose(answer(*MESHES["shuffled"]), right, atol=1e-4)
    assert np.abs(answer(SHUFFLED, MOVED) - right).max() > by


def test_maps_carry_points_alike() -> None:
    differs(lambda mesh, moved: MeshMap(mesh, moved, scene.INF_FROM_CT)(INNER), 5.0)
    differs(lambda mesh, moved: interpolate(locate(mesh, INNER), moved), 5.0)


def test_maps_lead_back_alike() -> None:
    back = [MeshMap(*MESHES[name], scene.INF_FROM_CT).inverse()(scene.INF_FROM_CT(INNER)) for name in MESHES]
    assert_allclose(back[0], back[1], atol=1e-6)
    forth = MeshMap(BALL, MOVED, scene.INF_FROM_CT)(back[1])
    assert_allclose(forth, scene.INF_FROM_CT(INNER), atol=1e-6)


def test_sampled_maps_and_covered_voxels_are_alike() -> None:
    grid = scene.grid_about(scene.CENTRE_CT, 24, 4.0)
    differs(lambda mesh, moved: sampled(MeshMap(mesh, moved, scene.INF_FROM_CT), grid).vectors, 5.0)
    assert_array_equal(covered(BALL, grid).inside, covered(SHUFFLED, grid).inside)


def test_a_surface_knows_its_nodes_in_the_mesh() -> None:
    for mesh in (BALL, SHUFFLED):
        surface = mesh.boundary
        assert_array_equal(surface.points, mesh.points[surface.nodes])
        outward = surface.points - scene.CENTRE_CT
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        assert np.einsum("nd,nd->n", surface.node_normals, outward).min() > 0.8
    assert set(ORDER[SHUFFLED.boundary.nodes]) == set(BALL.boundary.nodes)
    assert not np.array_equal(SHUFFLED.boundary.nodes, np.arange(len(SHUFFLED.boundary.nodes)))


def test_an_extrapolation_does_not_ask_for_the_order_of_its_nodes() -> None:
    known = np.flatnonzero(np.abs(BALL.points[:, 2] - scene.CENTRE_CT[2]) < 20.0)
    values = wavy(BALL.points[known])
    right = extrapolate(BALL, known, values, Tissue()).u
    assert_allclose(right[known], values, atol=1e-9)
    mixed = np.random.default_rng(14).permutation(len(known))
    assert_allclose(extrapolate(BALL, known[mixed], values[mixed], Tissue()).u, right, atol=1e-8)
    assert_allclose(extrapolate(SHUFFLED, PLACE[known], values, Tissue()).u, right[ORDER], atol=1e-7)
    weights = np.where(values[:, 0] > 0, 100.0, 1.0)
    soft = extrapolate(BALL, known, values, Tissue(), weights).u
    again = extrapolate(SHUFFLED, PLACE[known][mixed], values[mixed], Tissue(), weights[mixed]).u
    assert_allclose(again, soft[ORDER], atol=1e-7)
    assert np.abs(soft - right).max() > 0.1  # soft ones give way, so that weights in another order would show


def target_of(u: Array) -> Target:
    """The surface of BALL moved by u (n, 3), and places inside it."""
    boundary = BALL.boundary
    moved = boundary.moved(boundary.points + u[boundary.nodes])
    places = INNER + interpolate(locate(BALL, INNER), u)
    return Target(moved.points, moved.node_normals, np.ones(len(moved.points)), INNER, places, np.ones(len(INNER)))


def test_a_correction_is_the_same_field() -> None:
    u = wavy(BALL.points)
    start, target, settings = 0.4 * u, target_of(u), FitSettings()
    found = elastic_correction(BALL, start, Tissue(), constraints_to(target, BALL, start, settings)).u
    wanted = constraints_to(target, SHUFFLED, start[ORDER], settings)
    again = elastic_correction(SHUFFLED, start[ORDER], Tissue(), wanted).u
    assert_allclose(again, found[ORDER], atol=1e-6)
    assert np.linalg.norm(found + start - u, axis=1).mean() < 0.5 * np.linalg.norm(start - u, axis=1).mean()


def hilum_of(mesh: TetMesh) -> Array:
    return held_nodes(mesh, scene.CENTRE_CT + np.array([-30.0, 0, 0]), 16.0)


def test_a_solved_and_a_fitted_lung_are_the_same() -> None:
    hilum = hilum_of(BALL)
    assert set(ORDER[hilum_of(SHUFFLED)]) == set(hilum)
    shift = wavy(BALL.points[hilum])
    mixed = np.random.default_rng(15).permutation(len(hilum))
    system = assemble(BALL, Tissue(), GRAVITY, hilum, shift)
    other = assemble(SHUFFLED, Tissue(), GRAVITY, PLACE[hilum][mixed], shift[mixed])
    theta = Theta(2e-8, 0.7, 0.0)  # a ball has no principal axis of its own that a diaphragm could move along
    state, again = solve(system, theta), solve(other, theta)
    assert_allclose(state.u[hilum], shift, atol=1e-9)
    assert_allclose(again.u, state.u[ORDER], atol=2e-3)
    assert_allclose(sensitivity(other, again)[..., :2], sensitivity(system, state)[ORDER, :, :2], atol=0.05)
    settings = FitSettings(max_steps=4)
    one, two = (fit_collapse(lung, target_of(state.u), settings) for lung in (system, other))
    assert_allclose(two.theta.vector(), one.theta.vector(), atol=0.05)
    assert_allclose(two.state.u, one.state.u[ORDER], atol=0.05)


def test_misfits_are_alike_and_a_shuffled_displacement_shows() -> None:
    u = wavy(BALL.points)
    pairs = Correspondences.of(INNER + interpolate(locate(BALL, INNER), u), INNER)
    assert misfit(BALL, u, pairs) == pytest.approx(0, abs=1e-9)
    assert misfit(SHUFFLED, u[ORDER], pairs) == pytest.approx(0, abs=1e-9)
    assert misfit(SHUFFLED, u, pairs) > 1.0


def test_the_border_moves_at_the_same_places() -> None:
    boundary = BALL.boundary
    count = len(boundary.nodes)
    air = SurfacePoints(
        boundary.points + 2.0 * boundary.node_normals,
        boundary.node_normals,
        np.ones(count),
        np.full(count, Border.AIR, dtype=np.int8),
    )
    free = BALL.points[:, 0] > scene.CENTRE_CT[0]
    nodes, moves = _border_offsets(BALL, air, free)
    others, again = _border_offsets(SHUFFLED, air, free[ORDER])
    assert 0.3 * count < len(nodes) < 0.7 * count
    back = np.argsort(ORDER[others])
    assert_array_equal(ORDER[others][back], nodes)
    assert_allclose(again[back], moves, atol=1e-9)


def test_meshes_come_back_from_files_with_every_value_at_its_node(tmp_path: Path) -> None:
    for name, (mesh, moved) in MESHES.items():
        values = {"displacement": moved - mesh.points, "radius95_mm": mesh.points @ [1.0, 2.0, 3.0]}
        det = mesh.points[mesh.tets].mean(axis=1) @ [3.0, 2.0, 1.0]
        write_vtu(tmp_path / f"{name}.vtu", TetraMesh(mesh.points, mesh.tets, values, {"det F": det}))
        back = read_vtu(tmp_path / f"{name}.vtu")
        assert_allclose(back.point_data["radius95_mm"], back.points_ras @ [1.0, 2.0, 3.0], atol=1e-4)
        assert_allclose(back.cell_data["det F"], back.points_ras[back.tets].mean(axis=1) @ [3.0, 2.0, 1.0], atol=1e-4)
        lung = TetMesh(back.points_ras, np.asarray(back.tets))
        carried = INNER + interpolate(locate(lung, INNER), back.point_data["displacement"])
        assert_allclose(carried, MeshMap(BALL, MOVED, scene.INF_FROM_CT)(INNER), atol=1e-4)
