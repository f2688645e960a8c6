"""DICOM out: the objects lie on the scan's own slices, hold the right voxels and numbers, and are valid."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import highdicom as hd
import numpy as np
import pydicom
import pytest
from numpy.testing import assert_allclose
from pydicom.dataset import Dataset

from registration.volume import Mask
from tests.vatsloc import finding_scene as scene
from tests.vatsloc.dicom_scene import Ids, enhanced, write_series
from vatsloc.cli import main
from vatsloc.dicomout.export import SEG_FILE, SR_FILE, dicom_of_run, export_result
from vatsloc.dicomout.finding import finding_of
from vatsloc.dicomout.segmentation import ellipsoid_voxels, segments_on
from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.dicom.source import is_dicom, read_source
from vatsloc.formats.images import read_region
from vatsloc.frames import flip_points
from vatsloc.results import case_of

IDS = Ids()


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = scene.write_case_file(tmp_path_factory.mktemp("dicom") / "case")
    write_series(folder / "deflated", scene.scan(), IDS)
    return folder


@pytest.fixture(scope="module")
def result(case: Path) -> Path:
    data = scene.result(digest=scene.digest(case / "deflated"))
    return scene.write_result(case.parent / "result", case, data)


@pytest.fixture(scope="module")
def objects(result: Path) -> tuple[Path, Path]:
    seg, report = export_result(result, result.parent / "exported")
    assert (seg.name, report.name) == (SEG_FILE, SR_FILE)
    return seg, report


@pytest.fixture(scope="module")
def seg(objects: tuple[Path, Path]) -> hd.seg.Segmentation:
    return hd.seg.segread(objects[0])


@pytest.fixture(scope="module")
def report(objects: tuple[Path, Path]) -> hd.sr.Comprehensive3DSR:
    return hd.sr.srread(objects[1])


def slices(case: Path) -> list[Dataset]:
    found = [pydicom.dcmread(file) for file in (case / "deflated").iterdir()]
    return sorted(found, key=lambda ds: int(ds.InstanceNumber))


def test_segments_lie_on_the_slices_of_the_scan_voxel_for_voxel(case: Path, seg: hd.seg.Segmentation) -> None:
    source = slices(case)
    uids = [str(ds.SOPInstanceUID) for ds in source]
    pixels = seg.get_pixels_by_source_instance(
        uids, ignore_spatial_locations=False, assert_missing_frames_are_empty=True
    )
    names = [item.SegmentLabel for item in seg.SegmentSequence]
    assert names == ["nodule (predicted)", "95 % ellipsoid (predicted)", "collapsed lung (predicted)"]
    nodule = pixels[..., 0].transpose(2, 1, 0)  # slices, rows, columns
    np.testing.assert_array_equal(nodule, scene.ball(scene.NODULE, scene.NODULE_MM))
    away = (scene.grid().points() - scene.NODULE) @ scene.ellipsoid_axes().T / scene.SEMI_AXES
    np.testing.assert_array_equal(pixels[..., 1].transpose(2, 1, 0), (away**2).sum(axis=-1) <= 1)
    lung = pixels[..., 2].transpose(2, 1, 0).astype(bool)
    assert lung[scene.ball(scene.LUNG_CENTRE, scene.LUNG_MM - 1.5)].all()  # the mesh cuts corners off the ball
    assert not lung[~scene.ball(scene.LUNG_CENTRE, scene.LUNG_MM + 0.1)].any()


def test_every_frame_repeats_the_geometry_of_the_slice_it_refers_to(case: Path, seg: hd.seg.Segmentation) -> None:
    by_uid = {str(ds.SOPInstanceUID): ds for ds in slices(case)}
    shared = seg.SharedFunctionalGroupsSequence[0]
    first = next(iter(by_uid.values()))
    assert shared.PlaneOrientationSequence[0].ImageOrientationPatient == first.ImageOrientationPatient
    assert shared.PixelMeasuresSequence[0].PixelSpacing == first.PixelSpacing
    assert (seg.Rows, seg.Columns, seg.FrameOfReferenceUID) == (first.Rows, first.Columns, IDS.frame)
    for frame in seg.PerFrameFunctionalGroupsSequence:
        (image,) = frame.DerivationImageSequence[0].SourceImageSequence
        position = by_uid[image.ReferencedSOPInstanceUID].ImagePositionPatient
        assert frame.PlanePositionSequence[0].ImagePositionPatient == position


def test_objects_belong_to_the_patient_and_study_and_name_the_algorithm(
    seg: hd.seg.Segmentation, report: hd.sr.Comprehensive3DSR
) -> None:
    for ds in (seg, report):
        assert (ds.PatientID, ds.PatientName, ds.StudyInstanceUID) == (IDS.patient, IDS.name, IDS.study)
        assert ds.SeriesInstanceUID != IDS.series
        assert ds.Manufacturer == "vatsloc"
    assert seg.SeriesInstanceUID != report.SeriesInstanceUID
    for item in seg.SegmentSequence:
        (algorithm,) = item.SegmentationAlgorithmIdentificationSequence
        assert (algorithm.AlgorithmName, algorithm.AlgorithmVersion) == ("vatsloc", "0.1.0")
        assert item.SegmentAlgorithmType == "AUTOMATIC"


def is_comment(item: Dataset) -> bool:
    return bool(item.ConceptNameCodeSequence[0].CodeValue == "121106")


def groups_of(report: hd.sr.Comprehensive3DSR, name: str) -> Dataset:
    """The volumetric measurement group whose finding has this code value."""
    groups = report.content.get_volumetric_roi_measurement_groups()
    (found,) = (group for group in groups if group.finding_type.value == name)
    return found


def judged(group: Dataset) -> dict[str, str]:
    """Qualitative evaluations; highdicom lists the algorithm's family among them."""
    found = {item.name.value: item.value.value for item in group.get_qualitative_evaluations()}
    assert found.pop("111000") == "123111"  # Algorithm Family: Deformable Models
    return found


def values(group: Dataset) -> dict[str, tuple[float, str]]:
    return {m.name.value: (float(m.value), m.unit.value) for m in group.get_measurements()}


def test_report_states_position_ellipsoid_depth_and_volume(
    report: hd.sr.Comprehensive3DSR, seg: hd.seg.Segmentation
) -> None:
    centre = groups_of(report, "nodule_centre")
    assert_allclose(centre.roi.graphic_data, flip_points(scene.NODULE)[None], atol=1e-3)
    assert centre.roi.frame_of_reference_uid == IDS.frame
    depth = scene.LUNG_MM - np.linalg.norm(scene.NODULE - scene.LUNG_CENTRE)  # of a ball; facets cut some off
    assert values(centre)["depth"] == (pytest.approx(depth, abs=0.8), "mm")
    assert values(centre)["depth"][0] > 0
    assert judged(centre) == {"trust": "passed"}
    ellipsoid = groups_of(report, "ellipsoid95")
    pairs = flip_points(ellipsoid.roi.graphic_data).reshape(3, 2, 3)
    assert_allclose(pairs.mean(axis=1), np.tile(scene.NODULE, (3, 1)), atol=1e-3)
    half = (pairs[:, 1] - pairs[:, 0]) / 2
    assert_allclose(half, scene.ellipsoid_axes() * scene.SEMI_AXES[:, None], atol=1e-3)
    assert [v for v, _ in values(ellipsoid).values()] == [9.0, 5.0, 3.0]
    nodule = groups_of(report, "27925004")
    ml = scene.ball(scene.NODULE, scene.NODULE_MM).sum() * scene.SPACING.prod() / 1000
    assert values(nodule)["118565006"] == (pytest.approx(ml, abs=6e-4), "ml")
    (referring,) = report.content.get_volumetric_roi_measurement_groups(
        referenced_sop_instance_uid=str(seg.SOPInstanceUID)
    )
    assert referring.tracking_uid == nodule.tracking_uid


def test_report_states_every_gate_with_value_limit_and_outcome(report: hd.sr.Comprehensive3DSR) -> None:
    (gates,) = report.content.get_image_measurement_groups()
    assert values(gates) == {
        "overlap_value": (0.9, "1"),
        "overlap_limit": (0.4, "1"),
        "surface_value": (3.5, "mm"),
        "surface_limit": (2.5, "mm"),
        "held_out_limit": (5.0, "mm"),
    }
    assert judged(gates) == {"overlap": "passed", "surface": "passed", "held_out": "passed"}
    texts = [item.TextValue for item in report.ContentSequence if is_comment(item)]
    assert texts == ["The hilum moved as a whole."]


def test_a_failed_gate_is_said_where_a_reader_looks(case: Path, tmp_path: Path) -> None:
    data = scene.result(failed=True, digest=scene.digest(case / "deflated"))
    seg_file, sr_file = export_result(scene.write_result(tmp_path / "result", case, data), tmp_path / "out")
    seg, report = pydicom.dcmread(seg_file), hd.sr.srread(sr_file)
    assert "DO NOT TRUST" in seg.SeriesDescription
    assert "DO NOT TRUST" in seg.ContentDescription
    assert judged(groups_of(report, "nodule_centre")) == {"trust": "failed"}
    texts = [item.TextValue for item in report.ContentSequence if is_comment(item)]
    assert texts[0] == "Do not trust: The surface stays off the observed one."


@pytest.mark.skipif(shutil.which("dciodvfy") is None, reason="dciodvfy (dicom3tools) is not installed")
@pytest.mark.parametrize("n", [0, 1])
def test_dciodvfy_finds_no_error(objects: tuple[Path, Path], n: int) -> None:
    said = subprocess.run(["dciodvfy", str(objects[n])], capture_output=True, text=True, check=False)
    lines = (said.stdout + said.stderr).splitlines()
    assert lines[-1:] or said.returncode == 0
    assert [line for line in lines if line.startswith("Error")] == []
    unexpected = [line for line in lines if line.startswith("Warning") and "<99VATSLOC>" not in line]
    assert unexpected == []


def test_our_own_reader_opens_the_segmentation(case: Path, objects: tuple[Path, Path]) -> None:
    found = read_region(objects[0], "nodule (predicted)", frame=IDS.frame)
    ours = np.argwhere(scene.ball(scene.NODULE, scene.NODULE_MM))
    centres = found.grid.to_ras(np.argwhere(found.inside))
    assert len(centres) == len(ours)
    assert_allclose(centres.mean(axis=0), scene.grid().to_ras(ours).mean(axis=0), atol=1e-3)


def test_frames_of_a_multi_frame_scan_are_referred_to_in_its_own_order(tmp_path: Path) -> None:
    case = scene.write_case_file(tmp_path / "case", "deflated.dcm")
    order = np.random.default_rng(5).permutation(scene.SHAPE[2]).tolist()
    enhanced(scene.scan(), IDS, order).save_as(case / "deflated.dcm", enforce_file_format=True)
    data = scene.result(digest=scene.digest(case / "deflated.dcm"))
    seg_file, _ = export_result(scene.write_result(tmp_path / "result", case, data), tmp_path / "out")
    seg = hd.seg.segread(seg_file)
    source = pydicom.dcmread(case / "deflated.dcm")
    frames = list(range(1, len(order) + 1))
    pixels = seg.get_pixels_by_source_frame(str(source.SOPInstanceUID), frames, assert_missing_frames_are_empty=True)
    expected = scene.ball(scene.NODULE, scene.NODULE_MM).transpose(2, 1, 0)[order]
    np.testing.assert_array_equal(pixels[..., 0].astype(bool), expected)


def test_a_result_in_other_voxel_order_goes_to_the_same_voxels(case: Path) -> None:
    """The case had the scan as a file stored otherwise, and the series is given by hand."""
    source = read_source(case / "deflated")
    inside, affine = scene.reorient_mask("SAR")
    finding = finding_of(scene.result())
    found = segments_on(replace(finding, nodule=Mask(inside, affine)), source.grid)
    np.testing.assert_array_equal(found["nodule"], scene.ball(scene.NODULE, scene.NODULE_MM))


def test_an_ellipsoid_smaller_than_a_voxel_keeps_the_voxel_it_lies_in() -> None:
    grid = scene.grid()
    inside = ellipsoid_voxels(grid, scene.NODULE, 0.1 * np.eye(3))
    (at,) = np.argwhere(inside)
    np.testing.assert_array_equal(at, np.rint(grid.to_ijk(scene.NODULE[None])[0]))
    out = grid.to_ras(np.array([[-30.0, 5, 5]]))[0]
    assert not ellipsoid_voxels(grid, out, 0.1 * np.eye(3)).any()


def test_a_long_oblique_ellipsoid_is_not_cut() -> None:
    axes = np.array([[1.0, 1, 1], [1, -1, 0], [1, 1, -2]]) / np.sqrt([[3], [2], [6]]) * [[25.0], [2.0], [2.0]]
    inside = ellipsoid_voxels(scene.grid(), scene.LUNG_CENTRE, axes)
    unit = axes / np.linalg.norm(axes, axis=1)[:, None]
    away = (scene.grid().points() - scene.LUNG_CENTRE) @ unit.T / [25.0, 2.0, 2.0]
    np.testing.assert_array_equal(inside, (away**2).sum(axis=-1) <= 1)


def test_another_series_a_changed_one_and_none_are_refused(case: Path, result: Path, tmp_path: Path) -> None:
    moved = scene.scan()
    affine = moved.ras_from_ijk.copy()
    affine[:3, 3] += [0.4, 0, 0]
    write_series(tmp_path / "moved", type(moved)(moved.hu, affine), IDS)
    with pytest.raises(InputRefused, match=r"corners up to 0\.40 mm apart; give the series of its deflated scan"):
        export_result(result, tmp_path / "out", tmp_path / "moved")
    other = scene.write_case_file(tmp_path / "case")
    write_series(other / "deflated", scene.scan(), IDS)  # the same scan with new instance UIDs
    copy = scene.write_result(tmp_path / "result", other, scene.result(digest=scene.digest(case / "deflated")))
    with pytest.raises(InputRefused, match="has changed since"):
        export_result(copy, tmp_path / "out")
    shutil.rmtree(other)
    with pytest.raises(CaseError, match="is not there any more; give the DICOM series"):
        export_result(copy, tmp_path / "out")
    (copy / "inputs.json").unlink()
    with pytest.raises(CaseError, match="does not name its case"):
        export_result(copy, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(CaseError, match="is no results folder"):
        export_result(case, tmp_path / "out")


def test_a_series_without_a_frame_of_reference_is_refused(tmp_path: Path) -> None:
    folder = write_series(tmp_path / "series", scene.scan(), IDS)
    file = sorted(folder.iterdir())[0]
    ds = pydicom.dcmread(file)
    del ds.FrameOfReferenceUID
    ds.save_as(file)
    with pytest.raises(InputRefused, match="states no FrameOfReferenceUID, so no object can refer to it"):
        read_source(folder)


def test_a_run_makes_objects_where_its_deflated_scan_is_dicom(case: Path, tmp_path: Path) -> None:
    objects, why = dicom_of_run(case, scene.result())
    assert (sorted(objects), why) == ([SR_FILE, SEG_FILE], "")
    other = scene.write_case_file(tmp_path / "nifti", "scan.nii.gz")
    (other / "scan.nii.gz").write_bytes(b"not looked into")
    assert dicom_of_run(other, scene.result()) == ({}, "")


def test_a_run_says_why_it_made_none(case: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vatsloc.dicomout.export.find_spec", lambda name: None)
    objects, why = dicom_of_run(case, scene.result())
    assert objects == {}
    assert why == 'DICOM output needs highdicom; install it by: pip install "vatsloc[dicom]".'


def test_the_command_prints_the_files_and_replaces_an_earlier_export(
    result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for _ in range(2):
        with pytest.raises(SystemExit) as ended:
            main(["export-dicom", str(result), "--out", str(tmp_path / "out")])
        assert ended.value.code == 0
    assert capsys.readouterr().out.splitlines() == [str(tmp_path / "out" / name) for name in (SEG_FILE, SR_FILE)] * 2


def test_a_result_knows_its_case_also_after_both_moved_together(case: Path, result: Path, tmp_path: Path) -> None:
    assert case_of(result) == case.resolve()
    scene.write_result(tmp_path / "a" / "result", tmp_path / "a" / "case", scene.result())
    (tmp_path / "a").rename(tmp_path / "b")
    assert case_of(tmp_path / "b" / "result") == (tmp_path / "b" / "case").resolve()


def test_is_dicom_tells_a_folder_of_slices_from_other_images(case: Path, tmp_path: Path) -> None:
    assert is_dicom(case / "deflated")
    assert is_dicom(next((case / "deflated").iterdir()))
    (tmp_path / "x.nii").write_bytes(bytes(400))
    assert not is_dicom(tmp_path)
    assert not is_dicom(tmp_path / "x.nii")
    assert not is_dicom(tmp_path / "absent")


@pytest.mark.parametrize(
    ("charset", "name", "sex"),
    [
        ("ISO_IR 100", "Müller^Jörg", "M"),
        ("ISO_IR 192", "Müller^Jörg", "F"),
        (["", "ISO 2022 IR 87"], "Yamada^Tarou=山田^太郎", "O"),
        ("ISO_IR 192", "Doe^Jane", "X"),
    ],
)
def test_patients_of_any_name_and_sex_get_their_objects(
    charset: str | list[str], name: str, sex: str, tmp_path: Path
) -> None:
    folder = write_series(tmp_path / "series", scene.scan(), IDS)
    for file in folder.iterdir():
        ds = pydicom.dcmread(file)
        ds.SpecificCharacterSet, ds.PatientName, ds.PatientSex = charset, name, sex
        ds.save_as(file)
    case = scene.write_case_file(tmp_path / "case")
    result = scene.write_result(tmp_path / "result", case, scene.result())
    for file in export_result(result, tmp_path / "out", folder):
        ds = pydicom.dcmread(file)
        assert str(ds.PatientName) == name
        assert ds.PatientSex == (sex if sex in "MFO" else "")
