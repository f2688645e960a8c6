"""Stuffing keeps angles, volume and topology; points are found where they lie."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from shapes import box, ellipsoid

from poro.mesh import (
    TetMesh,
    closest_points,
    interpolate,
    locate,
    patches,
    quality,
    stuff,
    stuff_level_set,
    surface,
)
from poro.mesh.patches import principal_axis
from poro.mesh.tetmesh import dihedral_angles


def _ball(p: np.ndarray) -> np.ndarray:
    return 30 - np.linalg.norm(p - [1, 2, 3], axis=1)


@pytest.mark.parametrize("edge", [4.0, 6.0, 9.0])
def test_stuffed_ball_keeps_the_angle_bound_and_volume(edge: float) -> None:
    mesh = stuff_level_set(_ball, np.full(3, -35.0), np.full(3, 40.0), edge)
    report = quality(mesh)
    assert report.min_dihedral > 12
    assert report.max_dihedral < 160
    assert report.volume_l * 1e6 == pytest.approx(4 / 3 * np.pi * 30**3, rel=0.1 * (edge / 9) ** 2)
    assert report.mean_edge == pytest.approx(edge, rel=0.05)
    assert (mesh.volumes > 0).all()


def test_surface_is_closed_outward_and_without_handles() -> None:
    mesh = stuff_level_set(_ball, np.full(3, -35.0), np.full(3, 40.0), 6.0)
    s = surface(mesh)
    edges = np.sort(s.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()
    assert len(s.points) - len(count) + len(s.triangles) == 2
    assert_allclose(s.area_vectors.sum(axis=0), 0, atol=1e-9)
    volume = np.einsum("td,td->", s.points[s.triangles].mean(axis=1), s.area_vectors) / 3
    assert volume == pytest.approx(mesh.volumes.sum(), rel=1e-12)
    radial = (s.points - [1, 2, 3]) / np.linalg.norm(s.points - [1, 2, 3], axis=1)[:, None]
    assert_allclose(s.node_normals, radial, atol=0.25)
    assert s.node_areas.sum() == pytest.approx(4 * np.pi * 900, rel=0.03)


def test_dihedral_angles_of_a_right_corner() -> None:
    corner = TetMesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]), np.array([[0, 1, 2, 3]]))
    assert_allclose(np.sort(dihedral_angles(corner)[0]), [np.degrees(np.arccos(1 / np.sqrt(3)))] * 3 + [90] * 3)


@pytest.mark.parametrize("flip", [(1, 1, 1), (-1, 1, 1), (-1, -1, 1), (1, -1, -1)])
def test_mask_orientation_does_not_move_the_mesh(flip: tuple[int, int, int]) -> None:
    shape = np.array([40, 44, 30])
    affine = np.diag([1.5, 1.5, 2.0, 1.0])
    affine[:3, 3] = [-30, -33, -30]
    index = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1)
    inside = np.linalg.norm((index @ affine[:3, :3] + affine[:3, 3] - [2, 1, 0]) / [18, 22, 24], axis=-1) < 1
    inside[0, 0, 0] = True
    turn = np.diag([*flip, 1.0])
    turn[:3, 3] = np.where(np.array(flip) < 0, shape - 1, 0)
    flipped = inside[:: flip[0], :: flip[1], :: flip[2]]
    mesh = stuff(flipped, affine @ turn, 6.0)
    centre = np.average(mesh.points, axis=0, weights=mesh.node_volumes)
    assert_allclose(centre, [2, 1, 0], atol=0.3)
    assert mesh.volumes.sum() == pytest.approx(4 / 3 * np.pi * 18 * 22 * 24, rel=0.06)


def test_empty_and_thin_masks_are_refused() -> None:
    with pytest.raises(ValueError, match="non-empty"):
        stuff(np.zeros((5, 5, 5), bool), np.eye(4), 5.0)
    with pytest.raises(ValueError, match="edge_mm must be positive"):
        stuff(np.ones((5, 5, 5), bool), np.eye(4), 0.0)


def test_location_reproduces_linear_fields_inside_and_the_surface_outside() -> None:
    mesh = ellipsoid(8.0)
    points = np.random.default_rng(1).uniform(-70, 70, (2000, 3))
    where = locate(mesh, points)
    assert_allclose(where.barycentric.sum(axis=1), 1, atol=1e-12)
    assert_allclose(interpolate(where, mesh.points)[where.inside], points[where.inside], atol=1e-9)
    level = np.linalg.norm(points / [40, 50, 65], axis=1)
    assert where.inside[level < 0.95].all()
    assert not where.inside[level > 1.02].any()
    landed = interpolate(where, mesh.points)
    assert_allclose(np.linalg.norm(landed - points, axis=1), where.distance, atol=1e-9)


def test_closest_points_are_no_farther_than_any_sample() -> None:
    mesh = ellipsoid(10.0)
    s = mesh.boundary
    rng = np.random.default_rng(2)
    queries = rng.uniform(-80, 80, (300, 3))
    near = closest_points(s, queries)
    weights = rng.dirichlet(np.ones(3), (len(s.triangles), 20))
    samples = np.einsum("tsk,tkd->tsd", weights, s.points[s.triangles]).reshape(-1, 3)
    nearest = np.linalg.norm(queries[:, None] - samples[None, ::7], axis=2).min(axis=1)
    assert (np.abs(near.distance) <= nearest + 1e-9).all()
    assert_allclose(np.linalg.norm(queries - near.points, axis=1), np.abs(near.distance), atol=1e-12)
    inside = locate(mesh, queries).inside
    assert ((near.distance < 0) == inside).all()


def test_patches_cover_the_surface_and_look_where_they_should() -> None:
    mesh = ellipsoid(8.0)
    s = mesh.boundary
    found = patches(s, np.array([[-38.0, 0, 0]]))
    total = found.diaphragm.astype(int) + found.mediastinal + found.costal + found.hilum
    assert (total == 1).all()
    assert (s.node_normals[found.diaphragm, 2] < 0).all()
    assert (s.points[found.diaphragm, 2] < 0).all()
    assert (s.node_normals[found.mediastinal, 0] < 0).all()
    assert_allclose(np.abs(principal_axis(mesh)), [0, 0, 1], atol=0.02)


def test_box_fixture_fills_its_volume() -> None:
    mesh = box((3, 2, 4), (3.0, 4.0, 5.0))
    assert mesh.volumes.sum() == pytest.approx(60)
    assert (mesh.volumes > 0).all()


def test_points_are_located_in_a_mesh_turned_inside_out() -> None:
    mesh = stuff_level_set(lambda x: 20.0 - np.linalg.norm(x, axis=-1), np.full(3, -22.0), np.full(3, 22.0), 8.0)
    mirrored = TetMesh(mesh.points * [-1, 1, 1], mesh.tets)
    found = locate(mirrored, np.array([[3.0, 2.0, 1.0]]))
    assert_allclose(interpolate(found, mirrored.points)[0], [3, 2, 1], atol=1e-9)


@pytest.mark.parametrize("tets", [np.zeros((2, 3), int), np.zeros(4, int), np.zeros((2, 4, 1), int)])
def test_elements_of_another_shape_are_refused(tets: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"tets must be \(m, 4\)"):
        TetMesh(np.zeros((5, 3)), tets)


@pytest.mark.parametrize("points", [np.zeros((5, 2)), np.zeros(3), np.zeros((5, 3, 1))])
def test_nodes_of_another_shape_are_refused(points: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"points must be \(n, 3\)"):
        TetMesh(points, np.zeros((1, 4), int))
