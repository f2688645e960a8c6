"""Which files of a folder make the volume: localizers, reports, other series, DICOMDIR, projections, missing ends."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydicom.dataset import Dataset
from pydicom.sequence import Sequence
from pydicom.uid import (
    MediaStorageDirectoryStorage,
    XRay3DAngiographicImageStorage,
    XRayAngiographicImageStorage,
    generate_uid,
)

from tests.vatsloc.dicom_made import (
    COLUMN_MM,
    NI,
    NJ,
    NK,
    ROW_MM,
    SERIES,
    SLICE_MM,
    base,
    ct_slice,
    enhanced,
    hu_at,
    position,
    save,
    slice_hu,
)
from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.images import files_behind, read_volume, read_volume_and_warnings
from vatsloc.formats.nifti import write_volume

AXIAL = np.eye(3)
OTHER = generate_uid()


@pytest.fixture
def slices() -> list[Dataset]:
    found = [ct_slice(AXIAL, k) for k in range(NK)]
    for k, ds in enumerate(found):
        ds.InstanceNumber = k + 1
    return found


def localizer(uid: str = SERIES) -> Dataset:
    ds = ct_slice(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).T, 0)
    ds.ImageType, ds.SeriesInstanceUID, ds.InstanceNumber = ["ORIGINAL", "PRIMARY", "LOCALIZER"], uid, 1
    ds.Rows, ds.PixelData = 2, ds.PixelData[: 2 * 2 * NI]
    return ds


def report() -> Dataset:
    ds = base(AXIAL)
    ds.Modality = "SR"
    del ds.Rows, ds.Columns
    return ds


def projections() -> Dataset:
    ds = base(AXIAL, XRayAngiographicImageStorage)
    ds.Modality, ds.SeriesInstanceUID, ds.NumberOfFrames = "XA", OTHER, 4
    ds.PixelData = b"\0" * 2 * NI * NJ * 4
    return ds


def other_series(shift: float = 0.0) -> list[Dataset]:
    found = [ct_slice(AXIAL, k + shift) for k in range(4)]
    for ds in found:
        ds.SeriesInstanceUID, ds.SeriesNumber, ds.SeriesDescription = OTHER, 7, "Lung 1.0"
        ds.SeriesDate = "20240131"
    return found


def check(path: Path, *warnings: str, series: str | int | None = None, n: int = NK) -> None:
    """The ramp is read, and these sentences are said."""
    volume, said = read_volume_and_warnings(path, series)
    assert volume.hu.shape == (NI, NJ, n)
    assert_allclose(volume.hu, hu_at(volume.grid.points() * [-1, -1, 1]), atol=1e-3)
    assert said == warnings


@pytest.mark.parametrize("uid", [SERIES, OTHER], ids=["in the series", "in a series of its own"])
def test_a_localizer_is_left_out_and_said(tmp_path, slices, uid):
    for ds in slices:
        ds.InstanceNumber += 1
    check(
        save(tmp_path / "ct", [localizer(uid), *slices]),
        "ct: left out as localizer: IM000.",
        *["ct: its slices are numbered from 2; slices may be missing at one end."] * (uid == OTHER),
    )


def test_what_is_no_image_is_left_out_and_said(tmp_path, slices):
    save(tmp_path / "ct", [*slices, report(), report()])
    (tmp_path / "ct" / "readme.txt").write_text("exported on a Monday")
    check(
        tmp_path / "ct",
        "ct: left out as SR object: IM006, IM007.",
        "ct: left out as no DICOM file: readme.txt.",
    )


def test_warnings_name_three_files_at_most(tmp_path, slices):
    check(
        save(tmp_path / "ct", [*slices, *(report() for _ in range(5))]),
        ("ct: left out as SR object: IM006, IM007, IM008 and 2 more."),
    )


def test_pages_of_a_report_are_no_volume(tmp_path, slices):
    pages = [ct_slice(AXIAL, 0) for _ in range(2)]
    for ds in pages:
        del ds.ImagePositionPatient
        ds.SeriesInstanceUID = OTHER
    check(save(tmp_path / "ct", [*slices, *pages]), f"ct: left out as another series: {OTHER} (2 slices, CT).")


def test_projections_beside_the_volume_are_left_out(tmp_path, slices):
    check(save(tmp_path / "ct", [projections(), *slices]), "ct: left out as projections: IM000.")


@pytest.mark.parametrize(
    ("made", "sentence"),
    [
        (projections, r"holds X-ray projections \(1 file\), not a volume; export the volume reconstructed from them"),
        (localizer, r"holds localizers alone \(1 file\); export the slices"),
        (report, r"is not CT: SR object \(1 file\); export the CT"),
    ],
)
def test_a_folder_without_a_volume_says_what_it_holds(tmp_path, made, sentence):
    with pytest.raises(InputRefused, match=sentence):
        read_volume(save(tmp_path / "ct", [made()]))
    with pytest.raises(InputRefused, match=r"no series called 'x'; .*there is no volume in it"):
        read_volume(tmp_path / "ct", "x")


def test_several_series_are_listed(tmp_path, slices):
    with pytest.raises(InputRefused) as caught:
        read_volume(save(tmp_path / "ct", [*slices, *other_series()]))
    message = str(caught.value)
    assert f'{OTHER} (number 7, 4 slices, CT, 20240131, "Lung 1.0")' in message
    assert f"{SERIES} (6 slices, CT)" in message
    assert '[images] ct_series = "..."' in message


@pytest.mark.parametrize("wanted", [OTHER, 7, "7", "lung 1.0"], ids=["uid", "number", "digits", "description"])
def test_a_series_is_chosen_by_uid_number_or_description(tmp_path, slices, wanted):
    folder = save(tmp_path / "ct", [*slices, *other_series()])
    check(folder, f"ct: left out as another series: {SERIES} (6 slices, CT).", series=wanted, n=4)


def test_a_series_that_is_not_there_is_refused_with_a_list(tmp_path, slices):
    with pytest.raises(InputRefused, match=f"no series called 'bone'; name one by its UID in .*: {SERIES}"):
        read_volume(save(tmp_path / "ct", slices), "bone")


def test_a_description_of_two_series_does_not_choose(tmp_path, slices):
    for ds in slices:
        ds.SeriesDescription = "Lung 1.0"
    with pytest.raises(InputRefused, match=r"2 series called 'Lung 1\.0'; name one by its UID"):
        read_volume(save(tmp_path / "ct", [*slices, *other_series()]), "Lung 1.0")


def test_a_series_of_an_image_that_is_no_dicom_is_refused(tmp_path, slices):
    write_volume(tmp_path / "ct.nii.gz", read_volume(save(tmp_path / "ct", slices)))
    with pytest.raises(CaseError, match="is no DICOM, so it holds no series 7"):
        read_volume(tmp_path / "ct.nii.gz", 7)


def disc(path: Path, slices: list[Dataset]) -> Path:
    """A disc as scanners write it: files in folders below a DICOMDIR, recorded with their patient."""
    (path / "PT0").mkdir(parents=True)
    save(path / "PT0" / "SE0", slices)
    records = [Dataset()]
    records[0].DirectoryRecordType = "PATIENT"
    for n in range(len(slices)):
        record = Dataset()
        record.DirectoryRecordType, record.ReferencedFileID = "IMAGE", ["PT0", "SE0", f"IM{n:03d}"]
        records.append(record)
    ds = base(AXIAL, MediaStorageDirectoryStorage)
    del ds.Rows, ds.Columns, ds.Modality
    ds.DirectoryRecordSequence = Sequence(records)
    ds.save_as(path / "DICOMDIR", enforce_file_format=True)
    return path


@pytest.mark.parametrize("name", ["", "DICOMDIR"])
@pytest.mark.parametrize("lower", [False, True], ids=["as written", "copied in lower case"])
def test_dicomdir(tmp_path, slices, name, lower):
    path = disc(tmp_path / "disc", slices)
    if lower:
        for file in sorted(path.rglob("*"), reverse=True):
            if file.name != "DICOMDIR":
                file.rename(file.with_name(file.name.lower()))
    check(path / name)
    assert len(files_behind(path / name)) == NK + 1


def test_files_that_a_dicomdir_records_and_that_are_not_there_are_said(tmp_path, slices):
    path = disc(tmp_path / "disc", slices)
    (path / "PT0" / "SE0" / "IM005").unlink()
    check(path, "disc: 1 of the files that its DICOMDIR records are not there.", n=NK - 1)


def test_a_dicomdir_that_is_none_is_refused(tmp_path, slices):
    save(tmp_path / "ct", slices)
    (tmp_path / "ct" / "DICOMDIR").write_text("nothing")
    with pytest.raises(InputRefused, match="DICOMDIR is not a readable DICOMDIR; remove it"):
        read_volume(tmp_path / "ct")


@pytest.mark.parametrize("name", ["ImagesInAcquisition", "NumberOfSeriesRelatedInstances"])
def test_fewer_slices_than_stated_are_said(tmp_path, slices, name):
    for ds in slices:
        setattr(ds, name, NK)
    sentence = f"ct: 5 slices, 6 stated by {name}; slices may be missing at an end."
    check(save(tmp_path / "ct", slices[:-1]), sentence, n=NK - 1)
    check(save(tmp_path / "whole", slices))


def test_numbers_that_start_late_are_said(tmp_path, slices):
    sentence = "ct: its slices are numbered from 3; slices may be missing at one end."
    check(save(tmp_path / "ct", slices[2:]), sentence, n=NK - 2)


def test_a_slice_that_shifts_sideways_is_refused(tmp_path, slices):
    slices[3].ImagePositionPatient[1] += 0.4
    with pytest.raises(InputRefused, match=r"shift sideways, the one at -36\.5 mm by 0\.40 mm; export"):
        read_volume(save(tmp_path / "ct", slices))


@pytest.mark.parametrize(("sideways_mm", "refused"), [(0.07, False), (0.09, True)])
def test_slices_may_shift_sideways_by_a_twentieth_of_the_smaller_pixel_spacing(tmp_path, slices, sideways_mm, refused):
    for ds in slices:
        ds.PixelSpacing = [2.4, 1.6]
    slices[3].ImagePositionPatient[1] += sideways_mm
    folder = save(tmp_path / "ct", slices)
    with pytest.raises(InputRefused, match="shift sideways") if refused else nullcontext():
        read_volume(folder)


@pytest.mark.parametrize(
    ("kept", "sentence"),
    [
        (-10, "IM002 has pixels that cannot be decoded"),
        (-44, "IM002 is not a readable DICOM file"),
        (-80, "IM002"),
        (400, "IM002"),
        (140, "misses slices .* left out as no DICOM|IM002"),
        (0, "misses slices .* left out as no DICOM file: IM002"),
    ],
)
def test_a_file_that_was_cut_short_is_refused(tmp_path, slices, kept, sentence):
    file = save(tmp_path / "ct", slices) / "IM002"
    file.write_bytes(file.read_bytes()[:kept])
    with pytest.raises(InputRefused, match=sentence):
        read_volume(tmp_path / "ct")


def angiographic_3d(where: str) -> Dataset:
    """X-Ray 3D Angiographic volume of a C-arm with its geometry and rescale in one place or another."""
    ds = base(AXIAL, XRay3DAngiographicImageStorage)
    ds.Modality, ds.NumberOfFrames = "XA", NK
    measures, orientation, rescale = Dataset(), Dataset(), Dataset()
    measures.PixelSpacing, measures.SpacingBetweenSlices = [ROW_MM, COLUMN_MM], SLICE_MM
    orientation.ImageOrientationPatient = [1, 0, 0, 0, 1, 0]
    rescale.RescaleSlope, rescale.RescaleIntercept = 2, -3000
    groups = {
        "PixelMeasuresSequence": measures,
        "PlaneOrientationSequence": orientation,
        "PixelValueTransformationSequence": rescale,
    }
    frames = [Dataset() for _ in range(NK)]
    for k, frame in enumerate(frames):
        place = Dataset()
        place.ImagePositionPatient = position(AXIAL, k).tolist()
        frame.PlanePositionSequence = Sequence([place])
    holder = Dataset()
    for name, group in groups.items():
        if where == "reconstruction, without groups":
            holder.update(group)
        elif where == "each frame":
            for frame in frames:
                setattr(frame, name, Sequence([group]))
        else:
            setattr(holder, name, Sequence([group]))
    if where.startswith("first position"):
        first = Dataset()
        first.ImagePositionPatient = position(AXIAL, 0).tolist()
        holder.PlanePositionSequence = Sequence([first])
        name = "XRay3DReconstructionSequence" if "reconstruction" in where else "SharedFunctionalGroupsSequence"
        setattr(ds, name, Sequence([holder]))
    else:
        ds.PerFrameFunctionalGroupsSequence = Sequence(frames)
        name = "XRay3DReconstructionSequence" if "reconstruction" in where else "SharedFunctionalGroupsSequence"
        setattr(ds, name, Sequence([holder]))
    ds.PixelData = np.stack([(slice_hu(AXIAL, k) + 3000) / 2 for k in range(NK)]).astype("<i2").tobytes()
    return ds


def test_enhanced_files_of_one_frame_each_are_stacked(tmp_path):
    whole = enhanced(AXIAL, list(range(NK)))
    stack = np.frombuffer(whole.PixelData, "<i2").reshape(NK, NJ, NI)
    files = []
    for k in range(NK):
        ds = enhanced(AXIAL, [k])
        ds.PixelData = stack[k].tobytes()
        files.append(ds)
    check(save(tmp_path / "cbct", files))


@pytest.mark.parametrize(
    "where",
    [
        "shared",
        "each frame",
        "reconstruction",
        "reconstruction, without groups",
        "first position and spacing",
        "first position and spacing in the reconstruction",
    ],
)
def test_volumes_of_c_arms(tmp_path, where):
    volume, said = read_volume_and_warnings(save(tmp_path / "cbct", [angiographic_3d(where)]))
    assert_allclose(volume.hu, hu_at(volume.grid.points() * [-1, -1, 1]), atol=1.01)
    assert said == ()


def test_functional_groups_for_another_number_of_frames_are_refused(tmp_path):
    ds = enhanced(AXIAL, list(range(NK)))
    ds.PerFrameFunctionalGroupsSequence.pop()
    with pytest.raises(InputRefused, match="PerFrameFunctionalGroupsSequence = 5 items, 6 by NumberOfFrames needed"):
        read_volume(save(tmp_path / "cbct", [ds]))
