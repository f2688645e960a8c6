"""CT slices with whole headers, made of an image in memory, as a scanner would send them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.sequence import Sequence
from pydicom.uid import CTImageStorage, EnhancedCTImageStorage, ExplicitVRLittleEndian, generate_uid

from registration.volume import Volume
from vatsloc.frames import flip_affine


@dataclass(frozen=True)
class Ids:
    """Who and what a series belongs to. time: HHMMSS of its acquisition."""

    patient: str = "P-1"
    name: str = "Doe^Jane"
    study: str = "1.2.826.0.1.3680043.8.498.1"
    frame: str = "1.2.826.0.1.3680043.8.498.2"
    series: str = "1.2.826.0.1.3680043.8.498.3"
    number: int = 3
    description: str = "deflated"
    time: str = "101500"
    date: str = "20261129"
    modality: str = "CT"


def ct_slices(volume: Volume, ids: Ids) -> list[Dataset]:
    """A data set for every slice, in the order of the third axis."""
    lps_from_ijk = flip_affine(volume.ras_from_ijk)
    spacing = np.linalg.norm(lps_from_ijk[:3, :3], axis=0)
    axes = lps_from_ijk[:3, :3] / spacing
    made = []
    for k in range(volume.hu.shape[2]):
        ds = _header(ids, CTImageStorage)
        ds.Rows, ds.Columns = volume.hu.shape[1], volume.hu.shape[0]
        ds.ImagePositionPatient = [f"{v:.8g}" for v in (lps_from_ijk @ [0, 0, k, 1])[:3]]
        ds.ImageOrientationPatient = [f"{v:.10g}" for v in axes[:, :2].T.ravel()]
        ds.PixelSpacing = [f"{spacing[1]:.8g}", f"{spacing[0]:.8g}"]
        ds.SliceThickness = f"{spacing[2]:.8g}"
        ds.RescaleSlope, ds.RescaleIntercept, ds.RescaleType = "1", "-1024", "HU"
        ds.InstanceNumber = k + 1
        ds.PixelData = np.rint(volume.hu[:, :, k].T + 1024).clip(0, 4095).astype("<u2").tobytes()
        made.append(ds)
    return made


def write_series(folder: Path, volume: Volume, ids: Ids) -> Path:
    """The slices as files whose names do not tell their order."""
    folder.mkdir(parents=True, exist_ok=True)
    for k, ds in enumerate(ct_slices(volume, ids)):
        ds.save_as(folder / f"IM{(7 * k) % len(volume.hu[0, 0]):04d}_{k}.dcm", enforce_file_format=True)
    return folder


def enhanced(volume: Volume, ids: Ids, order: list[int]) -> Dataset:
    """One multi-frame file whose frames come in any order."""
    slices = ct_slices(volume, ids)
    ds = _header(ids, EnhancedCTImageStorage)
    ds.Rows, ds.Columns, ds.NumberOfFrames, ds.InstanceNumber = slices[0].Rows, slices[0].Columns, len(order), 1
    shared, measures, orientation, rescale = Dataset(), Dataset(), Dataset(), Dataset()
    measures.PixelSpacing, measures.SliceThickness = slices[0].PixelSpacing, slices[0].SliceThickness
    orientation.ImageOrientationPatient = slices[0].ImageOrientationPatient
    rescale.RescaleSlope, rescale.RescaleIntercept, rescale.RescaleType = "1", "-1024", "HU"
    shared.PixelMeasuresSequence, shared.PlaneOrientationSequence = Sequence([measures]), Sequence([orientation])
    shared.PixelValueTransformationSequence = Sequence([rescale])
    ds.SharedFunctionalGroupsSequence = Sequence([shared])
    frames = []
    for n, k in enumerate(order):
        frame, place, content = Dataset(), Dataset(), Dataset()
        place.ImagePositionPatient = slices[k].ImagePositionPatient
        content.StackID, content.InStackPositionNumber, content.DimensionIndexValues = "1", k + 1, [1, k + 1]
        frame.PlanePositionSequence, frame.FrameContentSequence = Sequence([place]), Sequence([content])
        frames.append(frame)
        assert n < len(slices)
    ds.PerFrameFunctionalGroupsSequence = Sequence(frames)
    ds.PixelData = b"".join(slices[k].PixelData for k in order)
    return ds


def _header(ids: Ids, sop_class: str) -> Dataset:
    ds = Dataset()
    ds.file_meta = FileMetaDataset()
    ds.file_meta.MediaStorageSOPClassUID = sop_class
    ds.file_meta.MediaStorageSOPInstanceUID = generate_uid()
    ds.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    ds.SOPClassUID, ds.SOPInstanceUID = sop_class, ds.file_meta.MediaStorageSOPInstanceUID
    ds.PatientID, ds.PatientName, ds.PatientBirthDate, ds.PatientSex = ids.patient, ids.name, "19600101", "F"
    ds.StudyInstanceUID, ds.StudyDate, ds.StudyTime, ds.StudyID = ids.study, ids.date, "080000", "1"
    ds.AccessionNumber, ds.ReferringPhysicianName = "A1", ""
    ds.Modality, ds.Manufacturer, ds.SeriesInstanceUID, ds.SeriesNumber = ids.modality, "test", ids.series, ids.number
    ds.SeriesDescription, ds.FrameOfReferenceUID, ds.PositionReferenceIndicator = ids.description, ids.frame, ""
    ds.AcquisitionDate, ds.AcquisitionTime, ds.SeriesDate, ds.SeriesTime = ids.date, ids.time, ids.date, ids.time
    ds.ContentDate, ds.ContentTime, ds.ImageType = ids.date, ids.time, ["ORIGINAL", "PRIMARY", "AXIAL"]
    ds.SamplesPerPixel, ds.PhotometricInterpretation = 1, "MONOCHROME2"
    ds.BitsAllocated, ds.BitsStored, ds.HighBit, ds.PixelRepresentation = 16, 12, 11, 0
    return ds
