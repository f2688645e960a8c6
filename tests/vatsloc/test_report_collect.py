"""What the report shows of a case and its result: each value in its place, each map in its direction."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from registration.maps.field import DisplacementField
from registration.maps.rigid import RigidTransform
from registration.volume import Mask, Volume
from vatsloc.case import Case, Hints, Nodule
from vatsloc.formats.meshes import Surface, TetraMesh
from vatsloc.frames import flip_points
from vatsloc.report.collect import report_data
from vatsloc.report.render import render
from vatsloc.results import ResultData, RunRecord

AFFINE = np.array([[4.0, 0, 0, -40], [0, 4, 0, -40], [0, 0, 4, -40], [0, 0, 0, 1]])
CT, INFLATED, DEFLATED = np.array([1.0, 2, 3]), np.array([4.0, 5, 6]), np.array([-7.0, 8, 9])
AXES_LPS = np.array([[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1]])
RIGID1 = RigidTransform.about(np.zeros(3), np.array([0, 0, 0.2]), np.array([5.0, 0, 0]))
RIGID2 = RigidTransform.about(np.zeros(3), np.array([0.1, 0, 0]), np.array([0.0, 3, 0]))


def constant(hu):
    return Volume(np.full((20, 20, 20), hu, dtype=np.float32), AFFINE)


@pytest.fixture
def case():
    hints = Hints()
    known = Nodule(CT, None), np.array([-1.0, 0, 0]), "air", hints, {}, {}
    scans = {"cbct_inflated": constant(-2), "cbct_deflated": constant(-3)}
    return Case(Path("a-case"), "right", constant(-1), *known, **scans)


@pytest.fixture
def result():
    tetrahedron = np.array([[0, 1, 2, 3]])
    lungs = [TetraMesh(scale * np.vstack([np.zeros(3), np.eye(3)]), tetrahedron) for scale in (30.0, 20.0, 10.0)]
    # One triangle in the plane R = -10, seen from the right: a lung of the left side lies behind it.
    seen = Surface(np.array([[-10.0, -50, -50], [-10, 50, -50], [-10, 0, 50]]), np.array([[0, 2, 1]]))
    field = DisplacementField(np.zeros((2, 2, 2, 3), dtype=np.float32), AFFINE)
    run = RunRecord(
        "converged",
        flip_points(DEFLATED),
        np.array([3.0, 2, 1]),
        {"phi": 0.5},
        {"total": 1.0},
        1.0,
        details={"nodule_ellipsoid95_axes_lps": AXES_LPS},
    )
    mask = Mask(np.ones((20, 20, 20), dtype=bool), AFFINE)
    images = mask, constant(-4), constant(-5)
    return ResultData(
        INFLATED, DEFLATED, *images, *lungs, seen, seen, *[field] * 4, RIGID1.matrix, RIGID2.matrix, run, {}
    )


def test_phases_hold_the_right_images_and_maps(case, result):
    first, second = report_data(case, result).phases
    assert [v.hu[0, 0, 0] for v in (first.fixed, first.before, first.after)] == [-2, -1, -4]
    assert [v.hu[0, 0, 0] for v in (second.fixed, second.before, second.after)] == [-3, -2, -5]
    assert_allclose(first.before_from_fixed(RIGID1(CT[None])), [CT], atol=1e-9)
    assert_allclose(second.before_from_fixed(RIGID2(INFLATED[None])), [INFLATED], atol=1e-9)
    assert_allclose([first.nodule.centre_ras, second.nodule.centre_ras], [INFLATED, DEFLATED])


def test_ellipsoid_axes_cross_from_lps_to_ras(case, result):
    ellipsoid = report_data(case, result).nodule.ellipsoid
    assert_allclose(ellipsoid, [[-1.8, -2.4, 0], [1.6, -1.2, 0], [0, 0, 1]])


def test_depth_is_measured_from_the_deflated_surface(case, result):
    data = report_data(case, result)
    assert_allclose(data.depth_mm, 3.0)
    assert_allclose(data.nearest_surface_ras, [-10, 8, 9])


def test_page_of_a_result_shows_every_stage(case, result):
    page = render(report_data(case, result))
    for words in (
        "a-case",
        "Phase 1: change of pose",
        "Phase 2: pneumothorax",
        "Lung model in the CT",
        "contact surface",
    ):
        assert words in page
    assert 'id="nodule-lps">7.0, -8.0, 9.0<' in page


def test_motion_takes_the_inflated_border_to_the_deflated_one_in_one_frame(case, result):
    motion = report_data(case, result).motion
    assert_allclose(motion.after, 10.0 * np.vstack([np.zeros(3), np.eye(3)]))
    assert_allclose(motion.before, RIGID2(20.0 * np.vstack([np.zeros(3), np.eye(3)])))
    assert_allclose(motion.nodule_before, RIGID2(INFLATED[None])[0])
    corners = motion.after[motion.triangles]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("nd,nd->n", outward, corners.mean(axis=1) - motion.after.mean(axis=0)) > 0).all()
