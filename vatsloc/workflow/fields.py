"""A run's maps as displacement fields, on every n-th voxel of the images they belong to, and what that leaves out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from registration.images.resample import resample
from registration.maps.field import DisplacementField
from registration.volume import Array, Grid, Mask, Volume
from vatsloc.maps import MeshMap, box_of, sampled
from vatsloc.workflow.localization import Localization

MARGIN_MM = 10.0


@dataclass(frozen=True)
class Carried:
    """What a map from the CT to a scan makes for viewers. ct: the CT as the scan should show it; from_ct: the map on
    the lung's box in the CT; to_ct: its inverse on the scan's grid.
    """

    ct: Volume
    from_ct: DisplacementField
    to_ct: DisplacementField


def carried(ct: Volume, lung_ct: Mask, scan_from_ct: MeshMap, grid: Grid, spacing_mm: float) -> Carried:
    """The CT on a scan's grid, and both fields: inside the lung by the mesh, outside it by the spine, on voxels at most
    `spacing_mm` apart, if there are such.

    What leads to the CT goes on beyond the lung for one voxel's diagonal, so that values between voxels inside are not
    blended with those outside.
    """
    box = thinned(lung_box(lung_ct), spacing_mm)
    return Carried(warped_ct(ct, scan_from_ct, grid), sampled(scan_from_ct, box), _back(scan_from_ct, grid, spacing_mm))


def _back(scan_from_ct: MeshMap, grid: Grid, spacing_mm: float) -> DisplacementField:
    """On a scan's grid, where in the CT to look."""
    thin = thinned(grid, spacing_mm)
    beyond = 0.0 if thin.shape == grid.shape else float(np.linalg.norm(thin.spacing))
    return sampled(scan_from_ct.inverse(), thin, beyond)


def warped_ct(ct: Volume, scan_from_ct: MeshMap, grid: Grid) -> Volume:
    """The CT on every voxel of a scan's grid, as the scan should show it."""
    back = scan_from_ct.inverse()
    warped = resample(ct, grid, back.around)
    box, cut = box_of(back.mesh, grid)
    warped.hu[cut] = resample(ct, box, sampled(back, box, 0.0)).hu
    return warped


def thinned(grid: Grid, spacing_mm: float) -> Grid:
    """Every n-th voxel of a grid from its first one on, n as large as leaves them no more than `spacing_mm` apart."""
    n = np.maximum(np.floor(spacing_mm / grid.spacing + 1e-6), 1).astype(int)
    affine = grid.ras_from_ijk.copy()
    affine[:3, :3] = affine[:3, :3] * n
    i, j, k = (int(-(-size // step)) for size, step in zip(grid.shape, n, strict=True))
    return Grid((i, j, k), affine)


def lung_box(lung: Mask) -> Grid:
    """The CT's grid about the lung."""
    where = np.argwhere(lung.inside)
    margin = np.ceil(MARGIN_MM / lung.grid.spacing)
    return lung.grid.box(where.min(axis=0) - margin, where.max(axis=0) + 1 + margin)


def fields_entry(inflated: Carried | None, deflated: Carried, found: Localization) -> dict[str, Any]:
    """For run.json: how far apart each field's voxels lie, and how far off it is at the nodes of the lung's mesh, where
    that is exact, mm. inflated: None where that scan was not taken.
    """
    ct, told = found.pose.mesh_ct.points, {}
    scans = {"inflated": (inflated, found.pose.points_inf), "deflated": (deflated, found.collapse.mesh_after.points)}
    for name, (scan, points) in scans.items():
        if scan is not None:
            told[f"{name}_from_ct"] = _field_entry(scan.from_ct, ct, points)
            told[f"ct_from_{name}"] = _field_entry(scan.to_ct, points, ct)
    return told


def _field_entry(field: DisplacementField, here: Array, there: Array) -> dict[str, Any]:
    return {"spacing_mm": field.grid.spacing, **_off(field, here, there)}


def _off(field: DisplacementField, here: Array, there: Array) -> dict[str, float]:
    shown = np.all((field.grid.to_ijk(here) >= 0) & (field.grid.to_ijk(here) <= np.array(field.grid.shape) - 1), axis=1)
    if not shown.any():
        return {}
    mm = np.linalg.norm(field(here[shown]) - there[shown], axis=1)
    return {"off_mm_median": float(np.median(mm)), "off_mm_p95": float(np.percentile(mm, 95))}
