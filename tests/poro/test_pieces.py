"""A cut lung keeps its volume and its angles; nodes on the cut are two unless the pieces are joined there."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from poro.fem import Tissue, extrapolate
from poro.mesh import interpolate, locate, quality, stuff
from poro.mesh.pieces import Pieces, stuff_pieces

EDGE_MM, RADIUS_MM = 6.0, 30.0
NORMAL = np.array([0.2, 0.6, 0.77])


def _ball() -> tuple[np.ndarray, np.ndarray]:
    affine = np.diag([2.0, 2.0, 2.0, 1.0])
    affine[:3, 3] = -40.0
    ijk = np.stack(np.meshgrid(*[np.arange(41)] * 3, indexing="ij"), axis=-1)
    return np.linalg.norm(ijk * 2.0 - 40.0, axis=-1) < RADIUS_MM, affine


def _side(points: np.ndarray) -> np.ndarray:
    return points @ NORMAL / np.linalg.norm(NORMAL) - 4.0


def _cut(joined_mm: float) -> Pieces:
    return stuff_pieces(*_ball(), EDGE_MM, _side, lambda x: np.linalg.norm(x, axis=1) < joined_mm)


def _bodies(pieces: Pieces) -> int:
    tets = pieces.mesh.tets
    n = len(pieces.mesh.points)
    graph = coo_matrix((np.ones(3 * len(tets)), (tets[:, :3].ravel(), tets[:, 1:].ravel())), shape=(n, n))
    return int(connected_components(graph, directed=False)[0])


def test_a_cut_ball_keeps_its_volume_and_has_no_slivers() -> None:
    whole, pieces = stuff(*_ball(), EDGE_MM), _cut(0.0)
    assert pieces.mesh.volumes.min() > 0
    rim_mm = 2 * np.pi * np.sqrt(RADIUS_MM**2 - 16)
    rounded = 0.5 * EDGE_MM**2 * rim_mm  # the lattice rounds the sharp rim of the cut
    assert 0 < whole.volumes.sum() - pieces.mesh.volumes.sum() < rounded
    assert quality(pieces.mesh).min_dihedral > 12
    above = (RADIUS_MM - 4) ** 2 * (2 * RADIUS_MM + 4) / (4 * RADIUS_MM**3)  # a cap's share of the ball
    for number, share in ((0, above), (1, 1 - above)):
        lost = share * whole.volumes.sum() - pieces.mesh.volumes[pieces.piece == number].sum()
        assert 0 < lost < rounded


def test_nodes_of_the_cut_are_two_at_one_place_and_lie_on_the_sheet() -> None:
    pieces = _cut(0.0)
    first, second = pieces.pairs.T
    assert_allclose(pieces.mesh.points[first], pieces.mesh.points[second], atol=1e-9)
    assert np.abs(_side(pieces.mesh.points[first])).max() < 1e-6
    assert (pieces.node_piece()[first] == 0).all()
    assert (pieces.node_piece()[second] == 1).all()
    disc, per_node = np.pi * (RADIUS_MM**2 - 16), EDGE_MM**2
    assert len(first) > 0.4 * disc / per_node


def test_pieces_hang_together_only_where_they_are_joined() -> None:
    assert _bodies(_cut(0.0)) == 2
    assert _bodies(_cut(12.0)) == 1
    assert len(_cut(12.0).pairs) < len(_cut(0.0).pairs)


def test_points_on_either_side_go_with_their_own_piece() -> None:
    pieces = _cut(0.0)
    apart = np.where(pieces.node_piece()[:, None] == 0, [0.0, 0.0, 9.0], [0.0, 5.0, 0.0])
    rng = np.random.default_rng(3)
    points = rng.uniform(-20, 20, (400, 3))
    points = points[(np.linalg.norm(points, axis=1) < 25) & (np.abs(_side(points)) > 1e-3)]
    moved = interpolate(locate(pieces.mesh, points), apart)
    assert_allclose(moved, np.where(_side(points)[:, None] > 0, [0.0, 0.0, 9.0], [0.0, 5.0, 0.0]), atol=1e-9)


def test_a_push_on_one_piece_leaves_the_other_where_it_is() -> None:
    """Each piece follows its own imposed nodes, and only the joined part feels both."""
    pieces = _cut(0.0)
    piece = pieces.node_piece()
    far = np.flatnonzero(np.abs(_side(pieces.mesh.points)) > 15)
    wanted = np.where(piece[far, None] == 0, [0.0, 0.0, 9.0], [0.0, 0.0, 0.0])
    u = extrapolate(pieces.mesh, far, wanted, Tissue()).u
    assert_allclose(u[piece == 0], np.broadcast_to([0.0, 0.0, 9.0], ((piece == 0).sum(), 3)), atol=1e-8)
    assert_allclose(u[piece == 1], 0.0, atol=1e-8)


def test_a_part_holds_the_tetrahedra_of_its_piece() -> None:
    pieces = _cut(12.0)
    for number in (0, 1):
        part, nodes = pieces.part(number)
        assert part.volumes.sum() == pytest.approx(pieces.mesh.volumes[pieces.piece == number].sum())
        assert_allclose(part.points, pieces.mesh.points[nodes])


def test_a_sheet_beside_the_ball_leaves_nothing_for_one_piece() -> None:
    with pytest.raises(ValueError, match="no element"):
        stuff_pieces(*_ball(), EDGE_MM, lambda x: x[:, 2] - 60.0, lambda x: np.zeros(len(x), bool))


def test_an_incomplete_fissure_leaves_the_fused_part_whole() -> None:
    """Grown together on one side of a line: shared nodes there, two nodes at every place of the cut elsewhere."""
    pieces = stuff_pieces(*_ball(), EDGE_MM, _side, lambda x: x[:, 0] > 0)
    first, second = (pieces.part(number)[1] for number in (0, 1))
    shared = np.intersect1d(first, second)
    assert len(shared) > 20
    assert (pieces.mesh.points[shared, 0] > 0).all()
    assert (pieces.mesh.points[pieces.pairs[:, 0], 0] <= 0).all()
    assert_allclose(pieces.mesh.points[shared] @ NORMAL / np.linalg.norm(NORMAL), 4.0, atol=1e-6)
    complete = _cut(0.0)
    assert len(shared) + len(pieces.pairs) == len(complete.pairs)
    assert _bodies(pieces) == 1
    boundary = pieces.mesh.boundary
    faces = boundary.points[boundary.triangles]
    fused = (np.abs(_side(faces.reshape(-1, 3))).reshape(-1, 3).max(axis=1) < 1e-6) & (faces[:, :, 0].min(axis=1) > 0)
    # No crack in the midst of it: only a groove along its rim, where either side's lattice rounds a sharp edge.
    assert np.linalg.norm(faces[fused], axis=2).max(axis=1).min() > RADIUS_MM - 1.5 * EDGE_MM


def _bowed(points: np.ndarray) -> np.ndarray:
    return points[:, 2] + 0.9 * points[:, 1] - 6 + 8 * (points[:, 0] / 30) ** 2


@pytest.mark.parametrize("edge_mm", [4.0, 6.0, 8.0])
def test_a_bowed_cut_has_no_slivers_at_any_size_of_element(edge_mm: float) -> None:
    pieces = stuff_pieces(*_ball(), edge_mm, _bowed, lambda x: x[:, 0] > 10)
    told = quality(pieces.mesh)
    assert told.min_dihedral > 12
    assert told.max_dihedral < 160
    assert told.min_edge > 0.25 * edge_mm
    assert pieces.mesh.volumes.min() > 1e-3 * edge_mm**3
    assert set(np.unique(pieces.piece)) == {0, 1}
