"""How far the root of the lung moved when the lung collapsed. Ref: Alvarez 2021, section 7.1.2."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from registration.ffd import FfdSettings, Weights, register_ffd
from registration.images.morphology import dilate
from registration.maps.field import PointMap
from registration.maps.inversion import invert_at
from registration.maps.rigid import RigidTransform
from registration.volume import Array, Mask
from vatsloc.imaging.cbct import PreparedCbct
from vatsloc.imaging.hilum import Hilum, track_hilum
from vatsloc.imaging.lattice import on_grid, working_copy

AIRWAY_RIM_MM = 5.0
FARTHEST_MM = 30.0
LEAST_CONTRAST_HU = 60.0


class HilumSource(Enum):
    """Where the hilum's displacement comes from."""

    AIRWAYS = "free-form registration on the dilated airways"
    SHIFT = "the shift of the airways as a whole, since the finer registration went astray"
    FEW = "the shift of the airways as a whole, since both images show too little of them to be registered"
    STILL = "nothing: the airways were not found again, so the hilum is taken to move with the spine"
    OFF = "nothing: switched off in the settings"


@dataclass(frozen=True)
class HilumMotion:
    """Displacements (k, 3) mm of the points asked for, in the deflated CBCT's frame, beyond the spine's motion."""

    displacement: Array
    source: HilumSource


def hilum_motion(
    inflated: PreparedCbct,
    deflated: PreparedCbct,
    airways: Mask,
    hilum: Hilum,
    inf_from_def: RigidTransform,
    points_def: Array,
) -> HilumMotion:
    """Displacement of points (k, 3) about the hilum.

    airways: expected in the deflated CBCT's frame after the spine's registration; hilum: likewise. The airways are
    found again as a whole, then the inflated CBCT is registered to the deflated one inside their 5 mm rim.
    """
    tracked = track_hilum(deflated, airways, hilum.point_ras)
    still = np.zeros_like(points_def)
    if not tracked.inside.any() or tracked.contrast_hu < LEAST_CONTRAST_HU:
        return HilumMotion(still, HilumSource.STILL)
    work = working_copy(deflated.volume, 2.0)
    region = on_grid(dilate(tracked.inside, AIRWAY_RIM_MM, work.grid.spacing), work.grid, deflated.volume.grid)
    region = Mask(region.inside & deflated.field.usable.inside, region.ras_from_ijk)
    prior: PointMap = _Shifted(inf_from_def, tracked.shift_mm)
    if not region.inside.any():
        return HilumMotion(still + tracked.shift_mm, HilumSource.FEW)
    try:
        fit = register_ffd(
            deflated.volume,
            inflated.volume,
            FfdSettings(spacing_mm=32.0, levels=2, voxel_mm=2.0, window_mm=None, weights=Weights(bending=300.0)),
            fixed_mask=region,
            moving_mask=inflated.field.usable,
            prior=prior,
        )
    except ValueError:  # no sample of the rim is left, or seen by the inflated image
        return HilumMotion(still + tracked.shift_mm, HilumSource.FEW)
    inverse = invert_at(fit.moving_from_fixed, inf_from_def(points_def), points_def + tracked.shift_mm)
    moved = inverse.points_fixed - points_def
    astray = np.linalg.norm(moved - tracked.shift_mm, axis=1).max() > FARTHEST_MM or fit.min_det <= 0
    if astray or inverse.residual_mm.max() > 1.0:
        return HilumMotion(still + tracked.shift_mm, HilumSource.SHIFT)
    return HilumMotion(moved, HilumSource.AIRWAYS)


@dataclass(frozen=True)
class _Shifted:
    """Where a point of the deflated image was in the inflated one, if everything moved by `shift` (3,) mm."""

    inf_from_def: RigidTransform
    shift: Array

    def __call__(self, points_def: Array) -> Array:
        return self.inf_from_def(points_def - self.shift)
