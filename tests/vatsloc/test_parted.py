"""A lung in two pieces: each is registered with its own images, keypoints and surface, and both come back together."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from poro.mesh import TetMesh, quality, stuff
from registration.correspondences import Correspondences
from registration.volume import Array, Mask
from tests.vatsloc import run_scene as known
from vatsloc.workflow import parted as module
from vatsloc.workflow.fissures import Fissure, Parted, Sheet
from vatsloc.workflow.model_selection import Refinement
from vatsloc.workflow.parted import (
    JOINED_MM,
    _carried,
    _fitted,
    _on_pieces,
    _with_residual,
    cut_lung,
    in_pieces,
)
from vatsloc.workflow.pneumothorax import Collapse
from vatsloc.workflow.pose import ChangeOfPose
from vatsloc.workflow.residual import Residual
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import Stages

FLAT = Fissure(Sheet(known.CENTRE, np.zeros(6)), 0.5, 100, 0.9, 200)  # z of the lung's centre
BEFORE_FROM_CT = known.as_affine(known.DEF_FROM_INF_RIGID) @ known.INF_FROM_CT


ROUNDED_MM = 0.15
"""What a linear continuation beyond the one-piece mesh's border may add; the motion itself is 10 to 20 mm."""


@dataclass(frozen=True)
class Found:
    """The collapsed lung as it was segmented."""

    lung: Mask


def height(points_def: Array) -> Array:
    """Height (n,) mm above the fissure, in the CT, of points (n, 3) of the collapsed lung."""
    return np.asarray((known.DEF_FROM_CT.inverse()(points_def) - known.CENTRE)[..., 2])


def cut(edge_mm: float = 12.0) -> tuple[ChangeOfPose, Collapse]:
    """The known run with its lung cut into an upper piece 0 and a lower one 1."""
    scene = known.scene()
    pieces = cut_lung(scene.prepared, FLAT, edge_mm)
    pose = _on_pieces(scene.pose, pieces)
    before = TetMesh(BEFORE_FROM_CT(pieces.mesh.points), pieces.mesh.tets)
    keypoints = known.CENTRE + np.random.default_rng(2).uniform(-15, 15, (60, 3))
    moving = BEFORE_FROM_CT(keypoints)
    scene = scene.with_model(correspondences=Correspondences.of(known.AFTER_FROM_BEFORE(moving), moving))
    after = known.AFTER_FROM_BEFORE(before.points)
    surface = known.observed_surface(TetMesh(after, before.tets))
    found: Any = Found(scene.collapse.observed.found.lung)
    scene = scene.with_observed(mesh_before=before, surface=surface, found=found)
    return pose, replace(scene.collapse, points_after=after, parted=Parted(FLAT, pieces))


class Registered:
    """Stands in for the registration of one piece, and keeps what it was given."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, missing: tuple[int, ...] = ()) -> None:
        self.given: list[tuple[Collapse, TetMesh]] = []
        self.missing = missing
        monkeypatch.setattr(module, "residual_of_part", self._register)

    def _register(self, _prepared: Any, part: Collapse, mesh_inf: TetMesh, _settings: Settings) -> Residual | None:
        self.given.append((part, mesh_inf))
        number = len(self.given) - 1
        return None if number in self.missing else self.of(number, len(part.points_after))

    @staticmethod
    def of(number: int, nodes: int) -> Residual:
        """Piece 0 moves by 1 mm per node's number, piece 1 by 4; all of 0 and every other node of 1 were compared."""
        numbers = np.arange(nodes)
        moved = np.outer(numbers, [1.0, 0, 0] if number == 0 else [0, 4.0, 0])
        compared = (numbers % 2 == 0) | (number == 0)
        return Residual(moved, compared, compared & (numbers % 3 == 0), numbers + 10.0 * number, 0.5 - 0.2 * number)


def test_each_piece_is_registered_with_what_is_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    pose, collapse = cut()
    registered = Registered(monkeypatch)
    _with_residual(known.scene().prepared, pose, collapse, FLAT, Settings())
    assert collapse.parted is not None
    pieces, whole = collapse.parted.pieces, collapse.observed.found.lung
    lungs, keypoints, faces = [], [], []
    for number, (part, mesh_inf) in enumerate(registered.given):
        sign = 1 - 2 * number
        mesh, nodes = pieces.part(number)
        assert_array_equal(part.mesh_before.tets, mesh.tets)
        assert_array_equal(mesh_inf.tets, mesh.tets)
        assert_allclose(part.mesh_before.points, BEFORE_FROM_CT(mesh.points))
        assert_array_equal(part.points_after, collapse.points_after[nodes])
        assert_allclose(mesh_inf.points, known.INF_FROM_CT(mesh.points), atol=ROUNDED_MM)
        mine = part.model.correspondences
        assert (sign * height(mine.fixed) > 0).all()
        keypoints.append(len(mine))
        lung = part.observed.found.lung
        deep = sign * height(lung.grid.points()) > 3
        assert_array_equal(lung.inside[deep], whole.inside[deep])
        assert not lung.inside[sign * height(lung.grid.points()) < -3].any()
        lungs.append(lung.inside)
        near = part.observed.surface.points
        near = near[np.linalg.norm(near - collapse.points_after.mean(axis=0), axis=1) < 50]  # not the far ones
        assert (sign * height(near) > -6).all()  # the nearest node decides, and these are 12 mm apart
        faces.append(len(part.observed.surface.points))
    assert sum(keypoints) == len(collapse.model.correspondences)
    assert min(keypoints) > 20
    assert sum(faces) == len(collapse.observed.surface.points)
    assert_array_equal(lungs[0] | lungs[1], whole.inside)
    assert not (lungs[0] & lungs[1]).any()


def test_both_pieces_come_back_together_and_share_the_mean_where_they_are_one(monkeypatch: pytest.MonkeyPatch) -> None:
    pose, collapse = cut()
    Registered(monkeypatch)
    found = _with_residual(known.scene().prepared, pose, collapse, FLAT, Settings())
    assert collapse.parted is not None
    pieces = collapse.parted.pieces
    count = len(pieces.mesh.points)
    nodes = [pieces.part(number)[1] for number in (0, 1)]
    each = [Registered.of(number, len(mine)) for number, mine in enumerate(nodes)]
    moved, believed = np.full((2, count, 3), np.nan), np.zeros((2, count), bool)
    looked, apart = np.zeros((2, count), bool), np.zeros((2, count))
    for number in (0, 1):
        moved[number][nodes[number]] = each[number].displacement
        looked[number][nodes[number]] = each[number].compared
        believed[number][nodes[number]] = each[number].seen
        apart[number][nodes[number]] = each[number].disagreement_mm
    shared = np.isin(np.arange(count), nodes[0]) & np.isin(np.arange(count), nodes[1])
    assert 3 < shared.sum() < 0.3 * count
    together = found.residual
    assert together is not None
    assert_allclose(together.displacement, np.nanmean(moved, axis=0))
    assert_array_equal(together.compared, looked.any(axis=0))
    assert_array_equal(together.seen, believed.any(axis=0))
    assert_allclose(together.disagreement_mm, apart.max(axis=0))
    assert together.min_det == pytest.approx(0.3)
    assert_allclose(found.points_after, collapse.points_after + together.displacement)


def test_a_piece_that_cannot_be_registered_stays_and_without_either_nothing_changes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pose, collapse = cut()
    Registered(monkeypatch, missing=(1,))
    found = _with_residual(known.scene().prepared, pose, collapse, FLAT, Settings())
    assert collapse.parted is not None
    first, second = (collapse.parted.pieces.part(number)[1] for number in (0, 1))
    assert found.residual is not None
    alone = np.setdiff1d(second, first)
    assert_array_equal(found.residual.displacement[alone], 0)
    assert not found.residual.seen[alone].any()
    assert found.residual.min_det == 0.5
    Registered(monkeypatch, missing=(0, 1))
    assert _with_residual(known.scene().prepared, pose, collapse, FLAT, Settings()) is collapse
    whole = replace(collapse, parted=None)
    assert _with_residual(known.scene().prepared, pose, whole, FLAT, Settings()) is whole


def fitted(slid_mm: float, before_mm: float, fissure: Fissure = FLAT) -> tuple[ChangeOfPose, Collapse] | None:
    """A lung whose keypoints slid to either side of the fissure, and which one piece misses by `before_mm`."""
    scene, rng = known.scene(), np.random.default_rng(3)
    keypoints = known.CENTRE + rng.uniform(-18, 18, (200, 3))
    moving = BEFORE_FROM_CT(keypoints)
    apart = np.array([[slid_mm, 0, 3], [-slid_mm, 0, 3]])  # mm, of what lies above the fissure and below it
    unseen = scene.collapse.observed.surface.where(np.zeros(14, bool))
    whole = (Refinement("elastic correction", 20.0, before_mm, True),)
    told = Correspondences.of(moving + apart[(keypoints[:, 2] < known.CENTRE[2]).astype(int)], moving)
    scene = scene.with_model(correspondences=told, refinements=whole).with_observed(surface=unseen)
    settings = Settings.model_validate({"mesh": {"edge_mm": 12.0, "model_edge_mm": 14.0}})
    return _fitted(scene.prepared, scene.pose, scene.collapse, fissure, settings)


def test_a_lung_is_fitted_in_pieces_where_each_of_them_went_its_own_way_and_only_there() -> None:
    assert fitted(0.0, 0.0) is None
    found = fitted(8.0, 8.0)  # one piece can do no better
    assert found is not None
    collapse = found[1]
    assert collapse.parted is not None
    pieces = collapse.parted.pieces
    moved = collapse.points_after - BEFORE_FROM_CT(pieces.mesh.points)
    clear = np.abs(pieces.mesh.points[:, 2] - known.CENTRE[2]) > 10.0
    for number in (0, 1):
        mine = clear & (pieces.node_piece() == number)
        assert mine.sum() > 10
        assert_allclose(moved[mine], np.broadcast_to([8.0 * (1 - 2 * number), 0, 3], (mine.sum(), 3)), atol=0.4)
    assert collapse.model.refinements[0] == Refinement("elastic correction", 20.0, 8.0, True)
    assert collapse.model.refinements[1].before_mm == 8.0
    assert collapse.model.refinements[1].after_mm < 0.1


@pytest.mark.parametrize("fissure", [FLAT, replace(FLAT, cost_share=0.9), replace(FLAT, gas_share=0.5)])
def test_pieces_have_to_miss_held_out_keypoints_by_as_much_less_as_their_evidence_asks(fissure: Fissure) -> None:
    found = fitted(8.0, 8.0)
    assert found is not None
    after_mm = found[1].model.refinements[1].after_mm
    assert after_mm > 1e-4
    for share, kept in ((1.001, False), (0.999, True)):
        assert (fitted(8.0, after_mm / (share * fissure.most_misfit), fissure) is not None) is kept


def test_the_pose_moves_pieces_as_it_moved_the_whole_and_knows_what_was_seen_where() -> None:
    whole = known.scene().pose
    pose, collapse = cut()
    assert collapse.parted is not None
    points = collapse.parted.pieces.mesh.points
    assert pose.mesh_ct is collapse.parted.pieces.mesh
    assert_allclose(pose.points_inf, known.INF_FROM_CT(points), atol=ROUNDED_MM)
    far = np.linalg.norm(points[:, None] - whole.mesh_ct.points[None], axis=2)
    nearest, two = far.argmin(axis=1), np.sort(far, axis=1)[:, :2]
    clear = two[:, 1] - two[:, 0] > 1e-6  # no tie
    assert clear.mean() > 0.7
    assert 0.4 < pose.seen.mean() < 0.9
    assert pose.inversion is not None
    assert whole.inversion is not None
    assert_array_equal(pose.seen[clear], whole.seen[nearest][clear])
    assert_array_equal(pose.inversion.points_fixed[clear], whole.inversion.points_fixed[nearest][clear])
    assert_array_equal(pose.inversion.residual_mm[clear], whole.inversion.residual_mm[nearest][clear])


def test_a_motion_of_coarse_pieces_is_carried_to_fine_ones_without_crossing_the_cut() -> None:
    prepared = known.scene().prepared
    coarse, fine = (cut_lung(prepared, FLAT, edge) for edge in (14.0, 9.0))
    apart = np.array([[0.0, 0, 9.0], [0, 0, -9.0]])  # mm, of piece 0 and 1
    u = apart[coarse.node_piece()]
    carried = _carried(coarse.mesh, coarse, u, fine.mesh, fine)
    clear = np.abs(fine.mesh.points[:, 2] - known.CENTRE[2]) > 14.0
    far = np.linalg.norm((fine.mesh.points - known.CENTRE)[:, :2], axis=1) > 34.0
    for number in (0, 1):
        mine = (fine.node_piece() == number) & (clear | far)
        assert mine.sum() > 10
        assert_allclose(carried[mine], np.broadcast_to(apart[number], (mine.sum(), 3)), atol=1e-9)


BOWED = replace(FLAT, sheet=Sheet(known.CENTRE - [28.0, 0, 0], np.array([0.9, 0.1, 3.0, 4.0, -3.0, 2.0])))


def test_a_cut_lung_is_one_about_its_hilum_and_two_beyond_and_has_no_slivers() -> None:
    prepared = known.scene().prepared
    pieces = cut_lung(prepared, BOWED, 6.0)
    whole = stuff(prepared.lung_ct.inside, prepared.lung_ct.ras_from_ijk, 6.0)
    first, second = (pieces.part(number)[1] for number in (0, 1))
    shared, far = np.intersect1d(first, second), pieces.pairs[:, 0]
    hilum, points = BOWED.sheet.hilum, pieces.mesh.points
    assert len(shared) > 3
    assert (np.linalg.norm(points[shared] - hilum, axis=1) < JOINED_MM).all()
    assert (np.linalg.norm(points[far] - hilum, axis=1) >= JOINED_MM).all()
    assert_allclose(BOWED.sheet.distance(points[far]), 0, atol=0.2)
    assert 0.9 < pieces.mesh.volumes.sum() / whole.volumes.sum() < 1
    assert quality(pieces.mesh).min_dihedral > 12
    for number, sign in ((0, 1), (1, -1)):
        part, _ = pieces.part(number)
        assert (sign * BOWED.sheet.distance(part.points) > -0.5).all()


def in_one_piece(
    monkeypatch: pytest.MonkeyPatch, fissure: Fissure | None, kept: bool = True
) -> tuple[ChangeOfPose, Collapse, Stages]:
    """What `in_pieces` leaves of the known run, in which such a sheet was seen."""
    scene = known.scene().with_model(refinements=(Refinement("regional fit", 3.0, 2.0, kept),))
    monkeypatch.setattr(module, "seen_fissure", lambda *_: fissure)
    stages = Stages()
    return *in_pieces(scene.prepared, scene.pose, scene.collapse, Settings(), stages), stages


@pytest.mark.parametrize(
    ("fissure", "why"),
    [
        (None, "too few keypoints to tell pieces apart"),
        (replace(FLAT, cost_share=0.97), "two smooth maps cost 0.97 of one at keypoints"),
        (replace(FLAT, gas=10), "of 10 points of gas, 5.0 % of its border, lie along a sheet"),
        (replace(FLAT, border=4000), "90 % of 100 points of gas, 2.5 % of its border,"),
        (replace(FLAT, gas_share=0.3), "30 % of 100 points of gas"),
        (replace(FLAT, bare_mm=30.4), "half of a piece would lie over 30 mm from its own keypoints, 30 allowed"),
        (
            replace(FLAT, gas_share=0.44),
            "cost 0.50 of one at keypoints, 44 % of 100 points of gas, 50.0 % of its border, lie along a sheet",
        ),
    ],
)
def test_a_lung_without_fissures_stays_in_one_piece(
    monkeypatch: pytest.MonkeyPatch, fissure: Fissure | None, why: str
) -> None:
    pose, collapse, stages = in_one_piece(monkeypatch, fissure)
    assert pose is known.scene().pose
    assert collapse.parted is None
    assert collapse.fissure is fissure
    assert_array_equal(collapse.points_after, known.scene().collapse.points_after)
    assert why in stages.skipped[module.PIECES]


def test_where_the_model_follows_no_keypoints_no_fissure_is_looked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    _, collapse, stages = in_one_piece(monkeypatch, FLAT, kept=False)
    assert collapse.parted is None
    assert collapse.fissure is None
    assert stages.skipped[module.PIECES] == "no refinement of the model was kept"


@pytest.mark.parametrize(
    ("fissure", "why"),
    [
        (FLAT, "not predicted better by a lung"),
        (replace(FLAT, cost_share=0.9), "not predicted better by 5 % by a lung"),
        (replace(FLAT, gas_share=0.5), "not predicted better by 12 % by a lung"),
    ],
)
def test_a_cut_that_predicts_no_better_is_not_made(monkeypatch: pytest.MonkeyPatch, fissure: Fissure, why: str) -> None:
    monkeypatch.setattr(module, "_fitted", lambda *_: None)
    _, collapse, stages = in_one_piece(monkeypatch, fissure)
    assert collapse.parted is None
    assert collapse.fissure is fissure
    assert why in stages.skipped[module.PIECES]


def test_a_piece_too_thin_for_an_element_is_not_cut_off() -> None:
    beside = replace(FLAT, sheet=Sheet(known.CENTRE, np.array([0, 0, known.RADIUS_MM + 5, 0, 0, 0])))
    with pytest.raises(ValueError, match="no element"):
        cut_lung(known.scene().prepared, beside, 8.0)


@pytest.mark.parametrize("runs", [True, False])
def test_pieces_are_registered_each_for_itself_however_near_their_model_is(
    monkeypatch: pytest.MonkeyPatch, runs: bool
) -> None:
    pose, parted = cut()
    parted = replace(parted, model=replace(parted.model, refinements=(Refinement("two pieces", 3.0, 2.0, True),)))
    marked = replace(parted, points_after=parted.points_after + 1)
    monkeypatch.setattr(module, "seen_fissure", lambda *_: FLAT)
    monkeypatch.setattr(module, "_fitted", lambda *_: (pose, parted))
    monkeypatch.setattr(module, "_with_residual", lambda *_: marked)
    tables = {"residual": {"on": runs}, "leave_out": {"residual_mm": 9.0}}
    scene = known.scene().with_model(refinements=(Refinement("regional fit", 3.0, 2.0, True),))
    found = in_pieces(scene.prepared, scene.pose, scene.collapse, Settings.model_validate(tables), Stages())[1]
    assert (found is marked) is runs
    assert (found is parted) is not runs
