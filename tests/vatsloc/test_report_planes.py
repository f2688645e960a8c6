"""Flat pictures out of space: where points land, what is sampled there, how surfaces and ellipsoids are cut."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from registration.maps.rigid import RigidTransform
from registration.volume import Grid, Volume
from vatsloc.formats.meshes import Surface
from vatsloc.report.planes import AXES, box_of, ellipse, plane_through, sample, section
from vatsloc.report.stack import slice_positions

BOX = (np.array([-50.0, -40, -30]), np.array([50.0, 40, 30]))
CORNERS = np.array([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)])
# Two triangles per face, from the quadrangle of its corners.
QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
CUBE = Surface(10 * CORNERS, np.concatenate([QUADS[:, [0, 1, 2]], QUADS[:, [0, 2, 3]]]))


@pytest.mark.parametrize(
    ("name", "right_of_it", "below_it"),
    [("axial", [-1, 0, 0], [0, -1, 0]), ("coronal", [-1, 0, 0], [0, 0, -1]), ("sagittal", [0, -1, 0], [0, 0, -1])],
)
def test_pictures_face_as_radiologists_expect(name, right_of_it, below_it):
    plane = plane_through(name, np.array([3.0, 4, 5]), BOX, 2.0)
    at = plane.to_pixels(np.array([3.0, 4, 5]))
    assert_allclose(plane.to_pixels(np.array([3.0, 4, 5]) + right_of_it) - at, [0.5, 0])
    assert_allclose(plane.to_pixels(np.array([3.0, 4, 5]) + below_it) - at, [0, 0.5])


@pytest.mark.parametrize("name", list(AXES))
def test_plane_spans_the_box_and_passes_through_the_point(name):
    plane = plane_through(name, np.array([3.0, 4, 5]), BOX, 2.0)
    rows, columns = plane.shape
    last = plane.origin + (columns - 1) * plane.right + (rows - 1) * plane.down
    lower, upper = np.minimum(plane.origin, last), np.maximum(plane.origin, last)
    axis = AXES[name]
    assert lower[axis] == upper[axis] == [3.0, 4, 5][axis]
    others = [m for m in range(3) if m != axis]
    assert_allclose(lower[others], BOX[0][others])
    assert_allclose(upper[others], BOX[1][others])


@pytest.mark.parametrize(
    "seen_through", [None, RigidTransform.about(np.ones(3), np.array([0.1, 0.2, -0.3]), np.arange(3.0))]
)
@pytest.mark.parametrize("name", list(AXES))
def test_linear_image_is_sampled_exactly_on_an_oblique_grid(name, seen_through):
    turn = RigidTransform.about(np.zeros(3), np.array([0.3, -0.2, 0.5]), np.zeros(3)).matrix
    affine = turn @ np.diag([-2.5, 2.0, 3.0, 1.0])
    affine[:3, 3] = affine[:3, :3] @ [-19.5, -17.5, -14.5]
    grid = Grid((40, 36, 30), affine)
    slope = np.array([3.0, -2.0, 5.0])
    image = Volume((grid.points() @ slope).astype(np.float32), grid.ras_from_ijk)
    assert_allclose(box_of(grid)[0], -box_of(grid)[1])
    plane = plane_through(name, np.array([1.0, 2, 3]), (np.full(3, -8.0), np.full(3, 8.0)), 1.0)
    picture = sample(image, plane, seen_through, fill=np.nan)
    r, c = np.mgrid[: plane.shape[0], : plane.shape[1]]
    points = (plane.origin + r[..., None] * plane.down + c[..., None] * plane.right).reshape(-1, 3)
    expected = (points if seen_through is None else seen_through(points)) @ slope
    assert_allclose(picture.ravel(), expected, atol=2e-3)


def test_outside_the_image_is_filled():
    image = Volume(np.zeros((5, 5, 5), dtype=np.float32), np.eye(4))
    assert (sample(image, plane_through("axial", np.array([0.0, 0, 9]), BOX, 5.0)) == -1000).all()


@pytest.mark.parametrize("height", [-9.0, 0.0, 3.7])
def test_cube_is_cut_in_a_square(height):
    plane = plane_through("axial", np.array([0.0, 0, height]), BOX, 2.0)
    lines = section(CUBE, plane)
    length = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).sum() * 2.0
    assert_allclose(length, 80.0, rtol=1e-6)
    assert_allclose(lines.reshape(-1, 2).min(axis=0), plane.to_pixels(np.array([10.0, 10, 0])))
    assert_allclose(lines.reshape(-1, 2).max(axis=0), plane.to_pixels(np.array([-10.0, -10, 0])))


def test_plane_that_misses_a_surface_cuts_nothing():
    assert section(CUBE, plane_through("axial", np.array([0.0, 0, 11]), BOX, 2.0)).shape == (0, 2, 2)


def test_sphere_is_cut_in_the_circle_of_pythagoras():
    plane = plane_through("coronal", np.array([0.0, 3, 0]), BOX, 0.5)
    curve = ellipse(np.zeros(3), 5 * np.eye(3), plane)
    radius = 0.5 * np.linalg.norm(curve - plane.to_pixels(np.zeros(3)), axis=1)
    assert_allclose(radius, 4.0)


@pytest.mark.parametrize("name", list(AXES))
def test_points_of_the_ellipse_lie_on_the_turned_ellipsoid(name):
    axes = (
        np.diag([6.0, 3, 2]) @ RigidTransform.about(np.zeros(3), np.array([0.4, 0.7, -0.2]), np.zeros(3)).matrix[:3, :3]
    )
    centre = np.array([1.0, 2, 3])
    plane = plane_through(name, centre + 0.5, BOX, 1.0)
    curve = ellipse(centre, axes, plane)
    points = plane.origin + curve[:, :1] * plane.right + curve[:, 1:] * plane.down - centre
    weights = points @ axes.T / np.sum(axes**2, axis=1)
    assert_allclose(np.sum(weights**2, axis=1), 1.0)


def test_ellipsoid_that_the_plane_misses_is_not_drawn():
    assert ellipse(np.zeros(3), 5 * np.eye(3), plane_through("axial", np.array([0.0, 0, 5.1]), BOX, 1.0)) is None


def test_one_slice_passes_through_the_nodule():
    positions, start = slice_positions(7.3, -100.0, 100.0, 40)
    assert positions[start] == 7.3
    assert_allclose(np.diff(positions), 5.0)
    assert positions[0] >= -100 > positions[0] - 5
    assert positions[-1] <= 100 < positions[-1] + 5


def test_nodule_beyond_the_image_shows_the_nearest_slice():
    positions, start = slice_positions(500.0, 0.0, 80.0, 40)
    assert start == len(positions) - 1
    assert positions[start] == 80.0
