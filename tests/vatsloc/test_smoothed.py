"""The motion of a lung smoothed."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from poro.mesh import TetMesh, closest_points
from registration.volume import Array
from tests.vatsloc import ball_scene as scene
from vatsloc.workflow.smoothed import TOLD_MM, smoother

AFFINE = np.array([[0.7, 0.1, 0.0], [-0.1, 0.8, 0.05], [0.0, 0.1, 0.6]])
NONE = np.zeros(0, dtype=int)


@pytest.fixture(scope="module")
def lung() -> TetMesh:
    return scene.lung_mesh(6.0)


@pytest.fixture(scope="module")
def depth(lung: TetMesh) -> Array:
    return np.abs(closest_points(lung.boundary, lung.points).distance)


def whole(lung: TetMesh) -> Array:
    return np.zeros(len(lung.points), dtype=int)


def bent(points: Array) -> Array:
    """A lung that is bent like a banana, by up to several millimetres."""
    x, y, z = ((points - scene.CENTRE_CT) / 30.0).T
    return np.asarray(points @ AFFINE.T + 3.0 * np.column_stack([y * z, x**2, x * y - z**2]))


def test_an_affine_motion_stays_as_it_is(lung: TetMesh) -> None:
    moved = lung.points @ AFFINE.T + [3.0, -2.0, 8.0]
    assert_allclose(smoother(lung, whole(lung), NONE)(moved), moved, atol=1e-9)


def test_a_bent_lung_stays_bent(lung: TetMesh, depth: Array) -> None:
    """3 mm of bend at the surface, of which deeper nodes alone tell."""
    off = np.linalg.norm(smoother(lung, whole(lung), NONE)(bent(lung.points)) - bent(lung.points), axis=1)
    affine = np.column_stack([np.ones(len(off)), lung.points])
    bend = np.linalg.norm(bent(lung.points) - affine @ np.linalg.lstsq(affine, bent(lung.points))[0], axis=1)
    assert bend[depth < 1.0].mean() > 2.5
    assert off[depth > 10.0].max() < 0.1
    assert off[depth > TOLD_MM].mean() < 0.2
    assert off[depth < 1.0].mean() < bend[depth < 1.0].mean() / 3


def test_scatter_shrinks_inside_and_at_the_surface(lung: TetMesh, depth: Array) -> None:
    true = bent(lung.points)
    smooth = smoother(lung, whole(lung), NONE)
    left = smooth(true + np.random.default_rng(1).normal(0, 0.5, true.shape)) - smooth(true)
    for where in (depth < 1.0, (depth >= TOLD_MM) & (depth < 10), depth >= 10):
        assert where.sum() > 50
        assert 0.01 < left[where].std() < 0.15


def test_nodes_near_the_surface_tell_nothing(lung: TetMesh, depth: Array) -> None:
    moved = bent(lung.points)
    strayed = moved + np.where(depth[:, None] < TOLD_MM, [7.0, 0.0, 0.0], 0.0)
    smooth = smoother(lung, whole(lung), NONE)
    assert (depth < TOLD_MM).sum() > 100
    assert_allclose(smooth(strayed), smooth(moved), atol=1e-9)


def test_held_nodes_stay_and_still_tell(lung: TetMesh, depth: Array) -> None:
    held = np.flatnonzero(depth > 12)
    moved = bent(lung.points) + np.random.default_rng(2).normal(0, 0.5, lung.points.shape)
    free, some = smoother(lung, whole(lung), NONE)(moved), smoother(lung, whole(lung), held)(moved)
    assert_array_equal(some[held], moved[held])
    others = np.setdiff1d(np.arange(len(moved)), held)
    assert_allclose(some[others], free[others], atol=1e-9)


def test_another_piece_has_no_say(lung: TetMesh) -> None:
    above = lung.points[:, 2] > lung.points[:, 2].mean()
    moved = lung.points + np.where(above[:, None], [0.0, 0, 9], [0.0, 0, -9])
    assert_allclose(smoother(lung, above.astype(int), NONE)(moved), moved, atol=1e-9)
    assert np.abs(smoother(lung, whole(lung), NONE)(moved) - moved).max() > 2


def test_a_piece_that_is_nowhere_deep_stays_as_it_is(lung: TetMesh) -> None:
    small = TetMesh(lung.points * 0.1, lung.tets)
    moved = small.points + np.random.default_rng(2).normal(0, 0.1, small.points.shape)
    assert_array_equal(smoother(small, whole(small), NONE)(moved), moved)
