"""What a run says about the deflated scan, from memory or from a results folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from registration.volume import Array, Mask
from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.folder import PROGRAM, RUN_FILE, is_result
from vatsloc.formats.meshes import Surface, TetraMesh, read_surface, read_vtu
from vatsloc.formats.nifti import read_nifti
from vatsloc.frames import flip_points
from vatsloc.report.landmarks import depth_below
from vatsloc.results import DEFLATED_STL, LUNG_DEFLATED, NODULE_MASK, ResultData, read_run


@dataclass(frozen=True)
class Finding:
    """Nodule and collapsed lung in the deflated scan. centre_ras: (3,) mm; semi_axes_ras: (3, 3), a semi-axis of the
    95 % ellipsoid per row, longest first, None where it has no end; nodule: on the deflated scan's voxels, in any order
    of axes; depth_mm: centre below the lung's surface, negative outside; gates: name -> ok, value, limit, says.
    """

    centre_ras: Array
    semi_axes_ras: Array | None
    depth_mm: float | None
    nodule: Mask
    lung: TetraMesh
    side: str
    status: str
    gates: Mapping[str, Mapping[str, Any]]
    warnings: tuple[str, ...]
    version: str

    @property
    def failed(self) -> tuple[str, ...]:
        """Names of the gates that failed."""
        return tuple(name for name, gate in self.gates.items() if not gate["ok"])


def finding_of(result: ResultData) -> Finding:
    """The finding of a run whose result is in memory."""
    return _finding(result.run.as_json(), result.nodule_mask_deflated, result.lung_deflated, result.deflated_surface)


def read_finding(folder: Path) -> Finding:
    """The finding of a results folder. Raises CaseError where it is none, InputRefused for damaged files in it."""
    if not is_result(folder):
        raise CaseError(f"{folder} is no results folder ({RUN_FILE} of {PROGRAM} is not in it); name one.")
    image = read_nifti(folder / NODULE_MASK)
    nodule = Mask(np.asarray(image.values) >= 0.5, image.ras_from_ijk)  # empty where the nodule is out of view
    return _finding(read_run(folder), nodule, read_vtu(folder / LUNG_DEFLATED), read_surface(folder / DEFLATED_STL))


def _finding(run: Mapping[str, Any], nodule: Mask, lung: TetraMesh, surface: Surface) -> Finding:
    try:
        centre = flip_points(np.array(run["nodule_lps"], dtype=float))
        length = np.array(run["nodule_ellipsoid95_mm"], dtype=float)
        axes = flip_points(np.array(run["nodule_ellipsoid95_axes_lps"], dtype=float))
        version = str(run["versions"][PROGRAM])
        side, status, gates = str(run["side"]), str(run["status"]), dict(run["gates"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputRefused(f"{RUN_FILE} lacks what DICOM has to say ({error}); run localize again.") from error
    known = length.shape == (3,) and axes.shape == (3, 3) and np.isfinite(length).all() and np.isfinite(axes).all()
    return Finding(
        centre_ras=centre,
        semi_axes_ras=axes * length[:, None] if known else None,
        depth_mm=depth_below(surface, centre)[0],
        nodule=nodule,
        lung=lung,
        side=side,
        status=status,
        gates=gates,
        warnings=tuple(run.get("warnings", ())),
        version=version,
    )
