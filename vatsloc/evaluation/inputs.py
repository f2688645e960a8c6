"""What an evaluation reads: landmarks and fields of view of the case; maps, meshes and the answer of the result."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from poro.mesh import TetMesh
from poro.mesh.closest import depth_below
from registration.maps.field import DisplacementField
from registration.maps.rigid import RigidTransform
from registration.volume import Array, Grid, Mask
from vatsloc.case import Landmarks, read_landmarks, sha256
from vatsloc.errors import CaseError, InputRefused
from vatsloc.evaluation.landmarks import LandmarkTriples, match
from vatsloc.evaluation.tre import RunMaps
from vatsloc.evaluation.whole_lung import whole_lung
from vatsloc.formats.casefile import read_case_file
from vatsloc.formats.fields import read_field
from vatsloc.formats.folder import RUN_FILE, is_result
from vatsloc.formats.guard import reading
from vatsloc.formats.images import read_volume
from vatsloc.formats.markups import PointList, read_points
from vatsloc.formats.meshes import read_vtu
from vatsloc.formats.transforms import read_tfm
from vatsloc.imaging.cbct import field_of_view
from vatsloc.maps import MeshMap
from vatsloc.results import (
    DEFLATED_FROM_CT,
    INFLATED_FROM_CT,
    LUNG_CT,
    LUNG_DEFLATED,
    LUNG_INFLATED,
    NODULE_DEFLATED,
    NODULE_INFLATED,
    RADIUS95,
    RIGID_DEFLATED_FROM_CT,
    RIGID_DEFLATED_FROM_INFLATED,
    RIGID_INFLATED_FROM_CT,
    read_run,
)

DENSE_FILE = "dense_ras_mm.csv"
LANDMARKS_MM = (3.0, 800.0)
"""Between these lies the diagonal of three landmarks or more of one lung."""
MAX_BEYOND_MM = 150.0
"""How far beyond a small image the middle of a lung's landmarks may lie."""


@dataclass(frozen=True)
class Result:
    """A results folder in memory.

    run: run.json; lung_ct: in the pieces that the run moved; nodule_*_ras: (3,) predictions, RAS mm; radius95_mm: (n,)
    at the lungs' nodes, how far off the run holds its tissue to be at most (95 %), None in results from before it was
    written. Without an inflated scan what belongs to it is None, and its maps are defined nowhere.
    """

    run: dict[str, Any]
    maps: RunMaps
    field: DisplacementField
    lung_ct: TetMesh
    lung_inflated: TetMesh | None
    nodule_inflated_ras: Array | None
    nodule_deflated_ras: Array
    radius95_mm: Array | None = None

    @cached_property
    def whole_lung_ct(self) -> TetMesh:
        """The lung in the CT without the cut of the run, for depths below the pleura."""
        return whole_lung(self.lung_ct)


@dataclass(frozen=True)
class Truth:
    """What is known about a case.

    fields_of_view: by CBCT, "inflated" and "deflated"; dense: tissue points anywhere in the lung, where a phantom knows
    them, in the three images (n, 3, 3) RAS mm.
    """

    landmarks: LandmarkTriples
    nodule: Landmarks
    fields_of_view: dict[str, Mask]
    dense: Array | None = None


def read_truth(case: Path) -> Truth:
    """Landmarks, true nodule and fields of view of a case folder.

    Raises CaseError when the landmarks are missing or match nowhere, InputRefused when a file cannot be trusted.
    """
    known = read_landmarks(case)
    if known.ct is None or (known.cbct_inflated is None and known.cbct_deflated is None):
        raise CaseError(
            f"{case} has no landmarks in the CT and a CBCT, so there is nothing to score; "
            "name them under [landmarks] in case.toml."
        )
    triples = match(known.ct, known.cbct_inflated, known.cbct_deflated)
    images = read_case_file(case).images
    _check_extent(known.ct, images.ct)
    seen: dict[str, Mask] = {}
    for image, file, points in (
        ("inflated", images.cbct_inflated, known.cbct_inflated),
        ("deflated", images.cbct_deflated, known.cbct_deflated),
    ):
        if file is None:
            continue
        volume = read_volume(case / file, images.series(f"cbct_{image}"))
        if points is not None:
            _check_extent(points, file)
            _check_place(points, volume.grid, file)
        seen[image] = field_of_view(volume).mask
    return Truth(triples, known, seen, _dense(case / "truth" / DENSE_FILE))


def _check_extent(points: PointList, image: str) -> None:
    """Refuse landmarks that span what no lung does, as those in metres."""
    extent = np.ptp(points.ras, axis=0)
    if len(points) > 2 and not LANDMARKS_MM[0] <= float(np.linalg.norm(extent)) <= LANDMARKS_MM[1]:
        raise InputRefused(
            f"the {len(points)} landmarks of {image} span {' x '.join(f'{mm:.3g}' for mm in extent)} mm, "
            "which no lung does; save them in millimetres."
        )


def _check_place(points: PointList, grid: Grid, image: str) -> None:
    """Refuse landmarks that lie far from their image, as those in another frame."""
    ijk = grid.to_ijk(np.median(points.ras, axis=0))
    beyond = float(np.linalg.norm(np.maximum(np.maximum(-ijk, ijk - np.array(grid.shape) + 1), 0) * grid.spacing))
    if beyond > MAX_BEYOND_MM:
        raise InputRefused(
            f"the landmarks of {image} lie {beyond:.0f} mm beyond it, {MAX_BEYOND_MM:.0f} mm allowed; "
            "save them in that image's frame."
        )


def _dense(path: Path) -> Array | None:
    if not path.is_file():
        return None
    with reading(path, "table of numbers", "make the phantom again"):
        rows = [line for line in path.read_text(encoding="utf-8-sig").splitlines()[1:] if line.strip()]
        table = np.array([[float(value) for value in row.split(",")] for row in rows], ndmin=2)
    if table.shape[1] != 9 or not np.isfinite(table).all():
        raise InputRefused(f"{path} must hold 9 finite numbers a row (CT, inflated, deflated); make the phantom again.")
    return table.reshape(-1, 3, 3)


def read_result(folder: Path) -> Result:
    """Maps, meshes and answer of a results folder. Raises CaseError when it is none, InputRefused when damaged."""
    if not is_result(folder):
        raise CaseError(
            f"{folder} is not a result of localize (no {RUN_FILE} of vatsloc); give the folder that localize wrote."
        )
    with reading(folder, "result of localize", "run localize again"):
        return _result(folder)


def _result(folder: Path) -> Result:
    run = read_run(folder)
    _check_record(run)
    if "cbct_inflated" not in run.get("scans", ("cbct_inflated",)):
        return _without_inflated(folder, run)
    ct, inflated, deflated = (read_vtu(folder / name) for name in (LUNG_CT, LUNG_INFLATED, LUNG_DEFLATED))
    if not (np.array_equal(ct.tets, inflated.tets) and np.array_equal(inflated.tets, deflated.tets)):
        raise InputRefused(f"the lungs in {folder} have different tetrahedra; run localize again.")
    lung_inflated = TetMesh(inflated.points_ras, inflated.tets)
    def_from_ct = read_field(folder / DEFLATED_FROM_CT)
    rigid_inf_from_ct, rigid_def_from_inf = (
        _rigid(folder / RIGID_INFLATED_FROM_CT),
        _rigid(folder / RIGID_DEFLATED_FROM_INFLATED),
    )
    return Result(
        run=run,
        maps=RunMaps(
            rigid_inf_from_ct=rigid_inf_from_ct,
            rigid_def_from_ct=rigid_def_from_inf @ rigid_inf_from_ct,
            rigid_def_from_inf=rigid_def_from_inf,
            inf_from_ct=read_field(folder / INFLATED_FROM_CT),
            def_from_inf=MeshMap(lung_inflated, deflated.points_ras, rigid_def_from_inf),
            def_from_ct=def_from_ct,
        ),
        field=def_from_ct,
        lung_ct=TetMesh(ct.points_ras, ct.tets),
        lung_inflated=lung_inflated,
        nodule_inflated_ras=read_points(folder / NODULE_INFLATED).ras[0],
        nodule_deflated_ras=read_points(folder / NODULE_DEFLATED).ras[0],
        radius95_mm=deflated.point_data.get(RADIUS95),
    )


def _without_inflated(folder: Path, run: dict[str, Any]) -> Result:
    ct, deflated = (read_vtu(folder / name) for name in (LUNG_CT, LUNG_DEFLATED))
    if not np.array_equal(ct.tets, deflated.tets):
        raise InputRefused(f"the lungs in {folder} have different tetrahedra; run localize again.")
    def_from_ct, rigid = read_field(folder / DEFLATED_FROM_CT), _rigid(folder / RIGID_DEFLATED_FROM_CT)
    return Result(
        run=run,
        maps=RunMaps(_nowhere, rigid, _nowhere, _nowhere, _nowhere, def_from_ct),
        field=def_from_ct,
        lung_ct=TetMesh(ct.points_ras, ct.tets),
        lung_inflated=None,
        nodule_inflated_ras=None,
        nodule_deflated_ras=read_points(folder / NODULE_DEFLATED).ras[0],
        radius95_mm=deflated.point_data.get(RADIUS95),
    )


def _nowhere(points: Array) -> Array:
    """The map into a scan that was not taken."""
    return np.full(points.shape, np.nan)


def _check_record(run: dict[str, Any]) -> None:
    """Raise ValueError or TypeError unless what scores are made of has its shape; null stands for what is not known."""
    np.array([v for v in run.get("nodule_ellipsoid95_mm") or () if v is not None], dtype=float)
    directions = run.get("nodule_ellipsoid95_axes_lps")
    if directions is not None and np.array(directions, dtype=float).shape != (3, 3):
        raise ValueError("run.json holds no three directions of the ellipsoid")
    if len(run.get("nodule_ellipsoid95_mm") or (0, 0, 0)) != 3 or not isinstance(run.get("input_sha256", {}), dict):
        raise ValueError("run.json holds no three semi-axes, or no digests of the inputs")


def check_same_case(case: Path, folder: Path, run: dict[str, Any]) -> None:
    """Raise CaseError when the result was made from another deflated CBCT than the case holds."""
    made_from = run.get("input_sha256", {}).get("cbct_deflated")
    name = read_case_file(case).images.cbct_deflated
    if name is None:
        raise CaseError(f"{case / 'case.toml'}: [images] cbct_deflated is missing; add it.")
    image = case / name
    if made_from is not None and sha256(image) != made_from:
        raise CaseError(f"{folder} was made from another image than {image}; give the case that belongs to the result.")


def depth_below_pleura(lung: TetMesh, points_ras: Array) -> Array:
    """Distance (n,) mm of points (n, 3) below the lung's surface, negative outside, NaN for a missing point."""
    depth = np.full(len(points_ras), np.nan)
    known = np.isfinite(points_ras).all(axis=1)
    if known.any():
        depth[known] = depth_below(lung.boundary, points_ras[known])
    return depth


def seen_in(mask: Mask, points_ras: Array) -> Array:
    """Whether points (n, 3) fall into voxels of the mask, (n,) bool; a missing point (NaN) counts as seen."""
    missing: Array = np.any(~np.isfinite(points_ras), axis=1)
    return mask.holds(np.where(missing[:, None], 0.0, points_ras)) | missing


def _rigid(path: Path) -> RigidTransform:
    try:
        return RigidTransform(read_tfm(path))
    except ValueError as error:
        raise InputRefused(f"{path} holds no rigid transform ({error}); run localize again.") from error
