"""Radii of trees branch as they should, and tubes fill their volume."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from phantoms.trees import draw_tubes, grow, tubes
from phantoms.voxels import Grid


@pytest.fixture(scope="module")
def cloud() -> np.ndarray:
    return np.random.default_rng(0).uniform([0, -60, -90], [90, 60, 90], (4000, 3))


def test_radii_follow_murray_at_every_fork(cloud: np.ndarray) -> None:
    tree = grow([cloud], np.array([-20.0, 0, 0]), np.zeros(3), 30, 0.6, 3.0)
    inner = np.unique(tree.parent[tree.parent >= 0])
    below = np.bincount(tree.parent[1:], tree.radius[1:] ** 3, minlength=len(tree.nodes))
    assert_allclose(tree.radius[inner] ** 3, below[inner])
    leaves = np.setdiff1d(np.arange(len(tree.nodes)), inner)
    assert_allclose(tree.radius[leaves], 0.6)
    assert len(leaves) > 100


def test_tree_comes_close_to_every_point(cloud: np.ndarray) -> None:
    tree = grow([cloud], np.array([-20.0, 0, 0]), np.zeros(3), 30, 0.6, 3.0)
    gap = np.linalg.norm(cloud[::20, None] - tree.nodes[None], axis=2).min(axis=1)
    assert gap.max() < 25
    assert gap.mean() < 10


def test_kept_branches_still_hang_together(cloud: np.ndarray) -> None:
    tree = grow([cloud], np.array([-20.0, 0, 0]), np.zeros(3), 30, 0.6, 3.0)
    top = tree.keep(tree.generation <= 4)
    full = {tuple(n): tuple(tree.nodes[p]) for n, p in zip(tree.nodes[1:], tree.parent[1:], strict=True)}
    assert all(full[tuple(n)] == tuple(top.nodes[p]) for n, p in zip(top.nodes[1:], top.parent[1:], strict=True))
    assert top.generation.max() == 4


def test_every_cloud_is_fed_by_branches_of_its_own(cloud: np.ndarray) -> None:
    low = cloud[:, 2] < 0
    tree = grow([cloud[low], cloud[~low]], np.array([-20.0, 0, 0]), np.zeros(3), 30, 0.6, 3.0)
    assert set(tree.cloud[2:]) == {0, 1}
    child = np.flatnonzero(tree.parent > 1)
    assert np.array_equal(tree.cloud[child], tree.cloud[tree.parent[child]])
    # Branches end between points of a convex cloud, so they stay on its side.
    assert (tree.nodes[2:, 2][tree.cloud[2:] == 0] < 0).all()
    assert (tree.nodes[2:, 2][tree.cloud[2:] == 1] > 0).all()


def test_tubes_start_and_end_at_nodes(cloud: np.ndarray) -> None:
    tree = grow([cloud], np.array([-20.0, 0, 0]), np.zeros(3), 200, 0.6, 3.0)
    ends, radii = tubes(tree, 0.1, np.random.default_rng(0))
    pieces = ends.reshape(-1, 3, 2, 3)
    assert_allclose(pieces[:, 0, 0], tree.nodes[tree.parent[1:]])
    assert_allclose(pieces[:, 2, 1], tree.nodes[1:])
    assert_allclose(pieces[:, :-1, 1], pieces[:, 1:, 0])
    assert np.all(np.diff(radii, axis=1) < 0)


@pytest.mark.parametrize("radius", [3.0, 6.0])
def test_drawn_tube_has_the_volume_of_a_capsule(radius: float) -> None:
    grid = Grid((60, 60, 80), np.array([[-1.0, 0, 0, 30], [0, -1, 0, 30], [0, 0, 1, -40], [0, 0, 0, 1]]))
    share = np.zeros(grid.shape, dtype=np.float32)
    ends = np.array([[[-4.0, -5, -20], [6, 3, 20]]])
    draw_tubes(share, grid, ends, np.full((1, 2), radius), 1.0)
    length = np.linalg.norm(ends[0, 1] - ends[0, 0])
    assert share.sum() == pytest.approx(np.pi * radius**2 * (length + 4 / 3 * radius), rel=0.02)
    centre = grid.to_ras(np.array([np.average(i, weights=share) for i in np.indices(share.shape)]))
    assert_allclose(centre, ends[0].mean(axis=0), atol=0.05)
