"""Reading a case: what it holds, and what it leaves alone."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydantic import ValidationError

from registration.volume import Mask, axis_codes
from tests.vatsloc.case_scene import CENTRE, IMAGES, ball, chest, grid_at, point, whole_case, write_toml
from vatsloc.case import read_case, read_case_before, read_landmarks
from vatsloc.errors import CaseError
from vatsloc.formats.casefile import read_case_file
from vatsloc.formats.meshes import write_stl
from vatsloc.formats.nifti import write_mask, write_volume


@pytest.fixture
def folder(tmp_path) -> Path:
    return whole_case(tmp_path)


def test_images_nodule_and_defaults(folder):
    case = read_case(folder)
    assert case.side == "right"
    assert case.pleural_gas == "air"
    assert_allclose(case.ct.hu, chest(grid_at()).hu)
    assert_allclose(case.cbct_deflated.ras_from_ijk, grid_at((35.0, 5, 0), n=(14, 14, 12)).ras_from_ijk)
    assert case.nodule.mask is not None
    assert np.array_equal(case.nodule.mask.inside, ball(grid_at()).inside)
    points = grid_at().points()[ball(grid_at()).inside]
    assert_allclose(case.nodule.centre_ras, points.mean(axis=0), atol=1e-4)
    assert case.warnings == ()
    assert case.hints.lung_mask_ct is None
    assert case.input_sha256["ct"] == hashlib.sha256((folder / "ct.nii.gz").read_bytes()).hexdigest()


@pytest.mark.parametrize("table", ["", "images", "hints"])
def test_what_a_case_file_says_cannot_be_changed_once_read(folder, table):
    file = read_case_file(folder)
    with pytest.raises(ValidationError, match="frozen"):
        setattr(getattr(file, table) if table else file, {"": "side", "images": "ct"}.get(table, "spine_ct"), None)


@pytest.mark.parametrize("codes", ["RAS", "LAS", "SAL", "PIR"])
def test_storage_order_of_the_files_is_no_matter(folder, codes):
    plain = read_case(folder)
    for name, file in IMAGES.items():
        write_volume(folder / file, getattr(plain, name), codes)
    write_mask(folder / "nodule.nii.gz", ball(grid_at()), codes)
    case = read_case(folder)
    for name in IMAGES:
        assert_allclose(getattr(case, name).hu, getattr(plain, name).hu)
        assert_allclose(getattr(case, name).ras_from_ijk, getattr(plain, name).ras_from_ijk, atol=1e-4)
    assert_allclose(case.nodule.centre_ras, plain.nodule.centre_ras, atol=1e-4)
    assert set(case.stored_axes.values()) == {codes}
    assert axis_codes(case.ct.ras_from_ijk) == "LPS"


def test_paths_of_the_case_folder_may_be_nested(folder):
    (folder / "scans").mkdir()
    (folder / "ct.nii.gz").rename(folder / "scans" / "ct.nii.gz")
    write_toml(folder, images={**IMAGES, "ct": "scans/ct.nii.gz"})
    assert_allclose(read_case(folder).ct.hu, chest(grid_at()).hu)


@pytest.mark.parametrize(
    ("side", "stated", "expected"),
    [
        ("right", None, [-1, 0, 0]),
        ("left", None, [1, 0, 0]),
        ("right", [-0.98, 0.15, 0.05], np.array([-0.98, 0.15, 0.05]) / np.linalg.norm([-0.98, 0.15, 0.05])),
        ("left", [0.0, -1.0, 0.0], [0, -1, 0]),
    ],
)
def test_gravity_points_from_the_operated_side_to_the_other_one(folder, side, stated, expected):
    write_toml(folder, side=side, **({} if stated is None else {"setup": {"gravity_cbct": stated}}))
    assert_allclose(read_case(folder).gravity_ras, expected)


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "side", "sign"), [("twin-a", "right", -1), ("twin-b", "left", 1), ("twin-c", "right", -1)]
)
def test_shared_cases_agree_with_their_own_point_lists(shared, name, side, sign):
    case, landmarks = read_case(shared / "cases" / name), read_landmarks(shared / "cases" / name)
    assert case.side == side
    assert_allclose(case.gravity_ras, [sign, 0, 0], atol=0.05)
    assert np.sign(case.nodule.centre_ras[0]) == -sign
    assert landmarks.ct is not None
    assert (np.sign(landmarks.ct.ras[:, 0]) == -sign).all()
    assert landmarks.nodule_deflated_ras is not None
    ijk = case.cbct_deflated.grid.to_ijk(landmarks.nodule_deflated_ras)
    assert ((ijk > 0) & (ijk < case.cbct_deflated.hu.shape)).all()


def test_nodule_as_a_point_alone(folder):
    point(folder / "nodule_ct.mrk.json", CENTRE)
    write_toml(folder, nodule={"point": "nodule_ct.mrk.json"})
    nodule = read_case(folder).nodule
    assert nodule.mask is None
    assert_allclose(nodule.centre_ras, CENTRE)


def test_nodule_as_both_takes_the_centre_from_the_point(folder):
    point(folder / "nodule_ct.mrk.json", CENTRE + np.array([1.0, 2, 3]))
    write_toml(folder, nodule={"mask": "nodule.nii.gz", "point": "nodule_ct.mrk.json"})
    nodule = read_case(folder).nodule
    assert nodule.mask is not None
    assert_allclose(nodule.centre_ras, CENTRE + np.array([1, 2, 3]))


def test_nodule_mask_on_another_grid_is_brought_to_the_ct(folder):
    fine = grid_at(CENTRE, spacing=2.0, n=(30, 30, 30))
    write_mask(folder / "nodule.nii.gz", ball(fine, radius=20.0))
    nodule = read_case(folder).nodule
    assert nodule.mask is not None
    assert nodule.mask.grid.same_as(grid_at())
    assert_allclose(nodule.centre_ras, CENTRE, atol=5.0)
    expected = ball(grid_at(), radius=20.0).inside
    assert (nodule.mask.inside != expected).sum() <= 0.2 * expected.sum()


def test_specks_apart_from_the_nodule_are_dropped_with_a_warning(folder):
    mask = ball(grid_at(), radius=25.0)
    speck = mask.inside.copy()
    speck[0, 0, 0] = True
    write_mask(folder / "nodule.nii.gz", Mask(speck, mask.ras_from_ijk))
    case = read_case(folder)
    assert case.nodule.mask is not None
    assert np.array_equal(case.nodule.mask.inside, mask.inside)
    assert case.warnings == ("nodule.nii.gz: 1 voxels apart from the nodule were left out.",)


def test_hints(folder):
    write_mask(folder / "lung.nii.gz", ball(grid_at(), radius=50.0))
    corners = np.array([[20.0, 0, 0], [40, 0, 0], [20, 30, 0], [20, 0, 30]])
    write_stl(folder / "deflated.stl", corners, np.array([[0, 2, 1], [0, 1, 3]]))
    spine = {"spine_ct": [0.0, -40.0, 10.0], "spine_cbct_inflated": [5.0, -41.0, 11.0]}
    write_toml(folder, hints={**spine, "lung_mask_ct": "lung.nii.gz", "deflated_surface": "deflated.stl"})
    hints = read_case(folder).hints
    assert hints.lung_mask_ct is not None
    assert hints.deflated_surface is not None
    assert hints.spine_ct_ras is not None
    assert np.array_equal(hints.lung_mask_ct.inside, ball(grid_at(), radius=50.0).inside)
    assert_allclose(hints.spine_ct_ras, [0, -40, 10])
    assert_allclose(np.sort(hints.deflated_surface.points_ras, axis=0), np.sort(corners, axis=0))


def test_surface_without_a_stated_frame_is_noted(folder):
    facet = "facet normal 0 0 1\nouter loop\nvertex -20 0 0\nvertex -40 0 0\nvertex -20 -30 0\nendloop\nendfacet\n"
    (folder / "deflated.stl").write_text(f"solid lung\n{facet}endsolid\n")
    write_toml(folder, hints={"deflated_surface": "deflated.stl"})
    assert read_case(folder).warnings == ("deflated.stl states no frame; LPS was taken.",)


def test_landmarks_and_truth_are_never_opened(folder):
    plain = read_case(folder)
    write_toml(folder, landmarks={"ct": "landmarks_ct.mrk.json", "cbct_deflated": "gone.mrk.json"})
    (folder / "landmarks_ct.mrk.json").mkdir()
    (folder / "truth").mkdir()
    (folder / "truth" / "nodule_cbct_deflated.mrk.json").write_text("garbage")
    case = read_case(folder)
    assert case.input_sha256 == plain.input_sha256
    assert case.warnings == plain.warnings


def test_landmarks_by_case_file_and_by_usual_name(folder):
    write_toml(folder, landmarks={"ct": "points.mrk.json"})
    point(folder / "points.mrk.json", CENTRE, CENTRE + 1)
    point(folder / "landmarks_cbct_inflated.mrk.json", CENTRE + 2)
    point(folder / "truth" / "nodule_cbct_deflated.mrk.json", CENTRE + 3)
    landmarks = read_landmarks(folder)
    assert landmarks.ct is not None
    assert landmarks.cbct_inflated is not None
    assert landmarks.ct.labels == ("L0", "L1")
    assert_allclose(landmarks.cbct_inflated.ras, [CENTRE + 2])
    assert landmarks.cbct_deflated is None
    assert landmarks.nodule_inflated_ras is None
    assert landmarks.nodule_deflated_ras is not None
    assert_allclose(landmarks.nodule_deflated_ras, CENTRE + 3)


def test_named_landmarks_that_are_missing_are_a_case_error(folder):
    write_toml(folder, landmarks={"cbct_deflated": "gone.mrk.json"})
    with pytest.raises(CaseError, match=r"gone\.mrk\.json does not exist"):
        read_landmarks(folder)


def test_before_the_collapse_an_inflated_scan_counts_once_its_file_is_there(folder: Path) -> None:
    (folder / IMAGES["cbct_deflated"]).unlink()
    before = read_case_before(folder)
    assert before.cbct_inflated is not None
    assert before.cbct_inflated.hu.shape == (14, 14, 12)
    (folder / IMAGES["cbct_inflated"]).unlink()
    assert read_case_before(folder).cbct_inflated is None
