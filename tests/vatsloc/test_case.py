"""Reading a case: what it holds, what it leaves alone, and each refusal by its sentence."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import nibabel
import numpy as np
import pytest
from numpy.testing import assert_allclose

from registration.volume import Grid, Mask, Volume, axis_codes
from vatsloc.case import read_case, read_landmarks
from vatsloc.errors import CaseError, InputRefused, VatslocError
from vatsloc.formats.markups import PointList, write_points
from vatsloc.formats.meshes import write_stl
from vatsloc.formats.nifti import write_mask, write_volume

IMAGES = {"ct": "ct.nii.gz", "cbct_inflated": "cbct_inflated.nii.gz", "cbct_deflated": "cbct_deflated.nii.gz"}
CENTRE = np.array([60.0, 10.0, -20.0])


def grid_at(centre=(0.0, 0.0, 0.0), spacing=10.0, n=(20, 18, 16)) -> Grid:
    """LPS-stored grid around a RAS point."""
    affine = np.diag([-spacing, -spacing, spacing, 1.0])
    affine[:3, 3] = np.asarray(centre) - affine[:3, :3] @ ((np.array(n) - 1) / 2)
    return Grid(n, affine)


def chest(grid: Grid) -> Volume:
    """Body of soft tissue in air, with a slope that tells the axes apart."""
    points = grid.points()
    body = np.linalg.norm(points / [80, 60, 200], axis=-1) < 1
    hu = np.where(body, 40 + 0.1 * points @ [1.0, 2, 3], -1000).astype(np.float32)
    return Volume(np.rint(hu), grid.ras_from_ijk)


def ball(grid: Grid, centre=CENTRE, radius=12.0) -> Mask:
    return Mask(np.linalg.norm(grid.points() - centre, axis=-1) <= radius, grid.ras_from_ijk)


def point(path: Path, *xyz: np.ndarray) -> None:
    path.parent.mkdir(exist_ok=True)
    write_points(path, PointList(np.array(xyz), tuple(f"L{n}" for n in range(len(xyz)))))


def write_toml(folder: Path, **tables) -> None:
    """case.toml with the required tables unless they are given; None leaves one out."""
    tables = {"side": "right", "images": IMAGES, "nodule": {"mask": "nodule.nii.gz"}, **tables}
    flat = [f"{k} = {json.dumps(v)}" for k, v in tables.items() if v is not None and not isinstance(v, dict)]
    for name, table in tables.items():
        if isinstance(table, dict):
            flat += [f"[{name}]", *(f"{k} = {json.dumps(v)}" for k, v in table.items())]
    (folder / "case.toml").write_text("\n".join(flat))


@pytest.fixture
def folder(tmp_path) -> Path:
    write_volume(tmp_path / IMAGES["ct"], chest(grid_at()))
    write_volume(tmp_path / IMAGES["cbct_inflated"], chest(grid_at((30.0, 0, 0), n=(14, 14, 12))))
    write_volume(tmp_path / IMAGES["cbct_deflated"], chest(grid_at((35.0, 5, 0), n=(14, 14, 12))))
    write_mask(tmp_path / "nodule.nii.gz", ball(grid_at()))
    write_toml(tmp_path)
    return tmp_path


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


def refused(folder: Path, error: type[VatslocError], sentence: str) -> None:
    with pytest.raises(error, match=sentence) as caught:
        read_case(folder)
    assert "\n" not in str(caught.value)
    assert str(caught.value).endswith(".")


@pytest.mark.parametrize(
    ("tables", "sentence"),
    [
        (
            {"colour": "red"},
            "colour is an unknown key; side, images, nodule, setup, hints, landmarks are known, so correct",
        ),
        (
            {"setup": {"gravity": [1, 0, 0]}},
            r"\[setup\] gravity is an unknown key; gravity_cbct, pleural_gas are known",
        ),
        ({"images": {**IMAGES, "mri": "m.nii"}}, r"\[images\] mri is an unknown key"),
        (
            {"images": {"ct": "a", "cbct_inflated": "b", "cbct_defalted": "c"}},
            r"\[images\] cbct_defalted is an unknown key",
        ),
        ({"images": {"ct": "ct.nii.gz", "cbct_inflated": "x"}}, r"\[images\] cbct_deflated is missing; add it"),
        ({"side": "Right"}, "side = 'Right' is wrong .*'left' or 'right'"),
        ({"nodule": {}}, r"\[nodule\] names neither mask nor point; add mask"),
        ({"setup": {"pleural_gas": "helium"}}, r"\[setup\] pleural_gas = 'helium' is wrong"),
        ({"setup": {"gravity_cbct": [-1.0, 0.0]}}, r"\[setup\] gravity_cbct\[2\] is missing"),
        (
            {"setup": {"gravity_cbct": [-9.81, 0.0, 0.0]}},
            r"\[setup\] gravity_cbct has length 9.81, 1 needed; give a unit vector",
        ),
        (
            {"setup": {"gravity_cbct": [1.0, 0.0, 0.0]}},
            "points to the right side, but the operated right lung lies up; correct side",
        ),
        (
            {"side": "left", "setup": {"gravity_cbct": [-1.0, 0.0, 0.0]}},
            "points to the left side, but the operated left lung",
        ),
        ({"hints": {"spine_ct": [0, 0, 0]}}, r"\[hints\] names the spine in one image only; give both"),
        (
            {"hints": {"spine_ct": [900, 0, 0], "spine_cbct_inflated": [0, 0, 0]}},
            "spine_ct = .* lies outside its image",
        ),
        (
            {"images": {**IMAGES, "ct": "gone.nii.gz"}},
            r"gone\.nii\.gz \(ct in case\.toml\) does not exist; put it there",
        ),
        ({"nodule": {"mask": "gone.nii.gz"}}, r"gone\.nii\.gz \(nodule_mask in case\.toml\) does not exist"),
        ({"hints": {"deflated_surface": "gone.stl"}}, r"gone\.stl \(deflated_surface in case\.toml\) does not exist"),
    ],
)
def test_wrong_case_files_are_refused(folder, tables, sentence):
    write_toml(folder, **tables)
    refused(folder, CaseError, sentence)


def test_folder_without_a_case_file_is_refused(tmp_path):
    refused(tmp_path, CaseError, r"holds no case\.toml; name a case folder")


def test_case_file_that_is_no_toml_is_refused(folder):
    (folder / "case.toml").write_text("side: right")
    refused(folder, CaseError, r"case\.toml is not valid TOML")


def test_images_that_do_not_overlap_are_refused(folder):
    away = grid_at((400.0, 0, 0), n=(14, 14, 12))
    write_volume(folder / "cbct_inflated.nii.gz", Volume(chest(grid_at(n=(14, 14, 12))).hu, away.ras_from_ijk))
    sentence = r"overlap by 0 % \(400 mm between centres\), 20 % needed; place them within about 10 cm"
    refused(folder, InputRefused, sentence)


def test_images_ten_centimetres_off_are_accepted(folder):
    moved = grid_at((100.0, 0, 0), n=(14, 14, 12))
    for name in ("cbct_inflated", "cbct_deflated"):
        write_volume(folder / IMAGES[name], Volume(chest(grid_at(n=(14, 14, 12))).hu, moved.ras_from_ijk))
    assert_allclose(read_case(folder).cbct_inflated.ras_from_ijk, moved.ras_from_ijk)


def test_image_that_is_not_in_hu_is_refused(folder):
    volume = chest(grid_at())
    write_volume(folder / "ct.nii.gz", Volume(volume.hu + 1024, volume.ras_from_ijk))
    refused(
        folder, InputRefused, r"shows no air in HU \(its lowest percent starts at 24\) and cannot be .* state ct_slope"
    )


def test_image_with_a_voxel_that_is_not_a_number_is_refused(folder):
    image = nibabel.load(folder / "cbct_deflated.nii.gz")
    values = np.asarray(image.dataobj, dtype=np.float32)
    values[3, 3, 3] = np.nan
    nibabel.save(nibabel.Nifti1Image(values, image.affine), folder / "cbct_deflated.nii.gz")
    refused(folder, InputRefused, r"cbct_deflated\.nii\.gz has 1 voxels that are not finite numbers")


def test_nodule_elsewhere_is_refused(folder):
    away = grid_at((500.0, 0, 0), spacing=2.0)
    write_mask(folder / "nodule.nii.gz", ball(away, centre=[500.0, 0, 0]))
    refused(folder, InputRefused, r"nodule\.nii\.gz lies outside the CT; draw the mask in the CT's frame")
    point(folder / "nodule_ct.mrk.json", [500.0, 0, 0])
    write_toml(folder, nodule={"point": "nodule_ct.mrk.json"})
    refused(folder, InputRefused, r"nodule_ct\.mrk\.json lies outside the CT; save the point in the CT's frame")


def test_nodule_point_far_from_its_mask_is_refused(folder):
    point(folder / "nodule_ct.mrk.json", -CENTRE)
    write_toml(folder, nodule={"mask": "nodule.nii.gz", "point": "nodule_ct.mrk.json"})
    refused(folder, InputRefused, r"lies \d+ mm off the nodule mask nodule\.nii\.gz; keep the right one")


def test_nodule_point_list_of_two_is_refused(folder):
    point(folder / "nodule_ct.mrk.json", CENTRE, CENTRE)
    write_toml(folder, nodule={"point": "nodule_ct.mrk.json"})
    refused(folder, InputRefused, "holds 2 points, one needed; keep the nodule's centre")


def test_two_nodules_are_refused(folder):
    both = ball(grid_at()).inside | ball(grid_at(), centre=-CENTRE).inside
    write_mask(folder / "nodule.nii.gz", Mask(both, grid_at().ras_from_ijk))
    refused(folder, InputRefused, "shows 2 separate regions, the largest of .*; keep one nodule per case")


def test_mask_between_the_voxels_of_the_ct_is_refused(folder):
    centre = grid_at().to_ras(np.array([5.5, 5.5, 5.5]))
    write_mask(folder / "nodule.nii.gz", ball(grid_at(centre, spacing=0.5), centre=centre, radius=1.0))
    refused(folder, InputRefused, "falls between them; draw it on the CT's grid")


def test_deflated_surface_in_another_frame_is_refused(folder):
    write_stl(folder / "deflated.stl", np.array([[-90.0, 0, 0], [-80, 0, 0], [-90, 30, 0]]), np.array([[0, 1, 2]]))
    write_toml(folder, hints={"deflated_surface": "deflated.stl"})
    refused(folder, InputRefused, "0 % of its points inside the deflated CBCT, 90 % needed; save it in LPS millimetres")
