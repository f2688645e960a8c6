"""The sheet of a parted lung, found from keypoints and gas of the collapsed one and bent to them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from registration.correspondences import Correspondences
from registration.volume import Array
from tests.vatsloc import run_scene as known
from vatsloc.imaging.hilum import Hilum
from vatsloc.imaging.surface import Border, SurfacePoints
from vatsloc.workflow import seen_fissure as module
from vatsloc.workflow.fissures import Fissure, Sheet
from vatsloc.workflow.seen_fissure import LEAST_CLEAR, _bare_mm, _bent, _came_from, _Seen, _seen, _sides, seen_fissure

BEFORE_FROM_CT = known.as_affine(known.DEF_FROM_INF_RIGID) @ known.INF_FROM_CT
APART = np.array([[9.0, 0, 6.0], [-9.0, 0, -6.0]])  # mm, of what lies above the fissure and below it
PLANE = Sheet(known.CENTRE, np.zeros(6))
HILUM = Hilum(BEFORE_FROM_CT(known.CENTRE[None])[0], 20.0, True)


def fissure_height(points_ct: Array) -> Array:
    """Height (n,) mm of the true fissure over the plane through the lung's centre: a bow of 5 mm."""
    return np.asarray(5.0 * np.cos((points_ct - known.CENTRE)[:, 0] / 14.0) - 2.0)


def above(points_ct: Array) -> Array:
    """Height (n,) mm above the true fissure."""
    return np.asarray((points_ct - known.CENTRE)[:, 2] - fissure_height(points_ct))


def collapsed(points_ct: Array, lower: Array) -> Array:
    """Where tissue of the lower (n,) lobe, or of the upper, lies after the collapse."""
    return BEFORE_FROM_CT(points_ct) + APART[np.asarray(lower).astype(int)]


def seen(n: int = 500) -> tuple[_Seen, Array, Array]:
    """A run with n keypoints and gas on both faces of the fissure; the keypoints, and where the gas came from."""
    rng = np.random.default_rng(5)
    points = known.CENTRE + rng.uniform(-17, 17, (n, 3))
    faces = known.CENTRE + np.column_stack([rng.uniform(-17, 17, (160, 2)), np.zeros(160)])
    faces[:, 2] += fissure_height(faces)
    gas = np.concatenate([collapsed(faces, np.full(160, lower)) for lower in (False, True)])
    surface = SurfacePoints(gas, np.zeros_like(gas), np.ones(len(gas)), np.full(len(gas), Border.AIR))
    told = Correspondences.of(collapsed(points, above(points) < 0), BEFORE_FROM_CT(points))
    scene = known.scene().with_observed(surface=surface, hilum=HILUM)
    return _seen(scene.pose, scene.collapse.observed, told), points, faces


def test_keypoints_and_gas_are_read_in_the_ct() -> None:
    found, points, faces = seen()
    np.testing.assert_allclose(found.points, points, atol=1e-6)
    np.testing.assert_allclose(BEFORE_FROM_CT(found.points) + found.motion, found.fixed, atol=1e-6)
    assert len(found.air) == 2 * len(faces)


def test_a_keypoint_is_of_the_side_that_it_moves_with() -> None:
    found, points, _ = seen()
    clear, side = _sides(PLANE, found)
    assert clear.mean() > 0.9
    assert (side[clear] == np.sign(above(points))[clear]).mean() > 0.99
    whole = Correspondences.of(found.moving + 4.0, found.moving)
    assert not _sides(PLANE, replace(found, found=whole))[0].any()  # both maps are as good


def test_gas_is_carried_back_by_its_own_side() -> None:
    found, _, faces = seen()
    clear, side = _sides(PLANE, found)
    for number in (1, -1):
        back = found.in_ct(_came_from(found, clear, side, number))
        far = np.linalg.norm(back[:, None] - faces[None], axis=2).min(axis=1)
        assert len(back) > 100
        assert np.median(far) < 0.3


def test_the_sheet_bends_to_the_fissure() -> None:
    found, points, faces = seen()
    bent = _bent(PLANE, found)
    inner = np.linalg.norm(faces - known.CENTRE, axis=1) < 15
    assert np.abs(PLANE.distance(faces[inner])).mean() > 2.0
    assert np.abs(bent.distance(faces[inner])).mean() < 1.0
    wrong = [(sheet.distance(points) > 0) != (above(points) > 0) for sheet in (PLANE, bent)]
    assert wrong[0].mean() > 0.04
    assert wrong[1].mean() < wrong[0].mean() / 2


def test_a_side_with_few_clear_keypoints_bends_nothing() -> None:
    found, _, _ = seen(2 * LEAST_CLEAR - 2)
    assert _bent(PLANE, found) is PLANE
    high = replace(PLANE, shape=np.array([0.0, 0, -200, 0, 0, 0]))  # all keypoints lie below
    assert not _sides(high, found)[0].any()


def test_the_piece_that_is_told_less_says_how_far_half_of_it_lies_from_its_own_keypoints() -> None:
    found, points, _ = seen()
    nodes = known.scene().pose.mesh_ct.points
    upper, lower = points[points[:, 2] > known.CENTRE[2]], points[points[:, 2] < known.CENTRE[2]]
    one = replace(found, points=np.concatenate([upper, lower[:1]]))
    below = nodes[nodes[:, 2] <= known.CENTRE[2]]
    far = np.median(np.linalg.norm(below - lower[0], axis=1))
    assert _bare_mm(PLANE, one) == pytest.approx(far)
    assert _bare_mm(PLANE, found) < 0.5 * far
    assert _bare_mm(PLANE, replace(found, points=upper)) == np.inf
    high = replace(PLANE, shape=np.array([0.0, 0, -200, 0, 0, 0]))  # all of the lung lies below
    assert _bare_mm(high, found) == np.inf


@pytest.mark.parametrize("gas_share", [0.9, 0.1])
def test_only_what_both_support_is_bent(monkeypatch: pytest.MonkeyPatch, gas_share: float) -> None:
    found, _, _ = seen()
    flat = Fissure(PLANE, 0.5, 100, gas_share, 200)
    monkeypatch.setattr(module, "find_fissure", lambda *_given: flat)
    fissure = seen_fissure(found.pose, found.observed, found.found)
    assert fissure is not None
    assert (fissure.sheet.bend is not None) == (gas_share == 0.9)
    assert (fissure.bare_mm > 0) == (gas_share == 0.9)
    assert (fissure.cost_share, fissure.gas, fissure.gas_share, fissure.border) == (0.5, 100, gas_share, 200)
