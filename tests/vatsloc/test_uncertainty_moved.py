"""How sure a run is of tissue in a lung that the spine turned and the collapse moved: values worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from poro.fit import ellipsoid95, point_covariance
from registration.correspondences import Correspondences
from registration.volume import Array
from tests.vatsloc import run_scene as known
from vatsloc.evaluation.ellipsoid import in_ellipsoid
from vatsloc.workflow.model_selection import Refinement
from vatsloc.workflow.uncertainty import covariance, nearest_correspondences, radius95, scatter

QUANTILE = np.sqrt(7.814728)  # of chi-squared with three degrees of freedom, 95 %
TRIED = (Refinement("regional", 4.0, 3.0, True),)
CT = known.CENTRE + np.array([[5.0, 2, 1], [-12.0, 8, 6], [3.0, -14, -9], [0.0, 4.0, 17]])
BEFORE = known.DEF_FROM_INF_RIGID(known.INF_FROM_CT(CT))
MISSED = 0.04 * 2.0 ** np.arange(8)  # mm, so that every sum is of one choice alone


def sure(scene: known.Scene, ct: Array) -> Array:
    """Covariance of points of the CT, given in both cone-beam CTs."""
    return covariance(scene.pose, scene.collapse, known.INF_FROM_CT(ct), known.DEF_FROM_CT(ct))


def with_keypoints() -> known.Scene:
    """Eight keypoints along a line; the result misses keypoint n by MISSED[n]."""
    first = known.DEF_FROM_INF_RIGID(known.INF_FROM_CT(known.CENTRE + np.outer(np.arange(8.0) - 4.0, [5.0, 0, 0])))
    towards = np.tile([[0.6, 0.0, 0.8], [0.0, -1.0, 0.0]], (4, 1))
    second = known.AFTER_FROM_BEFORE(first) + MISSED[:, None] * towards
    return known.scene().with_model(correspondences=Correspondences.of(second, first), refinements=TRIED)


def test_without_images_the_model_counts_where_the_spine_puts_a_point() -> None:
    assert_allclose(sure(known.scene(), CT), known.modelled(BEFORE, 4.0))


def test_the_ensemble_add_to_the_model() -> None:
    mesh = known.scene().collapse.system.mesh
    off = (mesh.points - known.CENTRE) / 5.0
    members = np.stack([off, np.broadcast_to([3.0, -1.0, 2.0], off.shape), off[:, [1, 2, 0]]])
    scene = known.scene().with_model(ensemble=members)
    d = (BEFORE - known.CENTRE) / 5.0
    each = [d, np.broadcast_to([3.0, -1.0, 2.0], d.shape), d[:, [1, 2, 0]]]
    mean = sum(np.array([np.outer(v, v) for v in one]) for one in each) / 3
    assert_allclose(scatter(scene.collapse, BEFORE), mean)
    assert_allclose(sure(scene, CT), known.modelled(BEFORE, 4.0) + mean)


def test_where_registrations_placed_tissue_they_count_node_by_node() -> None:
    lung = known.scene().pose.mesh_ct
    residual = known.corrected(lung)  # believes nodes 0 to 29, which disagree by 0.1 mm times their number
    edge = next(pair for pair in lung.tets[:, :2] if (pair < 30).sum() == 1 and pair.min() > 9)
    believed, other = sorted(edge)
    nodes = np.array([12, 25, other])
    points = np.concatenate([lung.points[nodes], lung.points[[believed, other]].mean(axis=0)[None]])
    got = sure(known.scene().with_collapse(residual=residual), points)
    model = known.modelled(known.DEF_FROM_INF_RIGID(known.INF_FROM_CT(points)), 4.0)
    assert_allclose(got[0], (0.5 + 0.6**2) * np.eye(3), atol=1e-9)
    assert_allclose(got[1], (0.5 + 1.25**2) * np.eye(3), atol=1e-9)
    assert_allclose(got[2], model[2], atol=1e-9)
    half = 0.5 * (0.5 + (0.1 * believed / 4) ** 2) * np.eye(3) + 0.5 * model[3]
    assert_allclose(got[3], half, atol=1e-9)


def test_nearest_keypoints_are_those_of_the_deflated_image() -> None:
    collapse = with_keypoints().collapse
    keypoints = collapse.model.correspondences.fixed
    distance, missed = nearest_correspondences(collapse, keypoints[[0, 7]] + [0, 0, 1e-3])
    assert_allclose(distance, 1e-3, atol=1e-9)
    assert_allclose(missed, [MISSED[:6].mean(), MISSED[2:].mean()], rtol=1e-6)


def test_keypoints_are_measured_from_where_the_answer_puts_a_point() -> None:
    scene = with_keypoints()
    got = sure(scene, CT)
    second, after = scene.collapse.model.correspondences.fixed, known.DEF_FROM_CT(CT)
    for point, before, one in zip(after, BEFORE, got, strict=True):
        far = np.linalg.norm(second - point, axis=1)
        missed = MISSED[np.argsort(far)[:6]].mean()
        sigma = 1.5 * missed + 0.15 * max(far.min() - 8.0, 0.0)
        assert_allclose(one, known.modelled(before[None], sigma)[0], rtol=1e-6)


def test_registrations_are_no_surer_than_the_places_about_them() -> None:
    lung = known.scene().pose.mesh_ct
    sharp = replace(known.corrected(lung), seen=np.ones(len(lung.points), bool), disagreement_mm=np.full(199, 0.6))
    scene = with_keypoints().with_collapse(residual=sharp)
    distance, missed = nearest_correspondences(scene.collapse, known.DEF_FROM_CT(CT))
    sigma = 1.5 * missed + 0.15 * np.maximum(distance - 8.0, 0.0)
    least = 0.5 + 0.3**2
    assert (sigma**2 > least).any()
    assert (sigma**2 < least).any()
    wanted = np.maximum(sigma**2, least)[:, None, None] * np.eye(3)
    assert_allclose(sure(scene, CT), wanted, atol=1e-9)


def test_radius_is_the_longest_semi_axis_at_each_node_of_the_moved_lung() -> None:
    scene = with_keypoints()
    nodes = scene.pose.mesh_ct.points
    longest = QUANTILE * np.sqrt(np.linalg.eigvalsh(sure(scene, nodes)).max(axis=1))
    assert np.ptp(longest) > 1
    assert_allclose(radius95(scene.pose, scene.collapse), longest)


OBLIQUE = np.array([[2.0, 1.0, 2.0], [-2.0, 2.0, 1.0], [-1.0, -2.0, 2.0]]) / 3.0  # orthonormal rows, right-handed
SIGMA = np.array([3.0, 2.0, 0.5])


def oblique() -> tuple[Array, Array]:
    """Semi-axes and directions of an ellipsoid along no axis of the frame."""
    (lengths,), (directions,) = ellipsoid95((OBLIQUE.T @ np.diag(SIGMA**2) @ OBLIQUE)[None])
    return lengths, directions


def test_ellipsoid_of_oblique_spread_has_its_axes_in_rows_longest_first() -> None:
    lengths, directions = oblique()
    assert_allclose(lengths, QUANTILE * SIGMA)
    assert_allclose(np.abs(np.einsum("ai,ai->a", directions, OBLIQUE)), 1.0)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_oblique_ellipsoid_ends_at_its_semi_axes(axis: int, sign: float) -> None:
    lengths, directions = oblique()
    tip = sign * QUANTILE * SIGMA[axis] * OBLIQUE[axis]
    assert in_ellipsoid(0.999 * tip, lengths, directions) is True
    assert in_ellipsoid(1.001 * tip, lengths, directions) is False


@pytest.mark.parametrize(("off_mm", "told"), [(2.0, True), (2.1, None), (4.0, None), (4.1, False)])
def test_without_directions_an_ellipsoid_is_told_within_its_least_and_beyond_its_greatest_axis(
    off_mm: float, told: bool | None
) -> None:
    assert in_ellipsoid(np.array([0.0, off_mm, 0.0]), np.array([4.0, 3.0, 2.0]), None) is told


def test_an_ellipsoid_is_smaller_than_its_box() -> None:
    lengths, directions = oblique()
    corner = lengths @ directions
    assert in_ellipsoid(0.999 / np.sqrt(3) * corner, lengths, directions) is True
    assert in_ellipsoid(1.001 / np.sqrt(3) * corner, lengths, directions) is False


def test_ninety_five_in_a_hundred_draws_lie_in_the_ellipsoid() -> None:
    lengths, directions = oblique()
    draws = np.random.default_rng(11).normal(size=(4000, 3)) * SIGMA @ OBLIQUE
    share = np.mean([in_ellipsoid(draw, lengths, directions) for draw in draws])
    assert share == pytest.approx(0.95, abs=0.01)  # three standard deviations of such a share


def test_point_covariance_carries_that_of_the_parameters_and_adds_what_none_explains() -> None:
    collapse = known.scene().collapse
    fit, system = collapse.fit, collapse.system
    assert_allclose(point_covariance(fit, system, BEFORE, 3.0), known.modelled(BEFORE, 3.0))
    each = np.array([0.0, 1.0, 2.0, 5.0])
    assert_allclose(point_covariance(fit, system, BEFORE, each), known.modelled(BEFORE, each))


@pytest.mark.parametrize(
    ("surface_mm", "keypoints_mm", "left_mm"), [(1.7, 2.3, 1.7), (1.0, 3.0, np.sqrt(3)), (2.0, 3.0, 2.0)]
)
def test_what_no_parameter_explains_is_the_larger_misfit_per_axis(
    surface_mm: float, keypoints_mm: float, left_mm: float
) -> None:
    collapse = known.scene().with_fit(surface_rms_mm=surface_mm, keypoint_rms_mm=keypoints_mm).collapse
    assert_allclose(point_covariance(collapse.fit, collapse.system, BEFORE), known.modelled(BEFORE, left_mm))
