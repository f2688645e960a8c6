"""The motion that the registration found inside, continued to the pleura and to what the scanner did not see."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from poro.mesh import TetMesh, closest_points
from poro.mesh.tetmesh import signed_volumes
from registration.volume import Array
from tests.vatsloc import ball_scene as scene
from vatsloc.workflow.pose import _laid_out, continued

PULLED = np.array([[1.1, 0.2, 0.0], [-0.1, 0.8, 0.3], [0.0, 0.1, 0.95]])


def quadratic(x: Array) -> Array:
    """A large affine motion that bends a little."""
    y = x - scene.CENTRE_INF
    return np.asarray(y @ PULLED.T + 0.002 * y[:, [1]] ** 2 * np.array([0, 0, 1.0]) + scene.CENTRE_INF)


def ball() -> tuple[TetMesh, TetMesh, Array]:
    """The lung in the CT, placed by the spine, and its nodes' depths."""
    mesh = scene.lung_mesh()
    depth = -closest_points(mesh.boundary, mesh.points).distance
    return mesh, TetMesh(scene.INF_FROM_CT(mesh.points), mesh.tets), depth


def test_a_wrong_motion_at_the_pleura_is_not_believed_and_a_large_one_inside_goes_on_to_it() -> None:
    mesh, placed, depth = ball()
    truth = quadratic(placed.points)
    points = truth + np.where(depth < 6, 8.0, 0.0)[:, None] * np.array([1.0, 0, 0])  # slid along with the wall
    everywhere = np.ones(len(points), bool)
    found = continued(mesh, placed, points, everywhere, everywhere)
    error = np.linalg.norm(placed.points + found.u - truth, axis=1)
    assert error[depth >= 16].max() < 0.3
    assert error[depth < 6].mean() < 2.0  # of 8
    assert_allclose(found.det_f, signed_volumes(placed.points + found.u, mesh.tets) / placed.volumes)
    assert found.det_f.min() > 0.5


@pytest.mark.parametrize("bend", [0.0, 0.2])
def test_the_lung_is_laid_out_by_a_map_that_keeps_its_shape(bend: float) -> None:
    """A bend of 0.2 per mm turns elements inside out, so the affine map has to do."""
    _, placed, depth = ball()
    y = placed.points - scene.CENTRE_INF
    points = quadratic(placed.points) + bend * y[:, [1]] ** 2 * np.array([0, 1.0, 0])
    laid_out = _laid_out(placed, points, depth > 10)
    if bend:
        kept = signed_volumes(laid_out, placed.tets) / placed.volumes
        assert_allclose(kept, kept[0])  # affine
        assert kept[0] > 0.3
    else:
        assert_allclose(laid_out, points, atol=1e-6)


def test_a_lung_of_which_little_is_believed_stays_where_the_spine_puts_it() -> None:
    _, placed, _ = ball()
    few = np.arange(len(placed.points)) < 15
    assert _laid_out(placed, quadratic(placed.points), few) is placed.points
