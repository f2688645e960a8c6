"""DICOM files made by hand: a ramp of HU that tells every voxel's place, as slices or as one multi-frame file."""

from __future__ import annotations

from pathlib import Path

import gdcm
import numpy as np
import pydicom
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.sequence import Sequence
from pydicom.uid import CTImageStorage, EnhancedCTImageStorage, ExplicitVRLittleEndian, generate_uid

NI, NJ, NK = 5, 4, 6
COLUMN_MM, ROW_MM, SLICE_MM = 0.8, 0.6, 2.5
ORIGIN_LPS = np.array([-20.0, 13.0, -44.0])
SERIES, FRAME = generate_uid(), generate_uid()


def hu_at(points_lps: np.ndarray) -> np.ndarray:
    return np.rint(points_lps @ [-1.0, -10.0, 7.0])


def position(axes: np.ndarray, k: float) -> np.ndarray:
    return ORIGIN_LPS + axes[:, 2] * SLICE_MM * k


def slice_hu(axes: np.ndarray, k: float) -> np.ndarray:
    """(rows, columns), as DICOM stores it."""
    j, i = np.meshgrid(np.arange(NJ), np.arange(NI), indexing="ij")
    points = position(axes, k) + i[..., None] * axes[:, 0] * COLUMN_MM + j[..., None] * axes[:, 1] * ROW_MM
    return hu_at(points)


def base(axes: np.ndarray, sop_class: str = CTImageStorage) -> Dataset:
    ds = Dataset()
    ds.file_meta = FileMetaDataset()
    ds.file_meta.MediaStorageSOPClassUID = sop_class
    ds.file_meta.MediaStorageSOPInstanceUID = generate_uid()
    ds.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    ds.SOPClassUID, ds.SOPInstanceUID = sop_class, ds.file_meta.MediaStorageSOPInstanceUID
    ds.Modality, ds.SeriesInstanceUID, ds.FrameOfReferenceUID = "CT", SERIES, FRAME
    ds.Rows, ds.Columns, ds.SamplesPerPixel, ds.PhotometricInterpretation = NJ, NI, 1, "MONOCHROME2"
    ds.BitsAllocated, ds.BitsStored, ds.HighBit, ds.PixelRepresentation = 16, 16, 15, 1
    return ds


def ct_slice(axes: np.ndarray, k: float, slope: float = 1.0, intercept: float = -1024.0) -> Dataset:
    ds = base(axes)
    ds.ImagePositionPatient = [f"{v:.8g}" for v in position(axes, k)]
    ds.ImageOrientationPatient = [f"{v:.10g}" for v in axes[:, :2].T.ravel()]
    ds.PixelSpacing = [ROW_MM, COLUMN_MM]
    ds.RescaleSlope, ds.RescaleIntercept = slope, intercept
    ds.InstanceNumber = 1
    ds.PixelData = np.rint((slice_hu(axes, k) - intercept) / slope).astype("<i2").tobytes()
    return ds


def save(folder: Path, slices: list[Dataset]) -> Path:
    folder.mkdir(exist_ok=True)
    for n, ds in enumerate(slices):
        ds.save_as(folder / f"IM{n:03d}", enforce_file_format=True)
    return folder


def enhanced(axes: np.ndarray, order: list[int]) -> Dataset:
    """Multi-frame with functional groups: orientation and spacing shared, position and rescale per frame."""
    ds = base(axes, EnhancedCTImageStorage)
    ds.NumberOfFrames = len(order)
    shared, measures, orientation = Dataset(), Dataset(), Dataset()
    measures.PixelSpacing = [ROW_MM, COLUMN_MM]
    orientation.ImageOrientationPatient = [f"{v:.10g}" for v in axes[:, :2].T.ravel()]
    shared.PixelMeasuresSequence, shared.PlaneOrientationSequence = Sequence([measures]), Sequence([orientation])
    ds.SharedFunctionalGroupsSequence = Sequence([shared])
    frames, pixels = [], []
    for k in order:
        frame, place, rescale = Dataset(), Dataset(), Dataset()
        place.ImagePositionPatient = [f"{v:.8g}" for v in position(axes, k)]
        rescale.RescaleSlope, rescale.RescaleIntercept = 1, -100 * k
        frame.PlanePositionSequence, frame.PixelValueTransformationSequence = Sequence([place]), Sequence([rescale])
        frames.append(frame)
        pixels.append((slice_hu(axes, k) + 100 * k).astype("<i2"))
    ds.PerFrameFunctionalGroupsSequence = Sequence(frames)
    ds.PixelData = np.stack(pixels).tobytes()
    return ds


def compressed(ds: Dataset, syntax: int, folder: Path) -> Dataset:
    """The data set with its pixels encoded by GDCM; syntax: of gdcm.TransferSyntax."""
    plain, packed = folder / "plain.dcm", folder / "packed.dcm"
    ds.save_as(plain, enforce_file_format=True)
    reader = gdcm.ImageReader()
    reader.SetFileName(str(plain))
    assert reader.Read()
    change = gdcm.ImageChangeTransferSyntax()
    change.SetTransferSyntax(gdcm.TransferSyntax(syntax))
    change.SetInput(reader.GetImage())
    assert change.Change()
    writer = gdcm.ImageWriter()
    writer.SetFileName(str(packed))
    writer.SetFile(reader.GetFile())
    writer.SetImage(change.GetOutput())
    assert writer.Write()
    packed_ds = pydicom.dcmread(packed)
    ds.file_meta.TransferSyntaxUID, ds.PixelData = packed_ds.file_meta.TransferSyntaxUID, packed_ds.PixelData
    plain.unlink()
    packed.unlink()
    return ds
