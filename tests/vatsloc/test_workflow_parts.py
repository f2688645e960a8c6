"""Small parts of the workflow by value: maps, gates, stages, settings."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from poro.errors import SolverError
from poro.mesh import TetMesh, stuff, stuff_level_set
from registration.maps.rigid import RigidTransform
from registration.volume import Grid, Mask
from vatsloc.errors import CaseError, InputRefused, NotConverged
from vatsloc.maps import MeshMap, covered, sampled
from vatsloc.workflow.gates import at_least, at_most
from vatsloc.workflow.observe import hand_placed
from vatsloc.workflow.quality import in_view
from vatsloc.workflow.settings import Settings, load_settings
from vatsloc.workflow.stages import Stages

AROUND = RigidTransform.about(np.array([5.0, 0.0, 0.0]), np.array([0.0, 0.1, -0.2]), np.array([3.0, -4.0, 12.0]))


def lattice(n: int, spacing: float, origin: tuple[float, float, float]) -> Grid:
    """n^3 voxels along RAS."""
    affine = np.diag([spacing, spacing, spacing, 1.0])
    affine[:3, 3] = origin
    return Grid((n, n, n), affine)


@pytest.fixture(scope="module")
def ball() -> TetMesh:
    """Ball of 20 mm about (10, -5, 30)."""
    centre = np.array([10.0, -5.0, 30.0])
    return stuff_level_set(lambda x: 20.0 - np.linalg.norm(x - centre, axis=-1), centre - 22, centre + 22, 6.0)


@pytest.fixture(scope="module")
def squeeze(ball: TetMesh) -> MeshMap:
    """The ball carried by AROUND and squeezed to 80 % along R about its image's centre."""
    placed = AROUND(ball.points)
    moved = placed.copy()
    moved[:, 0] += 0.2 * (placed[:, 0].mean() - placed[:, 0])
    return MeshMap(ball, moved, AROUND)


def test_mesh_map_is_exact_for_an_affine_motion_inside(squeeze: MeshMap) -> None:
    inside = np.array([[10.0, -5.0, 30.0], [18.0, -2.0, 25.0], [4.0, -12.0, 33.0]])
    placed = AROUND(inside)
    centre = AROUND(squeeze.mesh.points)[:, 0].mean()
    expected = placed + np.column_stack([0.2 * (centre - placed[:, 0]), np.zeros((3, 2))])
    np.testing.assert_allclose(squeeze(inside), expected, atol=1e-9)
    np.testing.assert_allclose(squeeze.inverse()(expected), inside, atol=1e-9)


def test_far_from_the_mesh_everything_moves_with_its_surroundings(squeeze: MeshMap) -> None:
    far = np.array([[10.0, 200.0, 30.0]])
    offset = squeeze(far) - AROUND(far)
    assert np.linalg.norm(offset) < 0.2 * 21
    np.testing.assert_allclose(offset[0, 1:], 0, atol=1e-9)


def test_sampled_map_agrees_with_the_map(squeeze: MeshMap) -> None:
    grid = Grid(
        (24, 24, 24), np.diag([2.0, 2.0, 2.0, 1.0]) + np.array([[0, 0, 0, -14], [0, 0, 0, -29], [0, 0, 0, 6], [0] * 4])
    )
    inside = covered(squeeze.mesh, grid).inside
    field = sampled(squeeze, grid)
    points = grid.points()[inside]
    np.testing.assert_allclose(points + field.vectors[inside], squeeze(points), atol=1e-4)
    still = sampled(squeeze, grid, 0.0)
    outside = grid.points()[~inside]
    np.testing.assert_allclose(outside + still.vectors[~inside], AROUND(outside), atol=1e-4)


def test_covered_voxels_have_the_volume_of_the_mesh(ball: TetMesh) -> None:
    grid = Grid(
        (50, 50, 50), np.diag([1.0, 1.0, 1.0, 1.0]) + np.array([[0, 0, 0, -15], [0, 0, 0, -30], [0, 0, 0, 5], [0] * 4])
    )
    inside = covered(ball, grid).inside
    assert inside.sum() == pytest.approx(ball.volumes.sum(), rel=0.01)
    assert not covered(ball, lattice(5, 1.0, (500, 0, 0))).inside.any()


def test_gates_know_their_side() -> None:
    assert at_most(2.0, 2.0, "x").ok
    assert not at_most(2.1, 2.0, "x").ok
    assert at_least(0.5, 0.4, "x").ok
    assert at_least(0.3, 0.4, "too small").as_json() == {"ok": False, "value": 0.3, "limit": 0.4, "says": "too small"}


def test_a_gate_without_a_number_fails() -> None:
    assert not at_most(float("nan"), 2.0, "x").ok
    assert not at_least(float("nan"), 2.0, "x").ok


def test_stages_are_timed_and_refusals_named() -> None:
    said: list[str] = []
    stages = Stages(said.append)
    with stages.stage("one"):
        pass
    with (
        pytest.raises(InputRefused, match="The stage 'two' cannot work with these images: edge_mm must be positive"),
        stages.stage("two"),
    ):
        stuff(np.ones((4, 4, 4), dtype=bool), np.eye(4), -1.0)
    for failed in (SolverError("singular"), np.linalg.LinAlgError("singular")):
        with pytest.raises(NotConverged, match=r"The stage 'two' has no answer: singular;"), stages.stage("two"):
            raise failed
    assert list(stages.seconds) == ["one"]
    assert 0 <= stages.seconds["one"] <= stages.total_seconds
    assert stages.peak_mb["one"] > 1
    stages.skip("three", "nothing to do")
    assert stages.skipped == {"three": "nothing to do"}
    assert said[-1] == "three: skipped, nothing to do"


def test_what_was_begun_is_taken_by_its_own_stage_alone_and_what_fails_is_named_by_it() -> None:
    stages, ran, gate = Stages(), [], threading.Event()

    def begun(value: int) -> int:
        assert gate.wait(10)
        ran.append((value, threading.get_ident()))
        return value

    def failing() -> int:
        raise InputRefused("no spine")

    first = stages.begin("one", "CT", lambda: begun(1))
    stages.begin("one", "deflated CBCT", lambda: begun(2))
    stages.begin("two", "CT", failing)
    with stages.stage("one", "inflated CBCT"):
        assert stages.done(lambda: 3) == 3
    assert ran == []
    gate.set()
    for image, value in (("deflated CBCT", 2), ("CT", 1)):
        with stages.stage("one", image):
            assert stages.done(lambda: 4) == value
            assert stages.done(lambda: 4) == 4
    assert first() == 1
    assert [value for value, _ in ran] == [1, 2]
    assert threading.get_ident() not in {thread for _, thread in ran}
    with pytest.raises(InputRefused, match="no spine"), stages.stage("two", "CT"):
        stages.done(lambda: 5)
    gate.clear()
    stages.begin("five", "CT", lambda: begun(8))
    stages.begin("six", "inflated CBCT", failing)
    stages.fail_early()  # nothing of it has failed yet: the second waits for the first
    gate.set()
    with stages.stage("five", "CT"):
        assert stages.done(lambda: 5) == 8
    while not stages._begun["six", "inflated CBCT"].done():
        time.sleep(0.01)
    with pytest.raises(InputRefused, match="inflated CBCT: no spine"):
        stages.fail_early()
    gate.clear()
    stages.begin("three", "", lambda: begun(6))
    stages.begin("four", "", lambda: begun(7))
    stages.forget()
    gate.set()
    with stages.stage("four"):
        assert stages.done(lambda: 8) == 8
    assert 7 not in [value for value, _ in ran]


def test_settings_file_overrides_the_preset_and_nothing_else(tmp_path: Path) -> None:
    file = tmp_path / "s.toml"
    file.write_text("[mesh]\nedge_mm = 9\n")
    fast, mine = load_settings("fast", None), load_settings("fast", file)
    assert mine.mesh.edge_mm == 9
    assert mine.mesh.model_edge_mm == fast.mesh.model_edge_mm
    assert mine.registration == fast.registration
    for table, key, value in (("mesh", "edge_mm", 900), ("leave_out", "residual_mm", -1.5)):
        file.write_text(f"[{table}]\n{key} = {value}\n")
        with pytest.raises(CaseError, match=rf"{table}\.{key}"):
            load_settings("fast", file)


@pytest.mark.parametrize("preset", ["fast", "balanced", "accurate", "auto"])
def test_every_preset_has_all_parts_switched_on(preset: str) -> None:
    tables = load_settings(preset, None).model_dump()
    switches = {f"{name}.{key}": value for name, table in tables.items() for key, value in table.items()}
    switches = {name: value for name, value in switches.items() if isinstance(value, bool)}
    assert set(switches) == {
        *("registration.on", "keypoints.on", "residual.on", "refinement.on"),
        *("model.hilum", "model.diaphragm", "model.regional", "model.correct"),
    }
    assert all(switches.values())


def test_what_a_settings_file_leaves_out_lies_within_the_bounds_of_what_it_may_say() -> None:
    assert Settings.model_validate(Settings().model_dump()) == Settings()


def test_hand_placed_points_look_away_from_the_lung() -> None:
    corners = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    for triangles in (faces, np.zeros((0, 3), dtype=int)):
        placed = hand_placed(corners, triangles)
        assert ((corners - corners.mean(axis=0)) * placed.normals).sum(axis=1).min() > 0
        np.testing.assert_allclose(np.linalg.norm(placed.normals, axis=1), 1.0)


@pytest.mark.parametrize(("out_mm", "warned", "ok"), [(0.0, False, True), (6.0, True, True), (20.0, True, False)])
def test_a_nodule_out_of_a_view_is_warned_of_and_far_out_of_it_not_to_be_trusted(
    out_mm: float, warned: bool, ok: bool
) -> None:
    view = Mask(np.ones((4, 4, 4), bool), np.diag([2.0, 2.0, 2.0, 1.0]))
    stages = Stages()
    shown = {"inflated": (view, np.array([6.0 + out_mm, 2.0, 2.0])), "deflated": (view, np.array([2.0, 2.0, 2.0]))}
    gate = in_view(shown, 10.0, stages)
    assert gate.ok is ok
    assert gate.value == pytest.approx(out_mm)
    assert [f"{out_mm:.0f} mm out of what the inflated CBCT shows" in w for w in stages.warnings] == [True] * warned
