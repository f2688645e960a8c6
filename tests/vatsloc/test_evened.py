"""Tissue near the pleura, half of whose motion is that of the deeper tissue about it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from poro.mesh import TetMesh, closest_points
from poro.mesh.tetmesh import signed_volumes
from registration.volume import Array
from tests.vatsloc import ball_scene as scene
from vatsloc.workflow.evened import DEEP_MM, FADING_MM, SHARE, evened

AFFINE = np.array([[0.7, 0.1, 0.0], [-0.1, 0.8, 0.05], [0.0, 0.1, 0.6]])


@pytest.fixture(scope="module")
def lung() -> TetMesh:
    return scene.lung_mesh(6.0)


@pytest.fixture(scope="module")
def depth(lung: TetMesh) -> Array:
    return np.abs(closest_points(lung.boundary, lung.points).distance)


def whole(lung: TetMesh) -> Array:
    return np.zeros(len(lung.points), dtype=int)


def test_an_affine_motion_stays_as_it_is(lung: TetMesh) -> None:
    moved = lung.points @ AFFINE.T + [3.0, -2.0, 8.0]
    assert_allclose(evened(lung, moved, whole(lung)), moved, atol=1e-9)


def test_scatter_near_the_surface_is_halved_and_deep_nodes_stay(lung: TetMesh, depth: Array) -> None:
    true = lung.points @ AFFINE.T
    scatter = np.where(depth[:, None] < DEEP_MM, np.random.default_rng(1).normal(0, 0.4, true.shape), 0)
    found = evened(lung, true + scatter, whole(lung))
    deep, near = depth >= DEEP_MM + FADING_MM, depth < DEEP_MM - 1e-6
    assert_array_equal(found[deep], true[deep])
    assert near.sum() > 100
    assert_allclose((found - true)[near], (1 - SHARE) * scatter[near], atol=1e-9)


def test_another_piece_has_no_say(lung: TetMesh) -> None:
    above = lung.points[:, 2] > lung.points[:, 2].mean()
    moved = lung.points + np.where(above[:, None], [0.0, 0, 9], [0.0, 0, -9])
    found = evened(lung, moved, above.astype(int))
    assert_allclose(found, moved, atol=1e-3)
    assert np.abs(evened(lung, moved, whole(lung)) - moved).max() > 2


def test_a_piece_that_is_nowhere_deep_stays_as_it_is() -> None:
    small = scene.lung_mesh(6.0)
    small = TetMesh(small.points * 0.2, small.tets)
    moved = small.points + np.random.default_rng(2).normal(0, 0.1, small.points.shape)
    assert_array_equal(evened(small, moved, whole(small)), moved)


def test_no_element_turns_over(lung: TetMesh, depth: Array) -> None:
    moved = lung.points.copy()
    moved[depth >= DEEP_MM] += np.random.default_rng(3).normal(0, 6.0, (int((depth >= DEEP_MM).sum()), 3))
    upright = signed_volumes(moved, lung.tets) > 0
    found = signed_volumes(evened(lung, moved, whole(lung)), lung.tets)
    assert (found[upright] > 0).all()
