"""The run's check of itself: a carried CT beside a scan, its gates on both sides, and what it widens."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from poro.mesh import TetMesh, stuff_level_set
from registration.maps.rigid import RigidTransform
from registration.verification import LeftOver
from registration.volume import Array, Mask, Volume
from tests.registration.scenes import image_of, make_pattern, oriented
from vatsloc.imaging.cbct import PreparedCbct, prepare_cbct
from vatsloc.maps import MeshMap
from vatsloc.workflow.check import Checks, check_gates, compare, worst_mm
from vatsloc.workflow.settings import GateSettings
from vatsloc.workflow.uncertainty import widened

CENTRE = np.array([10.0, -5.0, 30.0])
AROUND = RigidTransform.about(CENTRE, np.array([0.1, 0.0, -0.15]), np.array([20.0, -8.0, 12.0]))
PATTERN = make_pattern(5)


@pytest.fixture(scope="module")
def ball() -> TetMesh:
    """Ball of 40 mm about CENTRE."""
    return stuff_level_set(lambda x: 40.0 - np.linalg.norm(x - CENTRE, axis=-1), CENTRE - 43, CENTRE + 43, 10.0)


@pytest.fixture(scope="module")
def scan(ball: TetMesh) -> tuple[PreparedCbct, Mask]:
    """The pattern as a cone-beam CT shows it after AROUND, and the ball's voxels there."""
    grid = oriented("LPS", (52, 52, 52), 2.0, AROUND(CENTRE[None])[0])
    image = image_of(lambda p: PATTERN(AROUND.inverse()(p)), grid)
    inside = np.linalg.norm(grid.points() - AROUND(CENTRE[None])[0], axis=-1) < 40
    return prepare_cbct(image), Mask(inside, grid.ras_from_ijk)


def carried(ball: TetMesh, off: Array) -> MeshMap:
    return MeshMap(ball, AROUND(ball.points) + off, AROUND)


def left(n: int, looked_for: int, vector: tuple[float, float, float]) -> LeftOver:
    points = np.random.default_rng(0).uniform(-30, 30, (n, 3))
    return LeftOver(points, np.tile(np.array(vector), (n, 1)), looked_for)


@pytest.mark.parametrize("off", [(0.0, 0.0, 0.0), (5.0, 0.0, -4.0)])
def test_a_map_that_is_off_is_found_to_be(
    ball: TetMesh, scan: tuple[PreparedCbct, Mask], off: tuple[float, float, float]
) -> None:
    ct = image_of(PATTERN, oriented("RAS", (60, 60, 60), 2.0, CENTRE))
    found = compare(ct, *scan, carried(ball, np.array(off)))
    assert found.recognized_share > 0.5
    assert_allclose(found.shift, off, atol=0.2)
    assert worst_mm(found) == pytest.approx(np.linalg.norm(off), abs=0.6)


def test_another_patient_is_not_recognized(ball: TetMesh, scan: tuple[PreparedCbct, Mask]) -> None:
    other = image_of(make_pattern(50), oriented("RAS", (60, 60, 60), 2.0, CENTRE))
    assert compare(other, *scan, carried(ball, np.zeros(3))).recognized_share < 0.1
    empty = Mask(np.zeros_like(scan[1].inside), scan[1].ras_from_ijk)
    assert compare(other, scan[0], empty, carried(ball, np.zeros(3))).looked_for == 0


def test_each_gate_stands_on_its_own_part_and_on_both_sides_of_its_limit() -> None:
    limits = GateSettings(max_left_over_mm=4.0, min_recognized=0.15)
    near, far = left(20, 100, (0, 3.9, 0)), left(15, 100, (0, 0, 4.1))
    gates = check_gates(Checks(phase1=near, chain=far), limits)
    assert list(gates) == ["check_phase1", "recognized_phase1", "check", "recognized"]
    assert gates["check_phase1"].value == pytest.approx(3.9)
    assert gates["check"].value == pytest.approx(4.1)
    assert [gates[name].ok for name in gates] == [True, True, False, True]
    assert gates["recognized_phase1"].value == 0.2
    assert gates["recognized"].value == 0.15
    gates = check_gates(Checks(phase1=far, chain=left(14, 100, (0, 0, 0))), limits)
    assert [gates[name].ok for name in gates] == [False, True, True, False]
    assert "inflated" in gates["check_phase1"].says
    assert "deflated" in gates["recognized"].says


def test_nothing_recognized_passes_no_gate() -> None:
    gates = check_gates(Checks(left(0, 50, (0, 0, 0)), left(0, 0, (0, 0, 0))), GateSettings())
    assert not any(gate.ok for gate in gates.values())


def test_one_stray_keypoint_is_not_the_worst() -> None:
    steady = left(40, 50, (1, 0, 0))
    vectors = steady.vectors.copy()
    vectors[7] = (30, 0, 0)
    assert worst_mm(LeftOver(steady.points, vectors, 50)) == pytest.approx(1.0)
    vectors[steady.points[:, 0] > 10] = (6, 0, 0)
    assert worst_mm(LeftOver(steady.points, vectors, 50)) == pytest.approx(6.0)


def test_run_json_tells_both_parts_in_lps() -> None:
    told = Checks(left(20, 100, (1, 2, 3)), left(10, 40, (-4, 0, 1))).entry(np.zeros(3), np.full(3, 500.0))
    assert told["phase1"]["looked_for"] == 100
    assert (told["chain"]["recognized"], told["chain"]["looked_for"]) == (10, 40)
    assert_allclose(told["phase1"]["shift_lps_mm"], [-1, -2, 3])
    assert_allclose(told["phase1"]["at_nodule_lps_mm"], [-1, -2, 3])
    assert told["chain"]["median_mm"] == pytest.approx(17**0.5)
    assert np.isnan(told["chain"]["at_nodule_mm"])  # nothing recognized about it


def test_an_ellipsoid_widens_only_where_it_does_not_hold_what_is_left() -> None:
    narrow = np.diag([4.0, 1.0, 1.0])
    turned = np.array([[0.8, 0.6, 0], [-0.6, 0.8, 0], [0, 0, 1]])
    oblique = turned @ narrow @ turned.T
    vectors = np.array([turned @ [5.5, 0, 0], turned @ [0, 5.5, 0], [np.nan] * 3])
    wide = widened(np.array([oblique] * 3), vectors)
    assert_allclose(wide[0], oblique)  # 5.5 mm along the axis of 2 mm: 7.6 of 7.8
    assert_allclose(wide[1], oblique + np.outer(vectors[1], vectors[1]))
    assert_allclose(wide[2], oblique)
    assert vectors[1] @ np.linalg.solve(wide[1], vectors[1]) < 1


def test_a_flat_image_is_not_recognized(ball: TetMesh, scan: tuple[PreparedCbct, Mask]) -> None:
    flat = Volume(np.full((60, 60, 60), -850, np.float32), oriented("RAS", (60, 60, 60), 2.0, CENTRE).ras_from_ijk)
    found = compare(flat, *scan, carried(ball, np.zeros(3)))
    assert found.looked_for > 20
    assert found.recognized_share == 0
