"""Nodal fields on voxels, beside the search for every voxel's tetrahedron."""

from __future__ import annotations

import numpy as np
import pytest

from poro.mesh import TetMesh, interpolate, locate, rasterize, stuff_level_set

TURN = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))[0]
SHAPE = (30, 27, 33)


def ball() -> TetMesh:
    return stuff_level_set(lambda x: 20 - np.linalg.norm(x, axis=-1), np.full(3, -25.0), np.full(3, 25.0), 7.0)


def grid(turn: np.ndarray, spacing: float, shift: float) -> tuple[np.ndarray, np.ndarray]:
    """ijk_from_ras (4, 4), and the voxels' centres (n, 3)."""
    ras_from_ijk = np.eye(4)
    ras_from_ijk[:3, :3] = turn * spacing
    ras_from_ijk[:3, 3] = shift - ras_from_ijk[:3, :3] @ ((np.array(SHAPE) - 1) / 2)
    ijk = np.argwhere(np.ones(SHAPE, bool))
    return np.linalg.inv(ras_from_ijk), ijk @ ras_from_ijk[:3, :3].T + ras_from_ijk[:3, 3]


@pytest.mark.parametrize(("turn", "spacing", "shift"), [(TURN, 1.7, 0.3), (np.diag([-1, -1, 1.0]), 1.0, 12.0)])
def test_every_voxel_has_what_a_search_finds_there(turn: np.ndarray, spacing: float, shift: float) -> None:
    mesh, (ijk_from_ras, centres) = ball(), grid(turn, spacing, shift)
    nodal = np.column_stack([np.sin(mesh.points / 9), mesh.points[:, 0] * mesh.points[:, 1]])
    values, inside = rasterize(mesh, nodal, ijk_from_ras, SHAPE)
    found = locate(mesh, centres, nearest=False)
    assert 1000 < inside.sum() < inside.size
    np.testing.assert_array_equal(inside.ravel(), found.inside)
    np.testing.assert_allclose(values.reshape(-1, 4), interpolate(found, nodal), atol=1e-4)


def test_a_linear_field_is_exact_and_voxels_on_faces_belong_to_one_tetrahedron() -> None:
    cube = np.array([[a, b, c] for a in (0, 8) for b in (0, 8) for c in (0, 8)], float)
    tets = np.array([[0, 4, 6, 7], [0, 6, 2, 7], [0, 2, 3, 7], [0, 3, 1, 7], [0, 1, 5, 7], [0, 5, 4, 7]])
    mesh = TetMesh(cube, tets)
    assert np.all(mesh.volumes > 0)
    values, inside = rasterize(mesh, cube @ [[1.0], [10.0], [100.0]], np.eye(4), (10, 10, 10))
    ijk = np.argwhere(inside)
    assert len(ijk) == 9**3
    np.testing.assert_allclose(values[inside][:, 0], ijk @ [1.0, 10, 100], atol=1e-4)
    assert values[~inside].max() == 0
