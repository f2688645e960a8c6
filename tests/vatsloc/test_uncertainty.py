"""Uncertainty of a point: the images' where they placed it, the model's where they did not, never less than a keypoint
nearby allows."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from poro.mesh import TetMesh, stuff
from registration.correspondences import Correspondences
from registration.maps.rigid import RigidTransform
from vatsloc.workflow.uncertainty import (
    BLOCK_REACH_MM,
    KEYPOINT_MM,
    LEAST_MM,
    MODEL_ALONE_MM,
    NEAREST_BLOCKS,
    PER_BLOCK_MISFIT,
    PER_BLOCK_MM,
    PER_CONTRADICTION,
    SHEET_FACTOR,
    block_sigma_mm,
    correspondence_sigma_mm,
    covariance,
    radius95,
    scatter,
)

QUANTILE = np.sqrt(7.814728)  # of chi-squared with three degrees of freedom, 95 %


@dataclass
class Scene:
    """A ball of a lung that stays where it is, whose fit knows its only parameter to 2 mm along x."""

    mesh: TetMesh
    seen: Any = None
    disagreement_mm: Any = None
    keypoints: Any = None
    missed: Any = 0.0
    ensemble: Any = field(default_factory=lambda: np.zeros((0, 0, 3)))
    blocks: Any = None
    parted: Any = None
    fissure: Any = None
    moved: Any = 0.0

    @property
    def pose(self) -> Any:
        still = RigidTransform.identity()
        return SimpleNamespace(
            mesh_inf=self.mesh,
            points_inf=self.mesh.points,
            mesh_ct=self.mesh,
            inf_from_ct_rigid=still,
            rigid=object(),
        )

    @property
    def collapse(self) -> Any:
        n = len(self.mesh.points)
        along_x = np.zeros((n, 3, 1))
        along_x[:, 0] = 1.0
        fit = SimpleNamespace(sensitivity=along_x, covariance=np.array([[4.0]]), surface_rms_mm=9, keypoint_rms_mm=9)
        found = () if self.keypoints is None else Correspondences.of(self.keypoints, self.keypoints + self.missed)
        model = SimpleNamespace(
            ensemble=self.ensemble, correspondences=found, refinements=() if self.keypoints is None else ("tried",)
        )
        corrected = SimpleNamespace(seen=self.seen, disagreement_mm=self.disagreement_mm)
        return SimpleNamespace(
            def_from_inf_rigid=RigidTransform.about(np.zeros(3), np.zeros(3), np.zeros(3)),
            residual=None if self.seen is None else corrected,
            model=model,
            system=SimpleNamespace(mesh=self.mesh),
            fit=fit,
            mesh_before=self.mesh,
            mesh_after=self.mesh,
            points_after=self.mesh.points + self.moved,
            refinement=None if self.blocks is None else SimpleNamespace(followed=self.blocks),
            parted=self.parted,
            fissure=self.fissure,
        )

    def covariance(self, *points: list[float]) -> Any:
        at = np.array(points)
        return covariance(self.pose, self.collapse, at, at)


@pytest.fixture
def ball() -> TetMesh:
    affine = np.diag([4.0, 4.0, 4.0, 1.0])
    affine[:3, 3] = -40
    x = np.stack(np.meshgrid(*3 * [np.arange(21)], indexing="ij"), axis=-1) * 4.0 - 40
    return stuff(np.linalg.norm(x, axis=-1) < 36, affine, 14.0)


def test_without_images_inside_the_model_is_as_unsure_as_it_was_measured_to_be(ball: TetMesh) -> None:
    expected = np.diag([4.0, 0, 0]) + MODEL_ALONE_MM**2 * np.eye(3)
    assert_allclose(Scene(ball).covariance([0, 0, 0], [10, 0, 0]), [expected, expected], atol=1e-9)
    assert_allclose(radius95(Scene(ball).pose, Scene(ball).collapse), QUANTILE * np.sqrt(20), rtol=1e-9)


def test_where_registrations_placed_the_tissue_their_disagreement_counts(ball: TetMesh) -> None:
    right = ball.points[:, 0] > 0
    scene = Scene(ball, seen=right, disagreement_mm=np.full(len(ball.points), 2.0))
    (placed, guessed) = scene.covariance([25, 0, 0], [-25, 0, 0])
    assert_allclose(placed, 1.5 * np.eye(3), atol=1e-9)
    assert_allclose(guessed, np.diag([20.0, 16, 16]), atol=1e-9)


def test_nothing_is_surer_than_the_keypoints_about_it_allow(ball: TetMesh) -> None:
    n = len(ball.points)
    keypoints = np.array([[-20.0, 0, 0], [-20.0, 4, 0]])
    scene = Scene(ball, np.ones(n, bool), np.zeros(n), keypoints=keypoints)
    near, far = scene.covariance([-20, 0, 0], [20, 0, 0])
    assert_allclose(near, 0.5 * np.eye(3), atol=1e-9)
    assert_allclose(far, (0.15 * 32) ** 2 * np.eye(3), atol=1e-9)
    missed = Scene(
        ball, np.ones(n, bool), np.zeros(n), keypoints=keypoints, missed=np.array([[2.0, 0, 0], [0, 0, 4.0]])
    )
    near, far = missed.covariance([-20, 0, 0], [20, 0, 0])
    assert_allclose(near, (1.5 * 3) ** 2 * np.eye(3), atol=1e-9)
    assert_allclose(far, (1.5 * 3 + 0.15 * 32) ** 2 * np.eye(3), atol=1e-9)


def test_sigma_grows_with_misfit_and_beyond_reach_with_distance() -> None:
    distances, misfits = np.array([0.0, 8.0, 28.0, 0.0]), np.array([0.5, 0.5, 0.5, 2.0])
    assert_allclose(correspondence_sigma_mm(distances, misfits), [0.75, 0.75, 0.75 + 0.15 * 20, 3.0])


def test_tissue_is_no_surer_than_the_registration_that_matched_the_keypoints_about_it() -> None:
    assert_allclose(correspondence_sigma_mm(np.zeros(3), np.array([0.0, 0.3, 0.4])), [0.5, 0.5, 0.6])


def test_where_small_blocks_were_followed_their_distance_and_misfit_tell(ball: TetMesh) -> None:
    n = len(ball.points)
    at = np.array([[-20.0, -4, 0], [-20.0, 4, 0]])
    blocks = Correspondences.of(at + np.array([[0, 0, 1.0], [0, 0, 2.0]]), at)
    scene = Scene(ball, np.ones(n, bool), np.full(n, 9.0), keypoints=at, missed=0.5, blocks=blocks)
    near, far = scene.covariance([-20, 2, 1.5], [20, 0, 1.5])
    assert_allclose(near, (PER_BLOCK_MISFIT * 1.5) ** 2 * np.eye(3), rtol=1e-9)
    away = PER_BLOCK_MM * (40 - BLOCK_REACH_MM)
    assert_allclose(far, (PER_BLOCK_MISFIT * 1.5 + away) ** 2 * np.eye(3), rtol=1e-9)


def test_keypoints_that_a_lung_misses_although_it_followed_blocks_make_it_less_sure(ball: TetMesh) -> None:
    at = np.array([[-20.0, -4, 0], [-20.0, 4, 0]])
    blocks = Correspondences.of(at + np.array([0, 0, 0.5]), at)
    missed = np.array([[0.0, 6.0, 0.0], [2.0, 0.0, 0.0]])
    scene = Scene(ball, keypoints=at, missed=missed, blocks=blocks)
    (found,) = scene.covariance([-20, 0, 0.5])
    sigma = np.hypot(PER_BLOCK_MISFIT * 0.5, PER_CONTRADICTION * (4.0 - KEYPOINT_MM))
    assert_allclose(found, sigma**2 * np.eye(3), rtol=1e-9)
    told = replace(scene, missed=missed * KEYPOINT_MM / 4.0)
    assert_allclose(told.covariance([-20, 0, 0.5]), [(PER_BLOCK_MISFIT * 0.5) ** 2 * np.eye(3)], rtol=1e-9)


def test_blocks_of_the_other_side_of_a_sheet_tell_nothing_where_a_lung_came_apart_and_is_not_cut(ball: TetMesh) -> None:
    at = np.array([[0.0, 0, 6.0], [0.0, 0, -30.0]])
    blocks = Correspondences.of(at, at)
    sheet = SimpleNamespace(distance=lambda x: x[:, 2])
    bare, covered = (SimpleNamespace(sheet=sheet, is_bare=is_bare) for is_bare in (True, False))
    sigma = PER_BLOCK_MM * (28.0 - BLOCK_REACH_MM)
    (found,) = Scene(ball, blocks=blocks, fissure=bare).covariance([0, 0, -2])
    assert_allclose(found, sigma**2 * np.eye(3), rtol=1e-9)
    (found,) = Scene(ball, blocks=blocks, fissure=bare).covariance([0, 0, 6])
    assert_allclose(found, LEAST_MM**2 * np.eye(3), rtol=1e-9)
    middle = np.linalg.norm(at.mean(axis=0) - [0, 0, -2])
    whole = PER_BLOCK_MM * (middle - BLOCK_REACH_MM)
    for other in (Scene(ball, blocks=blocks), Scene(ball, blocks=blocks, fissure=covered)):
        assert_allclose(other.covariance([0, 0, -2])[0], whole**2 * np.eye(3), rtol=1e-9)


def test_the_nearest_blocks_alone_tell(ball: TetMesh) -> None:
    at = np.concatenate([np.tile([-20.0, 0, 0], (NEAREST_BLOCKS, 1)), np.tile([20.0, 0, 0], (NEAREST_BLOCKS, 1))])
    missed = np.repeat([[0.0, 1, 0], [0.0, 0, 3]], NEAREST_BLOCKS, axis=0)
    scene = Scene(ball, blocks=Correspondences.of(at + missed, at))
    left, right = scene.covariance([-20, 1, 0], [20, 0, 3])
    assert_allclose(left[0, 0], (PER_BLOCK_MISFIT * 1) ** 2, rtol=1e-9)
    assert_allclose(right[0, 0], (PER_BLOCK_MISFIT * 3) ** 2, rtol=1e-9)
    assert_allclose(block_sigma_mm(np.zeros(1), np.zeros(1)), [LEAST_MM])


def test_beside_a_cut_the_ellipsoid_holds_where_the_other_piece_went(ball: TetMesh) -> None:
    upper = ball.points[:, 2] > 0
    gap = np.array([3.0, 0, 20.0])
    cut = SimpleNamespace(
        fissure=SimpleNamespace(sheet=SimpleNamespace(distance=lambda x: x[:, 2])),
        pieces=SimpleNamespace(node_piece=lambda: upper.astype(int)),
    )
    moved = upper[:, None] * gap
    blocks = Correspondences.of(ball.points + moved, ball.points)
    scene = Scene(ball, blocks=blocks, parted=cut, moved=moved)
    points = np.array([[0, 0, 2.0], [0, 0, -2.0], [0, 0, 20.0]])
    found = covariance(scene.pose, scene.collapse, points, points + [[1.0], [0], [1]] * gap)
    for beside in found[:2]:
        assert gap @ np.linalg.solve(beside, gap) < QUANTILE**2
        left = beside - np.outer(SHEET_FACTOR * gap, SHEET_FACTOR * gap) / QUANTILE**2
        assert_allclose(left, left[0, 0] * np.eye(3), atol=1e-9)
    assert gap @ np.linalg.solve(found[2], gap) > QUANTILE**2
    assert gap @ np.linalg.solve(Scene(ball, blocks=blocks, moved=moved).covariance([0, 0, 2.0])[0], gap) > QUANTILE**2


def test_scatter_is_the_second_moment_of_the_other_answers(ball: TetMesh) -> None:
    members = np.zeros((2, len(ball.points), 3))
    members[0, :, 0], members[1, :, 1] = 2.0, 4.0
    scene = Scene(ball, ensemble=members)
    assert_allclose(scatter(scene.collapse, np.zeros((1, 3))), [np.diag([2.0, 8.0, 0.0])], atol=1e-9)
    assert_allclose(scatter(Scene(ball).collapse, np.zeros((1, 3))), np.zeros((1, 3, 3)))
    assert_allclose(scene.covariance([0, 0, 0]), [np.diag([22.0, 24.0, 16.0])], atol=1e-9)
