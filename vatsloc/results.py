"""Every file of a results folder, from values in memory: RAS becomes LPS, images get the voxel order of the input."""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from registration.maps.field import DisplacementField
from registration.volume import Array, Mask, Volume
from vatsloc.formats.fields import write_field
from vatsloc.formats.folder import PROGRAM, RUN_FILE
from vatsloc.formats.markups import PointList, write_points
from vatsloc.formats.meshes import Surface, TetraMesh, write_stl, write_vtu
from vatsloc.formats.nifti import write_mask, write_volume
from vatsloc.formats.transforms import write_tfm
from vatsloc.frames import flip_points

NODULE_INFLATED, NODULE_DEFLATED = "nodule_cbct_inflated.mrk.json", "nodule_cbct_deflated.mrk.json"
NODULE_MASK = "nodule_cbct_deflated.nii.gz"
CT_IN_INFLATED, CT_IN_DEFLATED = "ct_in_cbct_inflated.nii.gz", "ct_in_cbct_deflated.nii.gz"
LUNG_CT, LUNG_INFLATED, LUNG_DEFLATED = "lung_ct.vtu", "lung_inflated.vtu", "lung_deflated.vtu"
DEFLATED_STL, CONTACT_STL = "lung_deflated.stl", "contact_surface.stl"
INFLATED_FROM_CT = "from-CT_to-CBCTinflated_mode-points_xfm.nii.gz"
DEFLATED_FROM_CT = "from-CT_to-CBCTdeflated_mode-points_xfm.nii.gz"
CT_FROM_INFLATED = "from-CBCTinflated_to-CT_mode-image_xfm.nii.gz"
CT_FROM_DEFLATED = "from-CBCTdeflated_to-CT_mode-image_xfm.nii.gz"
RIGID_INFLATED_FROM_CT = "from-CT_to-CBCTinflated_mode-points_desc-rigid_xfm.tfm"
RIGID_CT_FROM_INFLATED = "from-CBCTinflated_to-CT_mode-image_desc-rigid_xfm.tfm"
RIGID_DEFLATED_FROM_INFLATED = "from-CBCTinflated_to-CBCTdeflated_mode-points_desc-rigid_xfm.tfm"
RIGID_INFLATED_FROM_DEFLATED = "from-CBCTdeflated_to-CBCTinflated_mode-image_desc-rigid_xfm.tfm"
REPORT, SCENE, SCENE_WITH_SCANS = "report.html", "scene.mrml", "scene_with_scans.mrml"
INPUTS = "inputs.json"
"""Where the case lies, relative to the results folder, for what needs the scans again; run.json holds no path."""
RADIUS95 = "radius95_mm"
"""Of the nodes of `LUNG_DEFLATED`: how far off the tissue there may be, 95 %."""

OUTPUT_FILES = (
    NODULE_INFLATED,
    NODULE_DEFLATED,
    NODULE_MASK,
    CT_IN_INFLATED,
    CT_IN_DEFLATED,
    LUNG_CT,
    LUNG_INFLATED,
    LUNG_DEFLATED,
    DEFLATED_STL,
    CONTACT_STL,
    INFLATED_FROM_CT,
    DEFLATED_FROM_CT,
    CT_FROM_INFLATED,
    CT_FROM_DEFLATED,
    RIGID_INFLATED_FROM_CT,
    RIGID_CT_FROM_INFLATED,
    RIGID_DEFLATED_FROM_INFLATED,
    RIGID_INFLATED_FROM_DEFLATED,
    RUN_FILE,
    INPUTS,
    REPORT,
    SCENE,
    SCENE_WITH_SCANS,
)
"""What a finished results folder holds; report and scenes are written by modules of their own into the same folder."""


@dataclass(frozen=True)
class RunRecord:
    """run.json. nodule_lps: (3,) mm; seconds: by stage and "total"; details: further keys (settings, inputs, ...)."""

    status: str
    nodule_lps: Array
    nodule_ellipsoid95_mm: Array
    theta: Mapping[str, float]
    seconds: Mapping[str, float]
    peak_mb: float
    skipped: Mapping[str, str] = field(default_factory=dict)
    gates: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """Plain numbers, strings, lists and dicts; what is not finite becomes null, since JSON knows no NaN."""
        if "total" not in self.seconds:
            raise ValueError(f'seconds must hold "total", got {sorted(self.seconds)}')
        own = {name: value for name, value in vars(self).items() if name != "details"}
        clash = sorted({*own, "program", "versions"} & set(self.details))
        if clash:
            raise ValueError(f"details must not repeat {', '.join(clash)}")
        record: dict[str, Any] = _plain({"program": PROGRAM, **own, "versions": versions(), **self.details})
        return record


@dataclass(frozen=True)
class ResultData:
    """All of a run's results but its report. Points, vectors and transforms in RAS mm.

    nodule_*_ras: (3,); nodule_mask_deflated and ct_in_*: on the grids of the CBCTs; lung_*: the same tetrahedra in
    three shapes; inflated_from_ct, deflated_from_ct: on (a part of) the CT's grid; ct_from_*: on those of the CBCTs;
    rigid_*: (4, 4); stored_axes: voxel axis letters of the input files ("ct", "cbct_inflated", "cbct_deflated").
    """

    nodule_inflated_ras: Array
    nodule_deflated_ras: Array
    nodule_mask_deflated: Mask
    ct_in_inflated: Volume
    ct_in_deflated: Volume
    lung_ct: TetraMesh
    lung_inflated: TetraMesh
    lung_deflated: TetraMesh
    deflated_surface: Surface
    contact_surface: Surface
    inflated_from_ct: DisplacementField
    deflated_from_ct: DisplacementField
    ct_from_inflated: DisplacementField
    ct_from_deflated: DisplacementField
    rigid_inflated_from_ct: Array
    rigid_deflated_from_inflated: Array
    run: RunRecord
    stored_axes: Mapping[str, str]


def write_results(folder: Path, data: ResultData) -> None:
    """Write every output file but report and scenes into an existing folder, two files at a time."""
    axes = data.stored_axes
    inflated, deflated = axes["cbct_inflated"], axes["cbct_deflated"]
    writes: list[Callable[[], None]] = [
        lambda: write_field(folder / INFLATED_FROM_CT, data.inflated_from_ct, axes["ct"]),
        lambda: write_field(folder / DEFLATED_FROM_CT, data.deflated_from_ct, axes["ct"]),
        lambda: write_field(folder / CT_FROM_INFLATED, data.ct_from_inflated, inflated),
        lambda: write_field(folder / CT_FROM_DEFLATED, data.ct_from_deflated, deflated),
        lambda: write_volume(folder / CT_IN_INFLATED, data.ct_in_inflated, inflated),
        lambda: write_volume(folder / CT_IN_DEFLATED, data.ct_in_deflated, deflated),
        lambda: write_mask(folder / NODULE_MASK, data.nodule_mask_deflated, deflated),
        lambda: write_vtu(folder / LUNG_CT, data.lung_ct),
        lambda: write_vtu(folder / LUNG_INFLATED, data.lung_inflated),
        lambda: write_vtu(folder / LUNG_DEFLATED, data.lung_deflated),
        lambda: _write_small_files(folder, data),
    ]
    with ThreadPoolExecutor(max_workers=2) as pool:  # compression releases the interpreter lock
        for written in [pool.submit(write) for write in writes]:
            written.result()


def read_run(folder: Path) -> dict[str, Any]:
    """run.json of a results folder."""
    run: dict[str, Any] = json.loads((folder / RUN_FILE).read_text(encoding="utf-8"))
    return run


def write_inputs(partial: Path, case: Path, folder: Path) -> None:
    """Note in a result that is filled as `partial` and will lie in `folder` where its case is."""
    relative = os.path.relpath(case.resolve(), folder.resolve())
    (partial / INPUTS).write_text(json.dumps({"case": relative}) + "\n", encoding="utf-8")


def case_of(folder: Path) -> Path | None:
    """The case folder that a result was made from, None where it does not say."""
    try:
        relative = json.loads((folder / INPUTS).read_text(encoding="utf-8"))["case"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return Path(os.path.normpath(folder.resolve() / str(relative)))


def versions() -> dict[str, str]:
    """Versions of the program, of Python and of the packages that shape the numbers."""
    packages = (PROGRAM, "numpy", "scipy", "numba", "scikit-fem", "pyamg", "scikit-image")
    return {"python": platform.python_version(), **{name: metadata.version(name) for name in packages}}


@cache
def source_digest() -> str:
    """Digest of the program's own source files: any change of it is another program."""
    told = hashlib.blake2b(digest_size=16)
    root = Path(__file__).parents[1]
    for package in ("registration", "poro", "vatsloc"):
        for file in sorted((root / package).rglob("*.py")):
            told.update(file.relative_to(root).as_posix().encode() + file.read_bytes())
    return told.hexdigest()


def _write_small_files(folder: Path, data: ResultData) -> None:
    for name, point in ((NODULE_INFLATED, data.nodule_inflated_ras), (NODULE_DEFLATED, data.nodule_deflated_ras)):
        write_points(folder / name, PointList(np.reshape(point, (1, 3)), ("nodule",), ("predicted centre",)))
    if not np.allclose(flip_points(data.nodule_deflated_ras), data.run.nodule_lps, atol=1e-6):
        raise ValueError(
            f"run says nodule_lps {data.run.nodule_lps}, the result {flip_points(data.nodule_deflated_ras)}"
        )
    write_stl(folder / DEFLATED_STL, data.deflated_surface.points_ras, data.deflated_surface.triangles)
    write_stl(folder / CONTACT_STL, data.contact_surface.points_ras, data.contact_surface.triangles)
    for rigid, forth, back in (
        (data.rigid_inflated_from_ct, RIGID_INFLATED_FROM_CT, RIGID_CT_FROM_INFLATED),
        (data.rigid_deflated_from_inflated, RIGID_DEFLATED_FROM_INFLATED, RIGID_INFLATED_FROM_DEFLATED),
    ):
        write_tfm(folder / forth, rigid)
        write_tfm(folder / back, np.linalg.inv(rigid))
    text = json.dumps(data.run.as_json(), indent=1, allow_nan=False)
    (folder / RUN_FILE).write_text(text + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple | set):
        return [_plain(item) for item in (value.tolist() if isinstance(value, np.ndarray) else value)]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
