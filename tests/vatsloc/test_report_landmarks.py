"""How deep the nodule lies, and how far from what the eye can find, which gas must lie before."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from vatsloc.formats.meshes import Surface
from vatsloc.report.landmarks import depth_below, moved_by, surface_landmarks

CORNERS = np.array([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)])
QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
TRIANGLES = np.concatenate([QUADS[:, [0, 1, 2]], QUADS[:, [0, 2, 3]]])


def box(lower, upper):
    middle, half = (np.add(upper, lower)) / 2, (np.subtract(upper, lower)) / 2
    return Surface(middle + half * CORNERS, TRIANGLES)


def test_depth_below_a_surface_is_signed_and_names_the_nearest_point():
    # A triangle in the plane x = 10 that looks along +x: the lung is on its -x side.
    surface = Surface(np.array([[10.0, -50, -50], [10, 50, -50], [10, 0, 50]]), np.array([[0, 1, 2]]))
    depth, nearest = depth_below(surface, np.array([4.0, 1, 2]))
    assert_allclose(depth, 6.0)
    assert_allclose(nearest, [10, 1, 2])
    assert_allclose(depth_below(surface, np.array([13.0, 1, 2]))[0], -3.0)
    assert depth_below(Surface(np.zeros((5, 3)), np.empty((0, 3), dtype=int)), np.zeros(3)) == (None, None)


def test_nearest_edge_comes_first_and_those_at_the_wall_are_not_visible():
    # The lung fell 20 mm from the front and 12 mm from below; behind and above it still touches the wall.
    tips = np.array([[40.0, 0, 0], [-40, 0, 0], [0, 50, 0], [0, -50, 0], [0, 0, 60], [0, 0, -60]])
    lung = Surface(tips, np.array([[a, b, c] for a in (0, 1) for b in (2, 3) for c in (4, 5)]))
    wall = box([-50, -50, -72], [50, 70, 60])
    foot = np.array([20.0, 25, 0])
    marks = {mark.name: mark for mark in surface_landmarks(lung, wall, foot)}
    assert_allclose(marks["anterior edge at that height"].at_ras, [0, 50, 0])
    seen = {name for name, mark in marks.items() if mark.visible}
    assert seen == {"anterior edge at that height", "lowest edge"}
    away = [mark.away_mm for mark in marks.values()]
    assert away == sorted(away)
    for mark in marks.values():
        assert_allclose(mark.away_mm, np.linalg.norm(mark.at_ras - foot))


def test_motion_is_told_by_value_and_sign_the_longest_way_first() -> None:
    assert moved_by(np.zeros(3), np.array([-22.0, 0.2, 5.1])) == "23 mm: 22 to the left, 5 to the head"
    assert (
        moved_by(np.array([1.0, 2, 3]), np.array([3.0, -7, 0])) == "10 mm: 9 to the back, 3 to the feet, 2 to the right"
    )
    assert moved_by(np.ones(3), np.ones(3)) == "0 mm"
