"""A result about a deflated scan that can be worked out by hand: a lung that is a ball, a nodule in it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from poro.mesh import TetMesh, stuff_level_set
from registration.volume import Array, Grid, Mask, Volume
from tests.vatsloc.test_results import record
from tests.vatsloc.test_results import result as any_result
from vatsloc.case import sha256
from vatsloc.formats.folder import whole_folder
from vatsloc.formats.meshes import Surface, TetraMesh
from vatsloc.frames import flip_points, reorient
from vatsloc.results import RUN_FILE, ResultData, write_inputs, write_results

SHAPE, SPACING = (44, 40, 34), np.array([1.8, 2.2, 2.5])
LUNG_CENTRE, LUNG_MM = np.array([12.0, -8.0, 31.0]), 30.0
NODULE, NODULE_MM = np.array([20.0, -2.0, 34.0]), 5.0
SEMI_AXES = np.array([9.0, 5.0, 3.0])


def grid(turn_deg: tuple[float, float, float] = (4.0, -6.0, 9.0)) -> Grid:
    """Voxels about the lung, stored as axial slices are (LPS), turned a little out of the anatomical axes."""
    affine = np.eye(4)
    affine[:3, :3] = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix() @ np.diag(SPACING * [-1, -1, 1])
    affine[:3, 3] = LUNG_CENTRE - affine[:3, :3] @ ((np.array(SHAPE) - 1) / 2)
    return Grid(SHAPE, affine)


def ellipsoid_axes() -> Array:
    """Unit vectors of the ellipsoid's axes in rows, RAS."""
    return Rotation.from_euler("xyz", [20, 35, -50], degrees=True).as_matrix().T


def ball(at: Array, radius: float) -> Array:
    return np.linalg.norm(grid().points() - at, axis=-1) <= radius


def scan() -> Volume:
    hu = np.where(ball(LUNG_CENTRE, LUNG_MM), -700.0, 20.0) + 400 * ball(NODULE, NODULE_MM)
    return Volume(np.rint(hu).astype(np.float32), grid().ras_from_ijk)


def lung() -> TetMesh:
    def level(points: Array) -> Array:
        return LUNG_MM - np.linalg.norm(points - LUNG_CENTRE, axis=1)

    return stuff_level_set(level, LUNG_CENTRE - LUNG_MM - 2, LUNG_CENTRE + LUNG_MM + 2, 8.0)


def result(axes: str = "LPS", failed: bool = False, digest: str = "") -> ResultData:
    """axes: in which the scan's file stores its voxels."""
    mesh = lung()
    gates = {
        "overlap": {"ok": True, "value": 0.9, "limit": 0.4, "says": "The inflated CBCT shows too little of the lung."},
        "surface": {"ok": not failed, "value": 3.5, "limit": 2.5, "says": "The surface stays off the observed one."},
        "held_out": {"ok": True, "value": None, "limit": 5.0, "says": "The model does not predict keypoints."},
    }
    run = record(
        nodule_lps=flip_points(NODULE),
        nodule_ellipsoid95_mm=SEMI_AXES,
        gates=gates,
        warnings=("The hilum moved as a whole.",),
        details={
            "nodule_ellipsoid95_axes_lps": flip_points(ellipsoid_axes()),
            "side": "right",
            "input_sha256": {"cbct_deflated": digest},
        },
    )
    border = mesh.boundary
    return replace(
        any_result(),
        nodule_deflated_ras=NODULE,
        nodule_mask_deflated=Mask(ball(NODULE, NODULE_MM), grid().ras_from_ijk),
        lung_deflated=TetraMesh(mesh.points, mesh.tets),
        deflated_surface=Surface(border.points, border.triangles),
        run=run,
        stored_axes={"ct": "RAS", "cbct_inflated": "LPS", "cbct_deflated": axes},
    )


def write_result(folder: Path, case: Path, data: ResultData) -> Path:
    """The results folder of a case, without report and scenes."""
    with whole_folder(folder, (RUN_FILE,)) as partial:
        write_results(partial, data)
        write_inputs(partial, case, folder)
    return folder


def write_case_file(folder: Path, deflated: str = "deflated") -> Path:
    """A case of which only the deflated scan is there."""
    folder.mkdir(parents=True, exist_ok=True)
    text = f'side = "right"\n[images]\nct = "ct"\ncbct_inflated = "inflated"\ncbct_deflated = "{deflated}"\n'
    (folder / "case.toml").write_text(text + '[nodule]\nmask = "nodule.nii.gz"\n')
    return folder


def digest(path: Path) -> str:
    return sha256(path)


def reorient_mask(axes: str) -> tuple[Array, Array]:
    """The nodule's voxels stored along other axes, and their affine."""
    return reorient(ball(NODULE, NODULE_MM), grid().ras_from_ijk, axes)
