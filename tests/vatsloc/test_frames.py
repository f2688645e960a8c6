"""Crossing between RAS and LPS, and the order of voxel axes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from registration.volume import Grid, axis_codes
from vatsloc.frames import flip_affine, flip_field, flip_points, flip_transform, reorient

ORIENTATIONS = ["RAS", "LAS", "LPS", "RPI", "PIR", "SAL", "ILP", "oblique", "steep"]


def affine_of(orientation: str) -> np.ndarray:
    """(4, 4) with unequal spacings, so that a swapped axis shows."""
    spacing, origin = np.array([0.7, 1.3, 2.1]), np.array([-31.0, 17.0, 5.0])
    if orientation == "oblique":
        axes = Rotation.from_rotvec([0.2, -0.3, 0.1]).as_matrix() * [-1, 1, 1]
    elif orientation == "steep":
        axes = Rotation.from_euler("z", 45, degrees=True).as_matrix()
    else:
        axes = np.zeros((3, 3))
        for column, letter in enumerate(orientation):
            axes["RLAPSI".index(letter) // 2, column] = 1 if letter in "RAS" else -1
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = axes * spacing, origin
    return affine


def test_points_change_the_sign_of_the_first_two_coordinates():
    assert_allclose(flip_points(np.array([[1.0, 2.0, 3.0], [-4.0, 0.5, -6.0]])), [[-1, -2, 3], [4, -0.5, -6]])


def test_points_come_back():
    points = np.random.default_rng(0).normal(size=(5, 3))
    assert_allclose(flip_points(flip_points(points)), points)


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_affine_and_points_agree(orientation):
    ras_from_ijk = affine_of(orientation)
    ijk = np.array([[0, 0, 0], [3, 1, 2], [1, 4, 0]])
    by_points = flip_points(ijk @ ras_from_ijk[:3, :3].T + ras_from_ijk[:3, 3])
    lps_from_ijk = flip_affine(ras_from_ijk)
    assert_allclose(ijk @ lps_from_ijk[:3, :3].T + lps_from_ijk[:3, 3], by_points)
    assert_allclose(np.linalg.det(lps_from_ijk), np.linalg.det(ras_from_ijk))


def test_transform_commutes_with_the_border():
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec([0.1, 0.4, -0.2]).as_matrix(), [5, -6, 7]
    point = np.array([10.0, 20.0, 30.0])
    in_lps = flip_transform(matrix)
    moved = in_lps[:3, :3] @ flip_points(point) + in_lps[:3, 3]
    assert_allclose(flip_points(moved), matrix[:3, :3] @ point + matrix[:3, 3])


def test_field_flips_its_vectors_in_place_of_its_voxels():
    vectors = np.zeros((2, 3, 4, 3), dtype=np.float32)
    vectors[1, 2, 3] = [1, 2, 3]
    flipped = flip_field(vectors)
    assert flipped.dtype == np.float32
    assert_allclose(flipped[1, 2, 3], [-1, -2, 3])
    assert not flipped[0].any()


@pytest.mark.parametrize("orientation", ORIENTATIONS)
@pytest.mark.parametrize("codes", ["LPS", "RAS", "SPL"])
def test_reorienting_leaves_every_voxel_where_it_is(orientation, codes):
    grid = Grid((3, 4, 5), affine_of(orientation))
    points, affine = reorient(grid.points(), grid.ras_from_ijk, codes)
    assert_allclose(Grid(points.shape[:3], affine).points(), points, atol=1e-12)
    if orientation != "steep":
        assert axis_codes(affine) == codes


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_reorienting_there_and_back_changes_nothing(orientation):
    values, affine = np.arange(60).reshape(3, 4, 5), affine_of(orientation)
    back, back_affine = reorient(
        *reorient(values, affine, "SAL"), axis_codes(affine) if orientation != "steep" else "RAS"
    )
    assert np.array_equal(back, values)
    assert_allclose(back_affine, affine, atol=1e-12)


@pytest.mark.parametrize("codes", ["LP", "LRS", "XYZ", "LPSA"])
def test_codes_must_name_three_directions(codes):
    with pytest.raises(ValueError, match="codes must name three directions"):
        reorient(np.zeros((2, 2, 2)), np.eye(4), codes)
