"""Both cone-beam CTs side by side: the inflated one carried to the deflated one by a model of the collapse."""

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
class View:
    """All on one grid, in the deflated CBCT's frame.

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


def view_of(prepared: Prepared, lung_def: Mask, def_from_inf: MeshMap, voxel_mm: float) -> View:
    """What both images show under the model's map, on voxels of `voxel_mm`."""
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
    return View(deflated, resample(inflated, grid, back), seen, lung, modelled, back)
