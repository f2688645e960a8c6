"""Images of a known ramp in every format and orientation, written by hand."""

from __future__ import annotations

from pathlib import Path

import nibabel
import nrrd
import numpy as np
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from registration.volume import Volume
from vatsloc.frames import flip_affine

SHAPE = (4, 5, 6)
ORIENTATIONS = ["RAS", "LAS", "LPS", "PIR", "SAL", "oblique"]


def affine_of(orientation: str) -> np.ndarray:
    axes = np.zeros((3, 3))
    if orientation == "oblique":
        axes = Rotation.from_rotvec([0.2, -0.3, 0.1]).as_matrix() * [-1, 1, 1]
    else:
        for column, letter in enumerate(orientation):
            axes["RLAPSI".index(letter) // 2, column] = 1 if letter in "RAS" else -1
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = axes * [0.5, 1.5, 2.0], [-31.0, 17.0, 5.0]
    return affine


def hu_at(points_ras: np.ndarray) -> np.ndarray:
    """A ramp that tells every direction from every other."""
    return np.asarray(points_ras @ [1.0, 10.0, 100.0] - 500, dtype=np.float32)


def write_nii(path: Path, values: np.ndarray, affine: np.ndarray) -> None:
    image = nibabel.Nifti1Image(values, affine)
    image.header.set_xyzt_units("mm")
    nibabel.save(image, path)


SIGNS_TO_RAS = {
    "left-posterior-superior": (-1, -1),
    "LPS": (-1, -1),
    "left-anterior-superior": (-1, 1),
    "LAS": (-1, 1),
    "right-anterior-superior": (1, 1),
    "RAS": (1, 1),
}


def write_nrrd(
    path: Path, values: np.ndarray, affine: np.ndarray, space: str = "left-posterior-superior", **more
) -> None:
    world = np.diag([*SIGNS_TO_RAS[space], 1, 1]) @ affine
    header = {"space": space, "space directions": world[:3, :3].T, "space origin": world[:3, 3], **more}
    nrrd.write(str(path), values, {key: value for key, value in header.items() if value is not None})


def metaimage_header(values: np.ndarray, affine: np.ndarray, **changes: str | None) -> str:
    lps = flip_affine(affine)
    spacing = np.linalg.norm(lps[:3, :3], axis=0)
    kind = {"int16": "MET_SHORT", "float32": "MET_FLOAT", "uint8": "MET_UCHAR", "float64": "MET_DOUBLE"}[
        str(values.dtype)
    ]
    fields = {
        "ObjectType": "Image",
        "NDims": str(values.ndim),
        "BinaryData": "True",
        "BinaryDataByteOrderMSB": "False",
        "CompressedData": "False",
        "TransformMatrix": " ".join(map(repr, map(float, (lps[:3, :3] / spacing).T.ravel()))),
        "Offset": " ".join(map(repr, map(float, lps[:3, 3]))),
        "ElementSpacing": " ".join(map(repr, map(float, spacing))),
        "DimSize": " ".join(map(str, values.shape)),
        "ElementType": kind,
        **changes,
    }
    data_file = fields.pop("ElementDataFile", "LOCAL")
    return "".join(f"{k} = {v}\n" for k, v in fields.items() if v is not None) + f"ElementDataFile = {data_file}\n"


def write_mha(path: Path, values: np.ndarray, affine: np.ndarray, **changes: str | None) -> None:
    path.write_bytes(metaimage_header(values, affine, **changes).encode() + values.tobytes(order="F"))


WRITERS = {"nii": write_nii, "nii.gz": write_nii, "nrrd": write_nrrd, "mha": write_mha}


def check_ramp(volume: Volume, orientation: str) -> None:
    assert volume.hu.dtype == np.float32
    assert volume.hu.shape == SHAPE
    assert_allclose(volume.ras_from_ijk, affine_of(orientation), atol=1e-5)
    assert_allclose(volume.hu, hu_at(volume.grid.points()), atol=0.01)
