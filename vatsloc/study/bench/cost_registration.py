"""What the free-form deformation costs against the number of voxels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from registration.images.resample import coarsen, resample, resample_mask
from registration.maps.rigid import RigidTransform
from registration.sliding import LungImage, register_sliding
from registration.volume import Array, Mask, Volume
from vatsloc.study.bench.isolated import isolated
from vatsloc.workflow.pose import ffd_settings
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import Stages

VOXELS_MM = (4.0, 2.8, 2.0, 1.6, 1.25)
"""Edges from which the fitted exponents come: (4 / 1.25)^3 is a factor of 33."""


@dataclass(frozen=True)
class Images:
    """What both programs register, and the landmarks that score them.

    fixed: prepared inflated CBCT; moving: CT; fixed_lung, usable: lung and field of view in the CBCT; moving_lung: in
    the CT; pose: our rigid map, CBCT to CT; landmarks_fixed, landmarks_moving: (n, 3) RAS mm, inside the field of view.
    """

    fixed: Volume
    moving: Volume
    fixed_lung: Mask
    moving_lung: Mask
    usable: Mask
    pose: RigidTransform
    marks_fixed: Array
    marks_moving: Array

    @property
    def seen_lung(self) -> Mask:
        """The lung that the CBCT shows."""
        return Mask(self.fixed_lung.inside & self.usable.inside, self.usable.ras_from_ijk)


def measure_cost(images: Images, voxels_mm: tuple[float, ...] = VOXELS_MM) -> dict[str, Any]:
    """Seconds and MB beyond the images of one registration at each voxel size, and exponents of voxels fitted to them.

    The control spacing stays 8 voxels, as in the default settings, so everything grows together. Each size has a
    processes of its own, one for seconds and one for memory, for memory that is freed is not always given back.
    """
    rows = [isolated(measure_size, images, voxel) for voxel in voxels_mm]
    slopes = {f"exponent_{key}": exponent(rows, key) for key in ("seconds", "mb")}
    return {"sizes": rows, **slopes}


def measure_size(images: Images, voxel_mm: float) -> dict[str, Any]:
    """One row of the cost table: seconds when warm, memory of a process that has registered nothing before."""
    fresh = isolated(_registered, images, voxel_mm)
    _registered(images, 8.0)
    return _registered(images, voxel_mm) | {"mb": fresh["mb"]}


def exponent(rows: list[dict[str, Any]], key: str) -> float:
    """Least-squares slope of log `key` against log voxels."""
    return float(np.polyfit(np.log([r["voxels"] for r in rows]), np.log([r[key] for r in rows]), 1)[0])


def _registered(images: Images, voxel_mm: float) -> dict[str, Any]:
    fixed, moving = _with_voxels(images.fixed, voxel_mm), _with_voxels(images.moving, voxel_mm)
    moving_lung = resample_mask(images.moving_lung, moving.grid)
    lung, usable = (resample_mask(m, fixed.grid) for m in (images.fixed_lung, images.usable))
    settings = replace(ffd_settings(Settings().registration), voxel_mm=voxel_mm, spacing_mm=4 * voxel_mm)
    stages = Stages()
    with stages.stage("idle"):
        pass
    with stages.stage("registration"):
        register_sliding(
            LungImage(fixed, lung, usable),
            LungImage(moving, moving_lung),
            settings,
            images.pose,
        )
    return {
        "voxel_mm": voxel_mm,
        "voxels": int(np.prod(fixed.hu.shape)),
        "seconds": stages.seconds["registration"],
        "mb": stages.peak_mb["registration"] - stages.peak_mb["idle"],
    }


def _with_voxels(volume: Volume, voxel_mm: float) -> Volume:
    """The image with voxels of `voxel_mm` along every axis, also where that is finer than it is."""
    return resample(coarsen(volume, voxel_mm), volume.grid.with_spacing(voxel_mm))
