"""A mesh's map and its gradient."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from registration.maps.rigid import RigidTransform
from tests.vatsloc import ball_scene as scene
from vatsloc.maps import MeshMap

AROUND = RigidTransform.about(scene.CENTRE_CT, np.array([0.2, -0.1, 0.3]), np.array([5.0, 3.0, -2.0]))


def test_values_and_gradients_are_those_of_the_map() -> None:
    mesh = scene.lung_mesh()
    x = mesh.points - scene.CENTRE_CT
    moved = AROUND(mesh.points) + 0.004 * x[:, [1, 2, 0]] * x[:, [0, 1, 2]]
    mapping = MeshMap(mesh, moved, AROUND)
    points = mesh.points[mesh.tets[::40]].mean(axis=1)
    found = mapping.linearized(points)
    assert_allclose(found.values, mapping(points), atol=1e-12)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-4
        assert_allclose(
            found.gradients[:, :, axis], (mapping(points + step) - mapping(points - step)) / 2e-4, atol=1e-6
        )
    assert np.abs(found.gradients - AROUND.matrix[:3, :3]).max() > 0.05


def test_outside_the_mesh_the_gradient_is_the_rigid_motions() -> None:
    mesh = scene.lung_mesh()
    mapping = MeshMap(mesh, 1.3 * mesh.points, AROUND)
    far = scene.CENTRE_CT + np.array([[90.0, 0, 0]])
    found = mapping.linearized(far)
    assert_allclose(found.gradients[0], AROUND.matrix[:3, :3])
    assert_allclose(found.values, mapping(far))
