"""A nodule from DICOM Segmentation or RT Structure Set: every voxel in its place on the CT, and each refusal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pydicom.dataset import Dataset
from pydicom.uid import generate_uid

from registration.volume import Grid
from tests.vatsloc.case_scene import ball, chest, grid_at, write_toml
from tests.vatsloc.dicom_drawn import OBLIQUE, blob, grid, rectangle, segmentation, structures, written
from tests.vatsloc.dicom_made import FRAME, ct_slice, save
from vatsloc.case import read_case
from vatsloc.errors import InputRefused
from vatsloc.formats.dicom.contours import even_odd
from vatsloc.formats.dicom.regions import holds_regions, read_regions
from vatsloc.formats.images import read_mask, stated_frame
from vatsloc.formats.nifti import write_volume
from vatsloc.frames import flip_affine


@pytest.mark.parametrize("kind", ["BINARY", "FRACTIONAL", "LABELMAP"])
@pytest.mark.parametrize("axes", [np.eye(3), OBLIQUE], ids=["axial", "oblique"])
def test_segments_keep_their_voxels_names_and_numbers(tmp_path, kind, axes):
    on = grid(axes)
    nodule, lung = blob(on, (2, 5), (3, 6), (2, 4)), blob(on, (7, 11), (1, 9), (1, 7))
    lung[9, 4, 3] = False
    path = written(segmentation(on, {"lung": lung, "nodule": nodule}, kind), tmp_path / "seg.dcm")
    image = read_regions(path, frame_of_reference=FRAME)
    assert [(s.label, s.name, s.layer) for s in image.segments] == [(1, "lung", 0), (2, "nodule", 0)]
    for label, inside in ((1, lung), (2, nodule)):
        own = Grid(image.values.shape, image.ras_from_ijk)
        points = own.to_ras(np.argwhere(image.values == label).astype(float))
        assert_allclose(on.to_ijk(points), np.argwhere(inside), atol=1e-4)


def test_gaps_between_slices_of_a_segment_stay(tmp_path):
    on = grid()
    inside = blob(on, (2, 5), (3, 6), (1, 7))
    inside[:, :, 3:5] = False
    image = read_regions(written(segmentation(on, {"nodule": inside}), tmp_path / "seg.dcm"))
    assert_array_equal(image.values.any(axis=(0, 1)), [False, True, True, False, False, True, True, False])


def test_segments_that_overlap_lie_in_layers(tmp_path):
    on = grid()
    lung, nodule, vessel = (
        blob(on, (1, 9), (1, 9), (1, 7)),
        blob(on, (2, 5), (3, 6), (2, 4)),
        blob(on, (9, 11), (1, 3), (1, 2)),
    )
    ds = segmentation(on, {"lung": lung, "nodule": nodule, "vessel": vessel})
    image = read_regions(written(ds, tmp_path / "seg.dcm"))
    assert [(s.label, s.layer) for s in image.segments] == [(1, 0), (2, 1), (3, 0)]
    assert image.values.shape[3] == 2
    for segment, inside in zip(image.segments, (lung, nodule, vessel), strict=True):
        assert (image.values[..., segment.layer] == segment.label).sum() == inside.sum()


def test_one_slice_has_a_thickness(tmp_path):
    on = grid()
    mask = read_mask(written(segmentation(on, {"nodule": blob(on, (2, 5), (3, 6), (4, 5))}), tmp_path / "seg.dcm"))
    assert_allclose(mask.grid.spacing, [2, 1.5, 3], atol=1e-6)
    assert mask.inside.sum() == 9


@pytest.mark.parametrize(
    ("stated", "thick"),
    [
        ({"SpacingBetweenSlices": 3, "SliceThickness": 5}, 3.0),
        ({"SliceThickness": 5}, 5.0),
        ({"SpacingBetweenSlices": 0, "SliceThickness": 5}, 5.0),
    ],
)
def test_one_slice_is_as_thick_as_slices_are_apart_or_else_as_stated(tmp_path, stated, thick):
    on = grid()
    ds = segmentation(on, {"nodule": blob(on, (2, 5), (3, 6), (4, 5))})
    measures = ds.SharedFunctionalGroupsSequence[0].PixelMeasuresSequence[0]
    del measures.SpacingBetweenSlices
    for name, value in stated.items():
        setattr(measures, name, value)
    assert read_mask(written(ds, tmp_path / "seg.dcm")).grid.spacing[2] == pytest.approx(thick)


@pytest.mark.parametrize(("stated", "between"), [(3.0, 3.0), (2.0, 2.0), (4.0, 6.0), (6.0, 6.0)])
def test_slices_lie_apart_as_stated_where_frames_lie_on_such_slices_and_else_as_the_frames(tmp_path, stated, between):
    """Two frames 6 mm apart, with one empty slice between them where 3 mm are stated and two where 2 mm are."""
    on = grid()
    ds = segmentation(on, {"nodule": blob(on, (2, 5), (3, 6), (2, 3)) | blob(on, (2, 5), (3, 6), (4, 5))})
    ds.SharedFunctionalGroupsSequence[0].PixelMeasuresSequence[0].SpacingBetweenSlices = stated
    mask = read_mask(written(ds, tmp_path / "seg.dcm"))
    assert mask.grid.spacing[2] == pytest.approx(between)
    assert mask.inside.sum() == 18


def test_one_slice_without_a_thickness_is_refused(tmp_path):
    on = grid()
    ds = segmentation(on, {"nodule": blob(on, (2, 5), (3, 6), (4, 5))})
    del ds.SharedFunctionalGroupsSequence[0].PixelMeasuresSequence[0].SpacingBetweenSlices
    with pytest.raises(InputRefused, match="states no SpacingBetweenSlices"):
        read_mask(written(ds, tmp_path / "seg.dcm"))


def test_contours_are_filled_by_even_odd(tmp_path):
    on = grid()
    loops = [rectangle(on, (2, 9), (1, 8), k) for k in (2, 3, 4)] + [rectangle(on, (4, 6), (3, 5), 3)]
    path = written(structures({"lung": [rectangle(on, (0, 2), (0, 2), 1)], "nodule": loops}), tmp_path / "rs.dcm")
    image = read_regions(path, on, FRAME)
    inside = blob(on, (2, 9), (1, 8), (2, 5))
    inside[4:6, 3:5, 3] = False
    assert [(s.label, s.name) for s in image.segments] == [(1, "lung"), (2, "nodule")]
    assert_array_equal(image.values, 2 * inside + blob(on, (0, 2), (0, 2), (1, 2)))


def test_contours_follow_the_slices_of_any_grid(tmp_path):
    on = grid(OBLIQUE)
    stored = Grid((on.shape[2], on.shape[0], on.shape[1]), on.ras_from_ijk[:, [2, 0, 1, 3]])
    path = written(structures({"nodule": [rectangle(on, (2, 9), (1, 8), k) for k in (2, 3)]}), tmp_path / "rs.dcm")
    for over, order in ((on, (0, 1, 2)), (stored, (2, 0, 1))):
        expected = blob(on, (2, 9), (1, 8), (2, 4)).transpose(order)
        assert_array_equal(read_regions(path, over, FRAME).values == 1, expected)


def test_contours_on_every_third_slice_fill_those_between(tmp_path):
    on = grid(n=(12, 10, 14))
    loops = [rectangle(on, (2, 2 + width), (1, 8), k) for k, width in ((3, 3), (6, 5), (9, 7))]
    image = read_regions(written(structures({"nodule": loops}), tmp_path / "rs.dcm"), on)
    widths = image.values.any(axis=1).sum(axis=0)
    assert_array_equal(widths, [0, 0, 3, 3, 3, 5, 5, 5, 7, 7, 7, 0, 0, 0])


def test_even_odd_against_a_circle_and_its_area():
    """Pixels whose centres lie within 20 of the middle, by distance; Gauss's circle problem gives 1257 of them."""
    turn = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    inside = even_odd([20.001 * np.column_stack([np.cos(turn), np.sin(turn)]) + 25], (51, 51))
    u, v = np.mgrid[:51, :51] - 25
    assert_array_equal(inside, u**2 + v**2 <= 400)
    assert inside.sum() == 1257


def test_loops_that_leave_the_image_are_cut_off():
    loop = np.array([[-5.0, -5], [-5, 3.5], [2.5, 3.5], [2.5, -5]])
    assert_array_equal(np.argwhere(even_odd([loop], (6, 6))), [(u, v) for u in range(3) for v in range(4)])
    assert not even_odd([loop + 20], (6, 6)).any()


def test_kinds_are_told_apart(tmp_path):
    on = grid()
    (tmp_path / "note.dcm").write_text("nothing")
    assert holds_regions(written(structures({"a": [rectangle(on, (2, 4), (2, 4), 2)]}), tmp_path / "rs.dcm"))
    assert holds_regions(written(segmentation(on, {"a": blob(on, (2, 5), (3, 6), (2, 4))}), tmp_path / "seg.dcm"))
    assert not holds_regions(written(ct_slice(np.eye(3), 0), tmp_path / "ct.dcm"))
    assert not holds_regions(tmp_path / "note.dcm")
    assert not holds_regions(tmp_path)
    assert not holds_regions(tmp_path / ("x" * 300))


OTHER = generate_uid()
NODULE = {"nodule": blob(grid(), (2, 5), (3, 6), (2, 4))}
OUTLINE = {"nodule": [rectangle(grid(), (2, 5), (3, 6), 2)]}


def changed(ds: Dataset, change) -> Dataset:
    change(ds)
    return ds


@pytest.mark.parametrize(
    ("ds", "sentence"),
    [
        (segmentation(grid(), NODULE, frame=OTHER), "another frame of reference"),
        (structures(OUTLINE, frame=OTHER), "another frame of reference"),
        (structures(OUTLINE, kind="POINT"), "holds no closed contours; draw the nodule's outline"),
        (structures({}), "holds no closed contours"),
        (
            structures({"nodule": [rectangle(grid(), (2, 5), (3, 6), 2) + np.outer([0, 2, 0, 2], [0, 0, 1])]}),
            r"structure nodule, has contours that cross slices of the CT by up to 0\.67 voxels",
        ),
        (
            changed(structures(OUTLINE), lambda ds: ds.ROIContourSequence[0].ContourSequence[0].ContourData.pop()),
            "states ContourData = .*12 numbers needed",
        ),
        (
            changed(segmentation(grid(), NODULE), lambda ds: setattr(ds.SegmentSequence[0], "SegmentNumber", 4)),
            r"SegmentSequence = segments \[4\], \[1\] by its frames needed",
        ),
        (
            changed(
                segmentation(grid(), NODULE),
                lambda ds: delattr(ds.PerFrameFunctionalGroupsSequence[1], "SegmentIdentificationSequence"),
            ),
            "states no segment for frame 2",
        ),
        (
            changed(
                segmentation(grid(), {"nodule": blob(grid(), (2, 5), (3, 6), (2, 6))}),
                lambda ds: setattr(
                    ds.PerFrameFunctionalGroupsSequence[1].PlanePositionSequence[0],
                    "ImagePositionPatient",
                    [-40, 23, 112],
                ),
            ),
            r"frames that lie 1\.00 mm off a lattice of 3 mm",
        ),
        (changed(segmentation(grid(), NODULE), lambda ds: setattr(ds, "PixelData", b"\0\0")), "cannot be decoded"),
    ],
)
def test_refusals(tmp_path, ds, sentence):
    with pytest.raises(InputRefused, match=sentence):
        read_regions(written(ds, tmp_path / "drawn.dcm"), grid(), FRAME)


def test_unknown_frames_of_reference_are_not_compared(tmp_path):
    path = written(segmentation(grid(), NODULE, frame=OTHER), tmp_path / "seg.dcm")
    assert read_regions(path, grid(), "").values.any()


def test_a_structure_set_needs_a_ct(tmp_path):
    with pytest.raises(InputRefused, match="only a CT gives voxels"):
        read_mask(written(structures(OUTLINE), tmp_path / "rs.dcm"))


@pytest.fixture
def folder(tmp_path) -> Path:
    """A case whose CT is a DICOM folder with a localizer."""
    volume = chest(grid_at())
    slices = []
    lps = flip_affine(volume.ras_from_ijk)
    for k in range(volume.hu.shape[2]):
        ds = ct_slice(np.eye(3), k)
        ds.Columns, ds.Rows = volume.hu.shape[:2]
        ds.PixelSpacing = [10, 10]
        ds.ImagePositionPatient = (lps[:3, 3] + k * lps[:3, 2]).tolist()
        ds.PixelData = (volume.hu[:, :, k].T + 1024).astype("<i2").tobytes()
        slices.append(ds)
    scout = ct_slice(np.eye(3), 0)
    scout.ImageType = ["ORIGINAL", "PRIMARY", "LOCALIZER"]
    save(tmp_path / "ct", [*slices, scout])
    for name, centre in (("cbct_inflated", (30.0, 0, 0)), ("cbct_deflated", (35.0, 5, 0))):
        write_volume(tmp_path / f"{name}.nii.gz", chest(grid_at(centre, n=(14, 14, 12))))
    return tmp_path


def write_case(folder: Path, label: int | str | None = None, **images: object) -> None:
    files = {"ct": "ct", "cbct_inflated": "cbct_inflated.nii.gz", "cbct_deflated": "cbct_deflated.nii.gz"}
    nodule = {"mask": "nodule.dcm"} if label is None else {"mask": "nodule.dcm", "label": label}
    write_toml(folder, images={**files, **images}, nodule=nodule)


@pytest.mark.parametrize("kind", ["SEG", "RTSTRUCT"])
def test_a_nodule_drawn_in_dicom_lies_where_it_was_drawn(folder, kind):
    inside = ball(grid_at()).inside
    if kind == "SEG":
        written(segmentation(grid_at(), {"nodule": inside}), folder / "nodule.dcm")
    else:
        i, j, k = (np.flatnonzero(inside.any(axis=tuple({0, 1, 2} - {axis}))) for axis in range(3))
        loops = [rectangle(grid_at(), (i[0], i[-1] + 1), (j[0], j[-1] + 1), at) for at in k]
        written(structures({"nodule": loops}), folder / "nodule.dcm")
        inside = blob(grid_at(), (i[0], i[-1] + 1), (j[0], j[-1] + 1), (k[0], k[-1] + 1))
    write_case(folder)
    case = read_case(folder)
    assert case.nodule.mask is not None
    assert_array_equal(case.nodule.mask.inside, inside)
    assert_allclose(case.nodule.centre_ras, grid_at().points()[inside].mean(axis=0), atol=1e-4)
    assert case.warnings == ("ct: left out as localizer: IM016.",)


def test_a_nodule_of_another_ct_is_refused(folder):
    written(segmentation(grid_at(), {"nodule": ball(grid_at()).inside}, frame=OTHER), folder / "nodule.dcm")
    write_case(folder)
    assert stated_frame(folder / "ct") == FRAME
    with pytest.raises(InputRefused, match="another frame of reference"):
        read_case(folder)


def test_the_series_of_an_image_is_named_in_the_case_file(folder):
    written(segmentation(grid_at(), {"nodule": ball(grid_at()).inside}), folder / "nodule.dcm")
    other = [ct_slice(np.eye(3), k) for k in range(4)]
    for ds in other:
        ds.SeriesInstanceUID, ds.SeriesNumber = OTHER, 3
    for n, ds in enumerate(other):
        written(ds, folder / "ct" / f"OTHER{n}")
    write_case(folder)
    with pytest.raises(InputRefused, match=r"holds 2 series: .*ct_series"):
        read_case(folder)
    uid = other[0].SeriesInstanceUID
    write_case(folder, ct_series=ct_slice(np.eye(3), 0).SeriesInstanceUID)
    assert_allclose(read_case(folder).ct.hu, chest(grid_at()).hu)
    assert f"ct: left out as another series: {uid} (number 3, 4 slices, CT)." in read_case(folder).warnings
    write_case(folder, ct_series=3)
    with pytest.raises(InputRefused):
        read_case(folder)  # that one shows no chest


@pytest.mark.parametrize("label", [2, "nodule", "Nodule"])
@pytest.mark.parametrize("kind", ["SEG", "RTSTRUCT"])
def test_the_nodule_is_chosen_by_its_label(folder, kind, label):
    """Of a lung that it lies in."""
    lung, nodule = blob(grid_at(), (2, 9), (3, 15), (2, 14)), blob(grid_at(), (4, 6), (8, 10), (6, 9))
    if kind == "SEG":
        written(segmentation(grid_at(), {"lung": lung, "nodule": nodule}), folder / "nodule.dcm")
    else:
        outlines = {
            "lung": [rectangle(grid_at(), (2, 9), (3, 15), k) for k in range(2, 14)],
            "nodule": [rectangle(grid_at(), (4, 6), (8, 10), k) for k in range(6, 9)],
        }
        written(structures(outlines), folder / "nodule.dcm")
    write_case(folder)
    with pytest.raises(
        InputRefused, match=r"holds 2 regions: 1 \(lung\) with 1008 voxels, 2 \(nodule\) with 12 voxels"
    ):
        read_case(folder)
    write_case(folder, label)
    case = read_case(folder)
    assert case.nodule.mask is not None
    assert_array_equal(case.nodule.mask.inside, nodule)
