"""Cases that cannot be read: each refusal by its sentence."""

from __future__ import annotations

from pathlib import Path

import nibabel
import numpy as np
import pytest
from numpy.testing import assert_allclose

from registration.volume import Mask, Volume
from tests.vatsloc.case_scene import CENTRE, IMAGES, ball, check_refused, chest, grid_at, point, whole_case, write_toml
from vatsloc.case import _read_image, read_case
from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.meshes import write_stl
from vatsloc.formats.nifti import write_mask, write_volume


@pytest.fixture
def folder(tmp_path) -> Path:
    return whole_case(tmp_path)


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
        ({"side": "Right"}, r"side = 'Right' is wrong \(input should be 'left' or 'right'\); correct it"),
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
    check_refused(folder, CaseError, sentence)


def test_folder_without_a_case_file_is_refused(tmp_path):
    check_refused(tmp_path, CaseError, r"holds no case\.toml; name a case folder")


def test_case_file_that_is_no_toml_is_refused(folder):
    (folder / "case.toml").write_text("side: right")
    check_refused(folder, CaseError, r"case\.toml is not valid TOML")


def test_images_that_do_not_overlap_are_refused(folder):
    away = grid_at((400.0, 0, 0), n=(14, 14, 12))
    write_volume(folder / "cbct_inflated.nii.gz", Volume(chest(grid_at(n=(14, 14, 12))).hu, away.ras_from_ijk))
    sentence = r"overlap by 0 % \(400 mm between centres\), 20 % needed; place them within about 10 cm"
    check_refused(folder, InputRefused, sentence)


def test_images_ten_centimetres_off_are_accepted(folder):
    moved = grid_at((100.0, 0, 0), n=(14, 14, 12))
    for name in ("cbct_inflated", "cbct_deflated"):
        write_volume(folder / IMAGES[name], Volume(chest(grid_at(n=(14, 14, 12))).hu, moved.ras_from_ijk))
    assert_allclose(read_case(folder).cbct_inflated.ras_from_ijk, moved.ras_from_ijk)


def test_image_that_is_not_in_hu_is_refused(folder):
    volume = chest(grid_at())
    write_volume(folder / "ct.nii.gz", Volume(volume.hu + 1024, volume.ras_from_ijk))
    check_refused(
        folder, InputRefused, r"shows no air in HU \(its lowest percent starts at 24\) and cannot be .* state ct_slope"
    )


def test_image_with_a_voxel_that_is_not_a_number_is_refused(folder):
    image = nibabel.load(folder / "cbct_deflated.nii.gz")
    values = np.asarray(image.dataobj, dtype=np.float32)
    values[3, 3, 3] = np.nan
    nibabel.save(nibabel.Nifti1Image(values, image.affine), folder / "cbct_deflated.nii.gz")
    check_refused(folder, InputRefused, r"cbct_deflated\.nii\.gz has 1 voxels that are not finite numbers")


def test_nodule_elsewhere_is_refused(folder):
    away = grid_at((500.0, 0, 0), spacing=2.0)
    write_mask(folder / "nodule.nii.gz", ball(away, centre=[500.0, 0, 0]))
    check_refused(folder, InputRefused, r"nodule\.nii\.gz lies outside the CT; draw the mask in the CT's frame")
    point(folder / "nodule_ct.mrk.json", [500.0, 0, 0])
    write_toml(folder, nodule={"point": "nodule_ct.mrk.json"})
    check_refused(folder, InputRefused, r"nodule_ct\.mrk\.json lies outside the CT; save the point in the CT's frame")


def test_nodule_point_far_from_its_mask_is_refused(folder):
    point(folder / "nodule_ct.mrk.json", -CENTRE)
    write_toml(folder, nodule={"mask": "nodule.nii.gz", "point": "nodule_ct.mrk.json"})
    check_refused(folder, InputRefused, r"lies \d+ mm off the nodule mask nodule\.nii\.gz; keep the right one")


def test_nodule_point_list_of_two_is_refused(folder):
    point(folder / "nodule_ct.mrk.json", CENTRE, CENTRE)
    write_toml(folder, nodule={"point": "nodule_ct.mrk.json"})
    check_refused(folder, InputRefused, "holds 2 points, one needed; keep the nodule's centre")


def test_two_nodules_are_refused(folder):
    both = ball(grid_at()).inside | ball(grid_at(), centre=-CENTRE).inside
    write_mask(folder / "nodule.nii.gz", Mask(both, grid_at().ras_from_ijk))
    check_refused(folder, InputRefused, "shows 2 separate regions, the largest of .*; keep one nodule per case")


def test_mask_between_the_voxels_of_the_ct_is_refused(folder):
    centre = grid_at().to_ras(np.array([5.5, 5.5, 5.5]))
    write_mask(folder / "nodule.nii.gz", ball(grid_at(centre, spacing=0.5), centre=centre, radius=1.0))
    check_refused(folder, InputRefused, "falls between them; draw it on the CT's grid")


def test_deflated_surface_in_another_frame_is_refused(folder):
    write_stl(folder / "deflated.stl", np.array([[-90.0, 0, 0], [-80, 0, 0], [-90, 30, 0]]), np.array([[0, 1, 2]]))
    write_toml(folder, hints={"deflated_surface": "deflated.stl"})
    check_refused(
        folder, InputRefused, "0 % of its points inside the deflated CBCT, 90 % needed; save it in LPS millimetres"
    )


@pytest.mark.parametrize(("spacing", "length", "is_chest"), [(10.0, 14, True), (1.0, 14, False), (10.0, 310, False)])
def test_an_image_whose_longest_side_is_no_chest_s_is_refused(
    tmp_path: Path, spacing: float, length: int, is_chest: bool
) -> None:
    """Three voxels high: a scan may be flat."""
    grid, path = grid_at(spacing=spacing, n=(length, 12, 3)), tmp_path / "flat.nii.gz"
    hu = np.where(np.arange(length)[:, None, None] < 5, -900, 40) * np.ones(grid.shape)
    write_volume(path, Volume(hu.astype(np.float32), grid.ras_from_ijk))
    if is_chest:
        assert _read_image(path, None)[0].hu.shape == grid.shape
    else:
        with pytest.raises(InputRefused, match=r"measures .* mm, which no image of a chest does"):
            _read_image(path, None)
