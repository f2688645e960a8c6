"""The sheet along which a lung parted, from keypoints that moved otherwise on its sides and from gas along it."""

from __future__ import annotations

import numpy as np
import pytest

from vatsloc.workflow.fissures import Fissure, Sheet, _Scene, find_fissure, mapped, smooth_map

HILUM = np.array([50.0, 10.0, -100.0])
TRUE = Sheet(HILUM, np.array([0.9, 0.1, 6.0, 4.0, -3.0, 2.0]))
LUNG_MM = np.array([50.0, 80.0, 100.0])


def _scene(jump_mm: float, seed: int = 1, count: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Keypoints, their motion (collapse towards the hilum, lobes sliding by a jump, 5 % wrong) and gas on the sheet."""
    rng = np.random.default_rng(seed)
    points = HILUM + rng.uniform(-1, 1, (count, 3)) * LUNG_MM
    d = points - HILUM
    motion = -0.25 * d + 0.0008 * d[:, [1, 2, 0]] * d[:, [0, 0, 1]] + rng.normal(0, 0.8, d.shape)
    motion[TRUE.distance(points) < 0] += jump_mm * np.array([0.2, -0.5, 0.85])
    wrong = rng.random(count) < 0.05
    motion[wrong] += rng.normal(0, 12, (int(wrong.sum()), 3))
    gas = HILUM + rng.uniform(-1, 1, (4000, 3)) * LUNG_MM
    gas = gas[np.abs(TRUE.distance(gas)) < 2.0]
    return points, motion, gas


def test_keypoints_and_gas_tell_the_sheet() -> None:
    points, motion, gas = _scene(15.0)
    found = find_fissure(points, motion, gas, HILUM, 2000)
    assert found is not None
    assert found.evidence == ("keypoints", "gas")
    clear = np.abs(TRUE.distance(points)) > 4.0
    same = (found.sheet.distance(points) > 0) == (TRUE.distance(points) > 0)
    assert same[clear].mean() > 0.98
    assert found.gas_share > 0.95


def test_a_lung_in_one_piece_gives_no_evidence() -> None:
    points, motion, _ = _scene(0.0)
    found = find_fissure(points, motion, np.zeros((0, 3)), HILUM, 5000)
    assert found is None or found.evidence == ()


def test_gas_all_over_the_lung_is_no_evidence() -> None:
    points, motion, _ = _scene(15.0)
    gas = HILUM + np.random.default_rng(2).uniform(-1, 1, (300, 3)) * LUNG_MM
    found = find_fissure(points, motion, gas, HILUM, 5000)
    assert found is not None
    assert found.evidence == ("keypoints",)


def test_few_keypoints_tell_nothing() -> None:
    points, motion, gas = _scene(15.0, count=30)
    assert find_fissure(points, motion, gas, HILUM, 0) is None


@pytest.mark.parametrize(
    ("fissure", "evidence"),
    [
        (Fissure(TRUE, 0.95, 40, 0.45, 400), ("keypoints", "gas")),
        (Fissure(TRUE, 0.96, 40, 0.45, 400), ("gas",)),
        (Fissure(TRUE, 0.76, 39, 0.45, 400), ()),
        (Fissure(TRUE, 0.75, 39, 0.45, 400), ("keypoints",)),
        (Fissure(TRUE, 0.75, 40, 0.44, 400), ("keypoints",)),
        (Fissure(TRUE, 0.95, 40, 0.44, 400), ()),
        (Fissure(TRUE, 0.95, 60, 0.45, 2000), ("keypoints", "gas")),
        (Fissure(TRUE, 0.75, 59, 0.45, 2000), ("keypoints",)),
    ],
)
def test_evidence_has_limits(fissure: Fissure, evidence: tuple[str, ...]) -> None:
    assert fissure.evidence == evidence


@pytest.mark.parametrize(
    ("cost_share", "gas_share", "most_misfit"),
    [(0.75, 0.67, 1.0), (0.76, 0.67, 0.95), (0.75, 0.66, 0.88), (0.95, 0.45, 0.88)],
)
def test_the_weaker_the_evidence_the_more_hold_out_has_to_say(
    cost_share: float, gas_share: float, most_misfit: float
) -> None:
    assert Fissure(TRUE, cost_share, 40, gas_share, 400).most_misfit == most_misfit


def test_a_sheet_is_a_distance_for_planes_and_positive_above() -> None:
    plane = Sheet(HILUM, np.array([1.0, 0.0, 5.0, 0.0, 0.0, 0.0]))
    above = HILUM + np.array([[0.0, 0.0, 0.0], [7.0, 0.0, 5.0], [0.0, -5.0, 0.0]])
    np.testing.assert_allclose(plane.distance(above), np.array([5.0, 10.0, 0.0]) / np.sqrt(2), atol=1e-12)


def test_a_bowed_sheet_bulges_by_its_numbers_at_60_mm() -> None:
    bowed = Sheet(HILUM, np.array([0.0, 0.0, 5.0, 4.0, -2.0, 3.0]))
    at = HILUM + np.array([[0.0, 0, 0], [60, 0, 0], [0, 60, 0], [60, -60, 0]])
    # 4 (u^2 - 1/2) - 2 (v^2 - 1/2) + 3 u v, and 5 mm below the hilum
    np.testing.assert_allclose(bowed.distance(at), np.array([-1.0, 3.0, -3.0, -2.0]) + 5, atol=1e-12)


def test_keypoints_on_either_side_are_told_apart_at_the_sheet_itself() -> None:
    """Two motions that part at a plane cost nothing, although keypoints lie half a millimetre from it."""
    rng = np.random.default_rng(7)
    side = np.repeat([1.0, -1.0], 60)
    points = HILUM + np.column_stack([rng.uniform(-50, 50, (120, 2)), 0.5 * side])
    motion = np.outer(side, [0.0, 0.0, 8.0])
    scene = _Scene(points, motion, np.zeros((0, 3)), HILUM)
    plane, lower = np.zeros(6), np.array([0.0, 0.0, 2.0, 0, 0, 0])
    assert scene.motion_cost(plane) < 1e-3
    assert scene.motion_cost(lower) == np.inf  # all of them lie above


def test_a_smooth_map_is_followed_and_strays_are_not() -> None:
    rng = np.random.default_rng(4)
    points = rng.uniform(-60, 60, (300, 3))
    true = 0.2 * points + 0.001 * points[:, [0]] * points + 3.0
    wrong = true.copy()
    wrong[::10] += 25.0
    told = mapped(smooth_map(points, wrong), points)
    assert np.linalg.norm(told - true, axis=1).max() < 1.0


def test_gas_that_a_cut_explains_is_taken_off() -> None:
    found = Fissure(TRUE, 0.5, 60, 0.75, 300)
    assert found.unexplained(False) == pytest.approx(0.2)
    assert found.unexplained(True) == pytest.approx(0.05)
    assert Fissure(TRUE, 0.5, 0, 0.0, 0).unexplained(False) == 0
