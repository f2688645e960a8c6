"""Both cone-beam CTs on one grid: the inflated one warped onto the deflated one by a model of the collapse."""

from __future__ import annotations

from dataclasses import dataclass

from poro.mesh import TetMesh
from registration.images.resample import coarsen, resample, resample_mask
from registration.maps.field import DisplacementField
from registration.volume import Mask, Volume
from vatsloc.maps import MeshMap, covered, sampled
from vatsloc.workflow.prepare import Prepared

PRIOR_SPACING_MM = 3.0


@dataclass(frozen=True)
class WarpedPair:
    """The deflated CBCT and the warped inflated one, on one grid in the deflated CBCT's frame.

    deflated: that image; warped: the inflated one as the model moves it; both_see: what lies in the field of view of
    both; lung, modelled: the collapsed lung as it was segmented and as the model has it, where both see; inf_from_def:
    the model's map back.
    """

    deflated: Volume
    warped: Volume
    both_see: Mask
    lung: Mask
    modelled: Mask
    inf_from_def: DisplacementField


def warped_pair(prepared: Prepared, lung_def: Mask, def_from_inf: MeshMap, voxel_mm: float) -> WarpedPair:
    """Warp the inflated CBCT by the model's map; both images on voxels of `voxel_mm`."""
    deflated, inflated = (coarsen(image.volume, voxel_mm) for image in (prepared.deflated, prepared.inflated))
    grid = deflated.grid
    back = sampled(def_from_inf.inverse(), grid.with_spacing(PRIOR_SPACING_MM))
    both = resample_mask(prepared.inflated.field.usable, grid, back).inside
    both &= resample_mask(prepared.deflated.field.usable, grid).inside
    moved = TetMesh(def_from_inf.moved, def_from_inf.mesh.tets)
    seen, lung, modelled = (
        Mask(inside & both, grid.ras_from_ijk)
        for inside in (both, resample_mask(lung_def, grid).inside, covered(moved, grid).inside)
    )
    return WarpedPair(deflated, resample(inflated, grid, back), seen, lung, modelled, back)
