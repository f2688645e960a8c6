"""Statistics, pairing and geometry of the evaluation, against numbers worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from poro.mesh import TetMesh
from registration.maps.field import DisplacementField
from registration.volume import Mask
from vatsloc.errors import CaseError
from vatsloc.evaluation.ellipsoid import in_ellipsoid
from vatsloc.evaluation.inputs import depth_below_pleura, seen_in
from vatsloc.evaluation.landmarks import match
from vatsloc.evaluation.statistics import by_depth, distances, signed_rank_p, summarize
from vatsloc.evaluation.tre import RunMaps, target_registration_errors
from vatsloc.formats.markups import PointList


def points(**named):
    return PointList(np.array(list(named.values()), dtype=float), tuple(named))


def tetrahedron(edge=10.0):
    return TetMesh(edge * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array([[0, 1, 2, 3]]))


def test_statistics_of_known_errors():
    s = summarize(np.array([1.0, 2.0, 3.0, 4.0, 10.0, np.nan]))
    assert (s.mean, s.median, s.max, s.n) == (4.0, 3.0, 10.0, 5)
    assert_allclose(s.sd, np.sqrt(50 / 4))
    # Linear interpolation between order statistics: position 0.95 * 4 = 3.8 between 4 and 10.
    assert_allclose(s.p95, 4 + 0.8 * 6)


def test_statistics_of_no_landmark_are_not_a_perfect_score():
    s = summarize(np.array([np.nan]))
    assert s.n == 0
    assert np.isnan([s.mean, s.sd, s.median, s.p95, s.max]).all()


def test_distance_is_euclidean():
    assert_allclose(distances(np.array([[1.0, 2, 3]]), np.array([[4.0, 6, 3]])), [5.0])


def test_depth_strata_hold_each_landmark_once():
    depth = np.array([-2.0, 0.0, 9.9, 10.0, 25.0, 80.0, np.nan])
    strata = by_depth(np.array([1.0, 2, 3, 4, 5, 6, 7]), depth)
    assert [(s.from_mm, s.to_mm, s.errors.n) for s in strata] == [(0, 10, 3), (10, 20, 1), (20, 30, 1), (30, np.inf, 1)]
    assert [s.errors.mean for s in strata] == [2.0, 4.0, 5.0, 6.0]


def test_signed_rank_test_by_known_value():
    before = np.arange(10.0) + 10
    # All ten differences have one sign, which has probability 2 / 2**10.
    assert_allclose(signed_rank_p(before, before - np.linspace(1, 2, 10)), 2 / 2**10)
    assert signed_rank_p(before, before) == 1.0
    assert signed_rank_p(before[:5], before[:5] - 1) is None


def test_landmarks_are_matched_by_label_not_by_order():
    triples = match(
        points(a=(0, 0, 0), b=(1, 0, 0), c=(2, 0, 0), only_ct=(9, 9, 9)),
        points(c=(2, 5, 0), a=(0, 5, 0)),
        points(b=(1, 0, 5), a=(0, 0, 5), only_deflated=(8, 8, 8)),
    )
    assert triples.labels == ("a", "b", "c")
    assert_allclose(triples.inflated, [[0, 5, 0], [np.nan] * 3, [2, 5, 0]])
    assert_allclose(triples.deflated, [[0, 0, 5], [1, 0, 5], [np.nan] * 3])
    assert triples.unmatched == ("only_ct", "only_deflated")


def test_landmarks_that_share_no_label_are_refused():
    with pytest.raises(CaseError, match="same label"):
        match(points(a=(0, 0, 0)), points(x=(0, 0, 0)), None)


def test_label_used_twice_is_refused():
    twice = PointList(np.zeros((2, 3)), ("a", "a"))
    with pytest.raises(CaseError, match="'a' more than once"):
        match(points(a=(0, 0, 0)), twice, None)


def test_errors_have_the_sign_and_size_of_analytic_maps():
    ct = np.array([[0.0, 0, 0], [10, 0, 0]])
    field = DisplacementField(np.broadcast_to(np.float32([6, -4, 3]), (4, 4, 4, 3)).copy(), np.diag([20.0, 20, 20, 1]))
    triples = match(
        points(a=ct[0], b=ct[1]),
        points(a=ct[0] + [6, -4, 3], b=ct[1] + [6, -4, 0]),
        points(a=ct[0] + [12, -8, 6], b=ct[1]),
    )
    stay = np.asarray
    errors = target_registration_errors(triples, RunMaps(stay, stay, stay, field, field, lambda x: field(field(x))))
    assert_allclose(errors.inflated - ct, [[6, -4, 3]] * 2)
    assert_allclose(errors.deflated - ct, [[12, -8, 6]] * 2)
    assert_allclose(errors.mm["phase1"], [0, 3], atol=1e-6)
    assert_allclose(errors.mm["rigid_ct_inflated"], [np.sqrt(61), np.sqrt(52)])
    # Phase 2 starts from the true inflated landmark, so phase 1's 3 mm do not enter it.
    assert_allclose(errors.mm["phase2"], [0, np.linalg.norm([12, -8, 3])], atol=1e-6)
    assert_allclose(errors.mm["chain"], [0, np.linalg.norm([12, -8, 6])], atol=1e-6)


def test_missing_truth_gives_no_error_but_a_prediction():
    triples = match(points(a=(1, 1, 1)), None, points(a=(1, 1, 3)))
    errors = target_registration_errors(triples, RunMaps(*[np.asarray] * 6))
    assert np.isnan(errors.mm["phase1"]).all()
    assert np.isnan(errors.mm["phase2"]).all()
    assert_allclose(errors.mm["chain"], [2.0])
    assert_allclose(errors.inflated, [[1, 1, 1]])


def test_depth_is_positive_inside_and_negative_outside():
    depth = depth_below_pleura(tetrahedron(), np.array([[1.0, 2, 3], [2, 3, -5], [np.nan] * 3]))
    assert_allclose(depth, [1.0, -5.0, np.nan])


def test_field_of_view_is_read_at_the_right_voxel():
    inside = np.zeros((4, 4, 4), dtype=bool)
    inside[1, 2, 3] = True
    affine = np.array([[-2.0, 0, 0, 10], [0, -2, 0, 20], [0, 0, 2, 0], [0, 0, 0, 1]])
    seen = seen_in(Mask(inside, affine), np.array([[8.4, 15.7, 6.2], [8, 12, 6], [100, 0, 0], [np.nan] * 3]))
    assert seen.tolist() == [True, False, False, True]


def test_ellipsoid_holds_points_along_its_own_axes():
    turned = np.array([[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1]])
    assert in_ellipsoid(4.9 * turned[0], np.array([5.0, 2, 1]), turned) is True
    assert in_ellipsoid(4.9 * turned[1], np.array([5.0, 2, 1]), turned) is False


def test_ellipsoid_without_directions_is_told_only_where_certain():
    axes = np.array([5.0, 2, 1])
    told = [in_ellipsoid(np.array([r, 0, 0]), axes, None) for r in (0.9, 3.0, 5.1)]
    assert told == [True, None, False]
