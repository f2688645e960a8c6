"""Every kind of border of a collapsed lung: told apart, with the confidence and the normals that belong to it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from registration.volume import Array, Mask, Volume
from tests.vatsloc.ball_scene import ball_of, cbct, grid_about
from vatsloc.imaging.airways import TrackedAirways
from vatsloc.imaging.pleura import Pneumothorax
from vatsloc.imaging.surface import Border, SurfacePoints, deflated_surface

CENTRE = np.array([5.0, -10.0, 20.0])
RADIUS_MM = 28.0
LIMIT_HU, CONTRAST_HU = -850.0, 300.0


def halves(x: Array) -> tuple[Array, Array, Array]:
    """Above the middle, to the right of it, in front of it."""
    return x[..., 2] > CENTRE[2], x[..., 0] > CENTRE[0], x[..., 1] > CENTRE[1]


@pytest.fixture(scope="module")
def scene() -> tuple[Pneumothorax, SurfacePoints]:
    """A ball of lung. Above: air, and on the right a second piece of lung beyond it. Below: soft tissue, against lung
    of -700 HU (right, front), against such lung with a film of air under its skin (right, back), against dense lung
    (left).
    """
    grid = grid_about(CENTRE, 64, 1.5)
    x = grid.points()
    ball, space = ball_of(grid, CENTRE, RADIUS_MM), ball_of(grid, CENTRE, RADIUS_MM + 18.0)
    above, right, front = halves(x)
    second = above & right & (x[..., 2] > CENTRE[2] + RADIUS_MM + 6.0) & space
    air = above & space & ~ball & ~second
    hu = np.where(air, -1000.0, 40.0)
    hu[ball | second] = -700.0
    skin = np.linalg.norm(x - CENTRE, axis=-1) > RADIUS_MM - 8.0
    hu[ball & ~above & right & ~front & skin] = -850.0
    hu[ball & ~above & ~right] = -100.0
    image = Volume(hu.astype(np.float32), grid.ras_from_ijk)
    lung, gas = Mask(ball | second, grid.ras_from_ijk), Mask(air, grid.ras_from_ijk)
    tracked = TrackedAirways(np.zeros(grid.shape, bool), np.zeros(3), 0.0, 0.0)
    whole = Mask(lung.inside | air, grid.ras_from_ijk)
    found = Pneumothorax(gas, lung, whole, image, LIMIT_HU, CONTRAST_HU, 50.0, 90.0, tracked)
    surface = deflated_surface(found, cbct(image).field)
    on_ball = np.abs(np.linalg.norm(surface.points - CENTRE, axis=1) - RADIUS_MM) < 2.5
    return found, SurfacePoints(
        *(v[on_ball] for v in (surface.points, surface.normals, surface.confidence, surface.border))
    )


def where(points: Array) -> dict[str, Array]:
    """Points well inside each part of the ball's border."""
    unit = (points - CENTRE) / np.linalg.norm(points - CENTRE, axis=1, keepdims=True)
    right, front, up = unit[:, 0] > 0.25, unit[:, 1] > 0.25, unit[:, 2]
    left, back = unit[:, 0] < -0.25, unit[:, 1] < -0.25
    return {
        "air": (up > 0.3) & (unit[:, 0] < -0.1),
        "fissure": (up > 0.85) & (unit[:, 0] > 0.15),
        "contact": (up < -0.3) & right & front,
        "film": (up < -0.3) & right & back,
        "dense": (up < -0.3) & left,
    }


@pytest.mark.parametrize(
    ("part", "kind", "confidence"),
    [
        ("air", Border.AIR, 1.0),
        ("fissure", Border.FISSURE, 1.0),
        ("contact", Border.CONTACT, 0.3),
        ("film", Border.CONTACT, 0.05),
        ("dense", Border.DENSE, 0.1),
    ],
)
def test_each_border_is_what_lies_outside_of_it(
    scene: tuple[Pneumothorax, SurfacePoints], part: str, kind: Border, confidence: float
) -> None:
    _, surface = scene
    here = where(surface.points)[part]
    assert here.sum() >= 10
    assert (surface.border[here] == kind).mean() > 0.95
    assert np.median(surface.confidence[here]) == pytest.approx(confidence)
    assert (np.abs(surface.confidence[here] - confidence) < 1e-9).mean() > 0.85


def test_points_and_normals_are_those_of_the_ball(scene: tuple[Pneumothorax, SurfacePoints]) -> None:
    _, surface = scene
    off = np.linalg.norm(surface.points - CENTRE, axis=1) - RADIUS_MM
    cosine = np.einsum("nd,nd->n", surface.normals, surface.points - CENTRE) / (off + RADIUS_MM)
    for part, here in where(surface.points).items():
        assert abs(np.median(off[here])) < 0.6, part
        assert np.percentile(cosine[here], 10) > 0.95, part


def test_an_edge_that_no_image_shows_counts_half(scene: tuple[Pneumothorax, SurfacePoints]) -> None:
    found, _ = scene
    flat = Volume(np.full_like(found.image.hu, -700.0), found.image.ras_from_ijk)
    training_only = Pneumothorax(
        found.air, found.lung, found.space, flat, LIMIT_HU, CONTRAST_HU, 50.0, 90.0, found.airways
    )
    surface = deflated_surface(training_only, cbct(flat).field)
    assert set(surface.border) == {Border.AIR, Border.FISSURE, Border.CONTACT}
    expected = np.where(surface.border == Border.CONTACT, 0.15, 0.5)
    assert_allclose(surface.confidence, expected)


def test_what_was_not_seen_three_millimetres_about_is_left_out(scene: tuple[Pneumothorax, SurfacePoints]) -> None:
    found, _ = scene
    plane = CENTRE[1] + 4.0
    usable = found.image.grid.points()[..., 1] < plane
    points = deflated_surface(found, cbct(found.image, usable).field).points
    assert points[:, 1].max() < plane - 1.0
    assert points[:, 1].max() > plane - 6.0
