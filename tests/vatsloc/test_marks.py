"""The nodule as users mark it: label images, segmentations, cropped masks, points; and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from registration.volume import Grid, Mask
from tests.vatsloc.case_scene import CENTRE, ball, check_refused, grid_at, point, whole_case, write_toml
from vatsloc.case import read_case
from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.images import read_mask, read_region
from vatsloc.formats.markups import PointList, write_points
from vatsloc.formats.nifti import nifti_image, save_nifti, write_mask
from vatsloc.frames import flip_affine
from vatsloc.marks import NoduleSource, read_nodule

LUNG = np.array([-40.0, 0, 0])


@pytest.fixture
def folder(tmp_path) -> Path:
    return whole_case(tmp_path)


def label_map(path: Path, *masks: Mask) -> None:
    """A label image: 1 where the first mask is, 2 where the second, ..."""
    labels = np.zeros(masks[0].inside.shape, dtype=np.uint8)
    for value, mask in enumerate(masks, start=1):
        labels[mask.inside] = value
    save_nifti(nifti_image(labels, masks[0].ras_from_ijk), path)


def seg_nrrd(path: Path, layers: np.ndarray, grid: Grid, *segments: dict[str, object]) -> None:
    """A Slicer segmentation: layers (n, ni, nj, nk), n = 1 stored without the axis, segments as Slicer names them."""
    lps = flip_affine(grid.ras_from_ijk)
    vectors = " ".join(f"({','.join(repr(float(v)) for v in lps[:3, m])})" for m in range(3))
    n = len(layers)
    lines = [
        "NRRD0004",
        "type: unsigned char",
        f"dimension: {4 if n > 1 else 3}",
        "space: left-posterior-superior",
        f"sizes: {f'{n} ' if n > 1 else ''}{' '.join(map(str, grid.shape))}",
        f"space directions: {'none ' if n > 1 else ''}{vectors}",
        f"kinds: {'list ' if n > 1 else ''}domain domain domain",
        "encoding: raw",
        f"space origin: ({','.join(repr(float(v)) for v in lps[:3, 3])})",
        *(f"Segment{m}_{key}:={value}" for m, segment in enumerate(segments) for key, value in segment.items()),
    ]
    stored = layers if n > 1 else layers[0]
    path.write_bytes(("\n".join(lines) + "\n\n").encode() + stored.astype(np.uint8).tobytes(order="F"))


def nodule_of(path: Path, grid: Grid, label: int | str | None = None) -> tuple[Mask, np.ndarray, list[str]]:
    warnings: list[str] = []
    nodule = read_nodule(NoduleSource(path, label), grid, warnings)
    assert nodule.mask is not None
    return nodule.mask, nodule.centre_ras, warnings


def test_a_label_map_without_a_label_is_refused_and_listed(folder):
    lung, nodule = ball(grid_at(), LUNG, 40.0), ball(grid_at())
    label_map(folder / "nodule.nii.gz", lung, nodule)
    counts = f"1 with {lung.inside.sum()} voxels, 2 with {nodule.inside.sum()} voxels"
    check_refused(folder, InputRefused, rf"holds 2 regions: {counts}; say which is meant: \[nodule\] label = \.\.\.")


def test_the_label_chooses_the_nodule(folder):
    label_map(folder / "nodule.nii.gz", ball(grid_at(), LUNG, 40.0), ball(grid_at()))
    write_toml(folder, nodule={"mask": "nodule.nii.gz", "label": 2})
    nodule = read_case(folder).nodule
    assert nodule.mask is not None
    assert np.array_equal(nodule.mask.inside, ball(grid_at()).inside)
    assert_allclose(nodule.centre_ras, grid_at().points()[ball(grid_at()).inside].mean(axis=0), atol=1e-4)
    write_toml(folder, nodule={"mask": "nodule.nii.gz", "label": 3})
    check_refused(
        folder, InputRefused, "holds nothing of label 3 among 1 with .* voxels, 2 with .* voxels; name one of these"
    )


def test_one_label_of_any_value_needs_no_name_and_many_are_listed_shortly(tmp_path):
    values = np.zeros((4, 4, 4), dtype=np.int16)
    values[1:3, 1:3, 1:3] = 255
    save_nifti(nifti_image(values, np.eye(4)), tmp_path / "one.nii.gz")
    assert np.array_equal(read_region(tmp_path / "one.nii.gz").inside, values > 0)
    values.ravel()[:12] = np.arange(12)
    save_nifti(nifti_image(values, np.eye(4)), tmp_path / "many.nii.gz")
    with pytest.raises(InputRefused, match=r"holds 12 regions: 1 with 1 voxels, .* 8 with 1 voxels and 4 more; say"):
        read_region(tmp_path / "many.nii.gz")
    assert read_mask(tmp_path / "many.nii.gz").inside.sum() == (values > 0).sum()
    assert read_region(tmp_path / "many.nii.gz", [1, 3, 255]).inside.sum() == 2 + (values == 255).sum()


def test_shares_of_voxels_are_a_mask_and_other_fractions_are_not(tmp_path):
    shares = np.zeros((3, 3, 3), dtype=np.float32)
    shares[0, 0] = [0.4, 0.5, 1.0]
    save_nifti(nifti_image(shares, np.eye(4)), tmp_path / "shares.nii.gz")
    for label in (None, 1, (1,)):
        assert np.argwhere(read_region(tmp_path / "shares.nii.gz", label).inside).tolist() == [[0, 0, 1], [0, 0, 2]]
    save_nifti(nifti_image(shares * 5, np.eye(4)), tmp_path / "smeared.nii.gz")
    with pytest.raises(InputRefused, match="values up to 5 that are no whole numbers, so neither labels nor shares"):
        read_region(tmp_path / "smeared.nii.gz")


@pytest.mark.parametrize(("label", "value"), [("nodule", 2), ("NODULE ", 2), ("Lung, right", 1), (2, 2), ("2", 2)])
def test_segments_of_slicer_go_by_name_or_number(tmp_path, label, value):
    labels = np.zeros((1, 6, 6, 6), dtype=np.uint8)
    labels[0, :4], labels[0, 2, 2, 2:4] = 1, 2
    segments = {"Name": "Lung, right", "LabelValue": 1, "Layer": 0}, {"Name": "nodule", "LabelValue": 2, "Layer": 0}
    seg_nrrd(tmp_path / "s.seg.nrrd", labels, Grid((6, 6, 6), np.eye(4)), *segments)
    assert np.array_equal(read_region(tmp_path / "s.seg.nrrd", label).inside, labels[0] == value)
    sentence = r"holds 2 regions: 1 \(Lung, right\) with 142 voxels, 2 \(nodule\) with 2 voxels; say which"
    with pytest.raises(InputRefused, match=sentence):
        read_region(tmp_path / "s.seg.nrrd")
    with pytest.raises(InputRefused, match="holds nothing of label 'tumour' among"):
        read_region(tmp_path / "s.seg.nrrd", "tumour")


def test_overlapping_segments_lie_in_layers(tmp_path):
    """The nodule overlaps the lung: both have value 1, each in a layer of its own."""
    layers = np.zeros((2, 6, 6, 6), dtype=np.uint8)
    layers[0, :4], layers[1, 2:5, 2, 2] = 1, 1
    grid = Grid((6, 6, 6), np.diag([-1.0, -2, 3, 1]))
    segments = {"Name": "lung", "LabelValue": 1, "Layer": 0}, {"Name": "nodule", "LabelValue": 1, "Layer": 1}
    seg_nrrd(tmp_path / "s.seg.nrrd", layers, grid, *segments)
    nodule = read_region(tmp_path / "s.seg.nrrd", "nodule")
    assert np.array_equal(nodule.inside, layers[1] == 1)
    assert_allclose(nodule.ras_from_ijk, grid.ras_from_ijk)
    assert np.array_equal(read_mask(tmp_path / "s.seg.nrrd").inside, (layers == 1).any(axis=0))
    with pytest.raises(InputRefused, match="holds 2 regions of label 1 among"):
        read_region(tmp_path / "s.seg.nrrd", 1)
    old = {"Name": "lung"}, {"Name": "nodule"}  # Slicer 4.10: neither values nor layers
    seg_nrrd(tmp_path / "old.seg.nrrd", layers, grid, *old)
    assert np.array_equal(read_region(tmp_path / "old.seg.nrrd", "nodule").inside, layers[1] == 1)


@pytest.mark.parametrize("value", [1, 2])
def test_two_segments_of_one_value_in_one_layer_are_refused(tmp_path, value):
    """The lung would be read in the nodule's place."""
    labels = np.zeros((1, 6, 6, 6), dtype=np.uint8)
    labels[0, :4], labels[0, 2, 2, 2:4] = 1, 2
    segments = [{"Name": name, "LabelValue": value, "Layer": 0} for name in ("lung", "nodule")]
    seg_nrrd(tmp_path / "s.seg.nrrd", labels, Grid((6, 6, 6), np.eye(4)), *segments)
    with pytest.raises(InputRefused, match=f'gives segments "lung" and "nodule" the same value {value} in one layer'):
        read_region(tmp_path / "s.seg.nrrd", "nodule")


def test_a_segmentation_without_voxels_is_refused(tmp_path):
    seg_nrrd(tmp_path / "s.seg.nrrd", np.zeros((1, 1, 1, 1)), Grid((1, 1, 1), np.eye(4)), {"Name": "nodule"})
    with pytest.raises(InputRefused, match="a segmentation without voxels; draw the region"):
        read_region(tmp_path / "s.seg.nrrd")


OBLIQUE_CT = Grid((40, 36, 30), grid_at().ras_from_ijk @ np.diag([0.07, 0.07, 0.1, 1.0]))


@pytest.mark.parametrize("rounding", [0.0, 1e-7, -1e-7, 1e-4])
@pytest.mark.parametrize("size", [1, 2, 3])
def test_a_segmentation_cropped_to_its_segment_keeps_its_outer_voxels(tmp_path, rounding, size):
    """27 voxels stay 27, wherever rounding puts the cropped file's corner; the centre stays to a hundredth of a mm."""
    start = np.array([20, 12, 9])
    affine = OBLIQUE_CT.ras_from_ijk.copy()
    affine[:3, 3] = OBLIQUE_CT.to_ras(start.astype(float)) + rounding * np.array([1.0, -1.0, 1.0])
    write_mask(tmp_path / "n.nii.gz", Mask(np.ones((size,) * 3, dtype=bool), affine))
    mask, centre, warnings = nodule_of(tmp_path / "n.nii.gz", OBLIQUE_CT)
    expected = np.zeros(OBLIQUE_CT.shape, dtype=bool)
    expected[tuple(slice(s, s + size) for s in start)] = True
    assert np.array_equal(mask.inside, expected)
    assert_allclose(centre, OBLIQUE_CT.to_ras(start + (size - 1) / 2), atol=0.01)
    assert warnings == []


def test_a_finer_cropped_mask_keeps_its_volume_and_centre(tmp_path):
    """A box of 12 mm on voxels of 1.5 mm, cropped to itself, on a CT of 1 mm: 12 x 12 x 12 voxels about its middle."""
    ct = Grid((40, 40, 40), np.diag([1.0, 1, 1, 1]))
    affine = np.diag([1.5, 1.5, 1.5, 1.0])
    affine[:3, 3] = 10.25  # its first voxel begins at 9.5, where one of the CT's does
    write_mask(tmp_path / "n.nii.gz", Mask(np.ones((8, 8, 8), dtype=bool), affine))
    mask, centre, _ = nodule_of(tmp_path / "n.nii.gz", ct)
    assert mask.inside.sum() == 12**3
    assert_allclose(centre, [15.5, 15.5, 15.5], atol=1e-6)


def test_what_lies_beyond_the_ct_is_said(tmp_path):
    ct = Grid((20, 20, 20), np.eye(4))
    affine = np.eye(4)
    affine[0, 3] = -3.0
    write_mask(tmp_path / "n.nii.gz", Mask(np.ones((10, 5, 5), dtype=bool), affine))
    mask, _, warnings = nodule_of(tmp_path / "n.nii.gz", ct)
    assert mask.inside.sum() == 7 * 25
    assert warnings == ["n.nii.gz: 30 % of the region lies outside the CT and was cut off."]


def test_a_mask_as_large_as_a_lung_is_no_nodule(folder):
    write_mask(folder / "nodule.nii.gz", ball(grid_at(), LUNG, 50.0))
    check_refused(
        folder, InputRefused, r"marks \d+ ml, 100 x 100 x 100 mm, up to 250 ml expected of a nodule; draw the nodule"
    )


@pytest.mark.parametrize("status", ["undefined", "preview", "missing"])
def test_points_never_placed_are_left_out_and_said(folder, status):
    point(folder / "p.mrk.json", CENTRE, CENTRE + 30)
    content = json.loads((folder / "p.mrk.json").read_text())
    content["markups"][0]["controlPoints"][1]["positionStatus"] = status
    (folder / "p.mrk.json").write_text(json.dumps(content))
    write_toml(folder, nodule={"point": "p.mrk.json"})
    case = read_case(folder)
    assert_allclose(case.nodule.centre_ras, CENTRE)
    assert case.warnings == ("p.mrk.json: L1 was never placed and was left out.",)


def test_a_point_in_metres_is_refused(folder):
    point(folder / "p.mrk.json", CENTRE / 1000)
    write_toml(folder, nodule={"point": "p.mrk.json"})
    check_refused(
        folder, InputRefused, r"a point at 0\.06, 0\.01, -0\.02 \(RAS\), which reads like metres; save it in mill"
    )


@pytest.mark.parametrize(("scale", "measured"), [(1e-3, "0.0707 x 0.0707 x 0.0707"), (100.0, "7.07e")])
def test_a_surface_of_another_size_is_refused(folder, scale, measured):
    """A sphere 100 mm wide, in metres and in hundredths: its corners measure 70.7 mm along each axis."""
    corners = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) * 50 / np.sqrt(2)
    write_points(folder / "s.mrk.json", PointList(corners * scale, tuple("abcdefgh")))
    write_toml(folder, hints={"deflated_surface": "s.mrk.json"})
    check_refused(folder, InputRefused, rf"measures {measured}.* mm, which no lung does; save it in millimetres")


@pytest.mark.parametrize(
    ("scale", "sentence"),
    [
        (1e-3, r"measures 0\.2 x 0\.18 x 0\.16 mm, which no image of a chest does; export it with its voxel size"),
        (1e3, r"has voxels of 10000 x 10000 x 10000 mm at .* mm; re-export it with its true size and place"),
    ],
)
def test_an_image_of_another_unit_is_refused(folder, scale, sentence):
    case = read_case(folder)
    affine = case.ct.ras_from_ijk @ np.diag([scale, scale, scale, 1])
    save_nifti(nifti_image(case.ct.hu.astype(np.int16), affine), folder / "ct.nii.gz")
    check_refused(folder, InputRefused, sentence)


def test_a_case_file_with_a_byte_order_mark_is_read(folder):
    plain = read_case(folder)
    text = (folder / "case.toml").read_text()
    (folder / "case.toml").write_text(text, encoding="utf-8-sig")
    assert (folder / "case.toml").read_bytes().startswith(b"\xef\xbb\xbf")
    assert read_case(folder).input_sha256 == plain.input_sha256


@pytest.mark.parametrize(
    ("nodule", "sentence"),
    [
        ({"point": "p.mrk.json", "label": 2}, r"\[nodule\] has a label but no mask; add the mask"),
        ({"mask": "nodule.nii.gz", "label": 0}, r"\[nodule\] label = 0 is no label; give the label's number, from 1"),
        ({"mask": "nodule.nii.gz", "label": ""}, r"\[nodule\] label = '' is no label"),
        ({"mask": "nodule.nii.gz", "label": [1, 2]}, r"\[nodule\] has 2 labels; keep one nodule per case"),
        ({"mask": "nodule.nii.gz", "lable": 2}, r"\[nodule\] lable is an unknown key; mask, point, label are known"),
    ],
)
def test_labels_that_are_none_are_refused(folder, nodule, sentence):
    write_toml(folder, nodule=nodule)
    check_refused(folder, CaseError, sentence)
