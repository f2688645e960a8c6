"""Keypoints inside the lung in the right frames, and both cone-beam CTs on one grid."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from registration.correspondences import Correspondences
from registration.images.resample import resample_mask
from registration.volume import Array, Mask
from tests.vatsloc import ball_scene as scene
from vatsloc.maps import MeshMap
from vatsloc.workflow import keypoints as module
from vatsloc.workflow.keypoints import find_correspondences
from vatsloc.workflow.settings import KeypointSettings
from vatsloc.workflow.warped_pair import warped_pair

INFLATED = scene.placed(scene.lung_mesh(), scene.INF_FROM_CT)
BEFORE = scene.placed(scene.lung_mesh(), scene.INF_FROM_CT, scene.DEF_FROM_INF)
TRUTH = scene.collapsed(BEFORE.points)
PLANE_INF, PLANE_DEF = scene.CENTRE_INF[0] + 20.0, scene.CENTRE_DEF[2] + 18.0


@pytest.fixture
def observed() -> Any:
    """The model's mesh is another one than the lung's."""
    coarse = scene.placed(scene.lung_mesh(14.0), scene.INF_FROM_CT, scene.DEF_FROM_INF)
    return SimpleNamespace(
        model_mesh=coarse, mesh_before=BEFORE, def_from_inf_rigid=scene.DEF_FROM_INF, found=scene.pneumothorax()
    )


def half_seen() -> Any:
    """Each scan sees the lung up to a plane of its own."""
    return scene.prepared(
        scene.inflated().grid.points()[..., 0] < PLANE_INF, scene.deflated().grid.points()[..., 2] < PLANE_DEF
    )


def depth_before(points: Array) -> Array:
    return scene.RADIUS_MM - np.linalg.norm(points - scene.CENTRE_DEF, axis=1)


def test_keypoints_lie_where_the_spine_puts_them_before_the_collapse_and_where_they_went_after_it(
    observed: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "FEW", 0)
    model = 0.6 * (scene.collapsed(observed.model_mesh.points) - observed.model_mesh.points)
    found = find_correspondences(half_seen(), observed, model, KeypointSettings(reach_mm=8.0))
    assert len(found) > 70
    error = np.linalg.norm(scene.collapsed(found.moving) - found.fixed, axis=1)
    assert np.median(error) < 0.8
    assert np.percentile(error, 95) < 2.0
    assert depth_before(found.moving).min() > 0
    assert scene.DEF_FROM_INF.inverse()(found.moving)[:, 0].max() < PLANE_INF + 2.5
    assert found.fixed[:, 2].max() < PLANE_DEF + 2.5


def test_propagation_gets_both_images_in_one_frame_and_the_lung_of_each(
    observed: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    warped = scene.CENTRE_DEF + np.random.default_rng(1).uniform(-18, 18, (30, 3))
    deflated = warped + np.array([1.0, 2.0, 3.0])
    model = 0.6 * (scene.collapsed(observed.model_mesh.points) - observed.model_mesh.points)
    matched: dict[str, Any] = {}
    propagated: dict[str, Any] = {}

    def match(fixed: Any, moving: Any, fixed_region: Any, settings: Any, moving_region: Any) -> Correspondences:
        matched.update(fixed=fixed, moving=moving, settings=settings)
        matched.update(fixed_region=fixed_region, moving_region=moving_region)
        return Correspondences.of(deflated, warped, ncc=np.linspace(0.7, 0.9, 30))

    def propagate(
        fixed: Any, moving: Any, fixed_region: Any, moving_region: Any, seeds: Correspondences, settings: Any
    ) -> Correspondences:
        propagated.update(fixed=fixed, moving=moving, after=fixed_region, before=moving_region, settings=settings)
        return seeds

    monkeypatch.setattr(module, "match_keypoints", match)
    monkeypatch.setattr(module, "propagate_matches", propagate)
    monkeypatch.setattr(module, "FEW", 30)
    found = find_correspondences(half_seen(), observed, model, KeypointSettings(voxel_mm=2.0, reach_mm=9.0))
    # The model takes 60 % of an affine collapse: its inverse is affine too.
    gradient = np.eye(3) + 0.6 * (scene.SQUEEZE - np.eye(3))
    before = scene.CENTRE_DEF + (warped - scene.CENTRE_DEF - 0.6 * scene.SHIFT_MM) @ np.linalg.inv(gradient).T
    assert_allclose(found.moving, before, atol=1e-6)
    assert_allclose(found.fixed, deflated)
    assert_allclose(found.ncc, np.linspace(0.7, 0.9, 30))
    assert matched["settings"].voxel_mm == 2.0
    assert matched["settings"].reach_mm == 9.0
    assert propagated["settings"].match == matched["settings"]
    # Tissue in the region of the modelled and of the observed lung.
    for region, expanded in (
        (
            matched["moving_region"],
            lambda x: scene.CENTRE_DEF + (x - scene.CENTRE_DEF - 0.6 * scene.SHIFT_MM) @ np.linalg.inv(gradient).T,
        ),
        (matched["fixed_region"], scene.expanded),
    ):
        points = region.grid.points()[region.inside]
        assert -2.0 < depth_before(expanded(points)).min() < 1.0
    corner = propagated["moving"].grid.to_ras(np.zeros((1, 3)))
    size = (np.array(scene.inflated().hu.shape) - 1.0) * scene.SPACING_MM / 2
    assert_allclose(scene.DEF_FROM_INF.inverse()(corner)[0], scene.CENTRE_INF - size, atol=3.0)
    assert_array_equal(propagated["fixed"].hu, scene.deflated().hu)
    assert_array_equal(propagated["moving"].hu, scene.inflated().hu)
    points = propagated["before"].grid.points()[propagated["before"].inside]
    assert 1.0 < depth_before(points).min() < 4.0
    assert PLANE_INF - 4.0 < scene.DEF_FROM_INF.inverse()(points)[:, 0].max() < PLANE_INF + 2.0
    points = propagated["after"].grid.points()[propagated["after"].inside]
    assert 1.0 < depth_before(scene.expanded(points)).min() < 4.0
    assert PLANE_DEF - 4.0 < points[:, 2].max() < PLANE_DEF + 2.0
    assert points[:, 2].min() < PLANE_DEF - 30.0


@pytest.mark.parametrize("few", [30, 31])
def test_where_few_are_found_more_are_looked_for_in_all_tissue(
    observed: Any, monkeypatch: pytest.MonkeyPatch, few: int
) -> None:
    """Half of the collapsed lung was not taken for lung, as where it has lost its air."""
    found = observed.found
    half = found.lung.grid.points()[..., 0] < scene.CENTRE_DEF[0]
    observed.found = replace(found, lung=Mask(found.lung.inside & half, found.lung.ras_from_ijk))
    calls: list[tuple[Any, float]] = []
    inner = scene.CENTRE_DEF + np.random.default_rng(1).uniform(-9, 9, (30, 3))

    def propagate(fixed: Any, moving: Any, after: Any, before: Any, seeds: Any, settings: Any) -> Correspondences:
        calls.append((after, settings.match.cell_mm))
        return seeds

    monkeypatch.setattr(module, "match_keypoints", lambda *_, **__: Correspondences.of(inner, inner))
    monkeypatch.setattr(module, "propagate_matches", propagate)
    monkeypatch.setattr(module, "FEW", few)
    find_correspondences(scene.prepared(), observed, np.zeros_like(observed.model_mesh.points), KeypointSettings())
    wide = [module.CELL_MM, module.CELL_MM]
    # Twice about what was found, in a band of the images and, since that is no more than before, in all of them.
    assert [cell for _, cell in calls] == ([10.0] if few == 30 else [10.0, *wide, *wide, *wide, *wide])
    first = calls[0][0].grid.points()[calls[0][0].inside]
    assert first[:, 0].max() < scene.CENTRE_DEF[0]
    if few == 31:
        every = calls[2][0].grid.points()[calls[2][0].inside]
        assert every[:, 0].max() > scene.CENTRE_DEF[0] + 10
        assert len(every) > 1.6 * len(first)
        gas = resample_mask(found.air, calls[2][0].grid).inside
        assert not (gas & calls[2][0].inside).any()


def test_under_the_right_map_both_images_show_the_same(observed: Any) -> None:
    scans = warped_pair(half_seen(), scene.lung_deflated(), MeshMap(INFLATED, TRUTH, scene.DEF_FROM_INF), 2.0)
    assert np.corrcoef(scans.warped.hu[scans.lung.inside], scans.deflated.hu[scans.lung.inside])[0, 1] > 0.9
    assert (scans.lung.inside == scans.modelled.inside).mean() > 0.985
    points = scans.both_see.grid.points()
    back = scene.DEF_FROM_INF.inverse()(scene.expanded(points[scans.lung.inside]))
    assert back[:, 0].max() < PLANE_INF + 2.5
    assert points[scans.lung.inside][:, 2].max() < PLANE_DEF + 1.1
    assert_array_equal(scans.lung.inside & ~scans.both_see.inside, False)
    assert_array_equal(scans.modelled.inside & ~scans.both_see.inside, False)
    inner = np.random.default_rng(5).uniform(-15, 15, (20, 3)) + scene.CENTRE_DEF
    assert_allclose(scans.inf_from_def(inner), scene.DEF_FROM_INF.inverse()(scene.expanded(inner)), atol=0.05)


def test_the_modelled_lung_is_the_moved_mesh(observed: Any) -> None:
    scans = warped_pair(
        scene.prepared(), scene.lung_deflated(), MeshMap(INFLATED, BEFORE.points, scene.DEF_FROM_INF), 2.0
    )
    points = scans.modelled.grid.points()[scans.modelled.inside]
    assert_allclose(points.mean(axis=0), scene.CENTRE_DEF, atol=0.3)
    assert scans.modelled.inside.sum() * 8 == pytest.approx(BEFORE.volumes.sum(), rel=0.02)


def test_where_the_model_is_off_by_more_than_the_reach_places_to_all_sides_of_it_are_tried(
    observed: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = scene.collapsed(observed.model_mesh.points) - observed.model_mesh.points
    off, settings = truth + np.array([0, 0, 13.0]), KeypointSettings(reach_mm=8.0)
    found = find_correspondences(half_seen(), observed, off, settings)
    error = np.linalg.norm(scene.collapsed(found.moving) - found.fixed, axis=1)
    assert len(found) > 300
    assert np.median(error) < 0.8
    assert error.max() < 8.0
    monkeypatch.setattr(module, "FEW", 0)
    there_alone = find_correspondences(half_seen(), observed, off, settings)
    right = np.linalg.norm(scene.collapsed(there_alone.moving) - there_alone.fixed, axis=1) < 2.0
    assert right.sum() < 0.05 * (error < 2.0).sum()


def test_keypoints_are_looked_for_again_about_a_lung_that_follows_them_while_that_finds_many_more(
    observed: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The lung's middle is found at first, all of it then, and no more after that."""
    rest = observed.model_mesh.points
    model, truth = np.zeros_like(rest), scene.collapsed(rest) - rest
    starts: list[Array] = []
    at = scene.CENTRE_DEF + np.random.default_rng(1).uniform(-20, 20, (200, 3))
    middle = np.argsort(np.linalg.norm(at - scene.CENTRE_DEF, axis=1))[:90]

    def near(_prepared: Any, _observed: Any, displacement: Array, match: Any) -> Correspondences:
        starts.append(displacement)
        return Correspondences.none() if match.band_voxels is None else Correspondences.of(at, at)

    def in_groups(*_: Any) -> Correspondences:
        known = np.arange(200) if len(starts) > 10 else middle
        return Correspondences.of(scene.collapsed(at[known]), at[known])

    monkeypatch.setattr(module, "_near_model", near)
    monkeypatch.setattr(module, "_moving_in_groups", in_groups)
    found = find_correspondences(scene.prepared(), observed, model, KeypointSettings())
    assert len(found) == 200
    assert len(starts) == 2 + 8 + 2 + 2
    off = [np.linalg.norm(start - truth, axis=1).mean() for start in (model, *starts[10:12])]
    assert off[1] < 0.6 * off[0]  # what was found lies in the middle
    assert off[2] < 0.1 * off[0]  # and moved by an affine map


def test_of_matches_that_share_a_keypoint_the_best_correlated_stays() -> None:
    at = np.array([[1.0, 2, 3], [4, 5, 6], [1, 2, 3], [1, 2, 3]])
    to = np.arange(12.0).reshape(4, 3)
    best = module._consistent(Correspondences.of(at, to, np.array([0.5, 0.6, 0.9, 0.9])))
    assert_array_equal(best.fixed, at[:2])
    assert_array_equal(best.moving, to[[2, 1]])


def test_a_match_counts_where_two_of_its_neighbours_move_alike() -> None:
    at = np.stack([np.arange(20.0), np.zeros(20), np.zeros(20)], axis=1)
    motion = np.where(at[:, :1] < 10, [[0.0, 0, 0]], [[30.0, 0, 0]])
    motion[[4, 17]] += [[0, 9.0, 0], [0, 7.0, 0]]
    kept = module._consistent(Correspondences.of(at, at - motion, np.ones(20)))
    assert_array_equal(np.setdiff1d(at[:, 0], kept.fixed[:, 0]), [4])
    three_and_two = np.zeros((20, 3))
    three_and_two[9:12], three_and_two[16:18] = [0, 30.0, 0], [0, 0, 40.0]
    kept = module._consistent(Correspondences.of(at, at - three_and_two, np.ones(20)))
    assert_array_equal(np.setdiff1d(at[:, 0], kept.fixed[:, 0]), [16, 17])


def test_other_places_lie_to_all_sides_of_the_model_and_are_smaller_and_larger() -> None:
    rest = np.random.default_rng(3).normal(0, 40, (50, 3))
    after = 0.8 * rest + [5.0, -7.0, 2.0]
    others = [rest + other for other in module._others(rest, after - rest)]
    moved = np.array([other.mean(axis=0) - after.mean(axis=0) for other in others])
    sides = 12.0 * np.concatenate([np.eye(3), -np.eye(3)])
    assert_allclose(moved, np.concatenate([sides, np.zeros((2, 3))]), atol=1e-9)
    spread = [
        np.linalg.norm(other - other.mean(axis=0)) / np.linalg.norm(after - after.mean(axis=0)) for other in others
    ]
    assert_allclose(spread, [1.0] * 6 + [0.85, 1.15])
