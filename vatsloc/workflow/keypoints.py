"""Keypoints inside the lung matched between both cone-beam CTs: first about where a model of the collapse puts them,
then by propagation from the matches to their neighbours.
"""

from __future__ import annotations

from poro.mesh import TetMesh
from registration.correspondences import Correspondences
from registration.images.morphology import erode
from registration.images.resample import coarsen, resample_mask
from registration.keypoints.matching import MatchSettings, match_keypoints
from registration.keypoints.propagation import PropagationSettings, propagate_matches
from registration.volume import Array, Mask, Volume
from vatsloc.maps import MeshMap, covered
from vatsloc.workflow.observe import Observed
from vatsloc.workflow.prepare import Prepared
from vatsloc.workflow.settings import KeypointSettings
from vatsloc.workflow.warped_pair import warped_pair

RIM_MM = 2.0
"""Blocks nearer than this to the lung's border also show what lies beyond it."""


def find_correspondences(
    prepared: Prepared, observed: Observed, displacement: Array, settings: KeypointSettings
) -> Correspondences:
    """Keypoints of the deflated CBCT matched in the inflated one, starting from a displacement (n, 3) mm of the model.

    `moving` is where they lie before the collapse, placed by the spine.
    """
    match = MatchSettings(voxel_mm=settings.voxel_mm, reach_mm=settings.reach_mm)
    first = _near_model(prepared, observed, displacement, match)
    deflated, inflated = (coarsen(image.volume, match.voxel_mm) for image in (prepared.deflated, prepared.inflated))
    placed = Volume(inflated.hu, observed.def_from_inf_rigid.matrix @ inflated.ras_from_ijk)
    before = _inner(
        covered(observed.mesh_before, placed.grid),
        resample_mask(prepared.inflated.field.usable, inflated.grid).inside,
    )
    after = _inner(
        resample_mask(observed.found.lung, deflated.grid),
        resample_mask(prepared.deflated.field.usable, deflated.grid).inside,
    )
    return propagate_matches(deflated, placed, after, before, first, PropagationSettings(match))


def _near_model(prepared: Prepared, observed: Observed, displacement: Array, match: MatchSettings) -> Correspondences:
    """Keypoints matched within reach of where a displacement (n, 3) mm of the model's mesh puts them."""
    rest, rigid = observed.model_mesh, observed.def_from_inf_rigid
    before = TetMesh(rigid.inverse()(rest.points), rest.tets)
    model = MeshMap(before, rest.points + displacement, rigid)
    scans = warped_pair(prepared, observed.found.lung, model, match.voxel_mm)
    found = match_keypoints(scans.deflated, scans.warped, scans.lung, match, moving_region=scans.modelled)
    return found.mapped(moving=lambda points: rigid(model.inverse()(points)))


def _inner(lung: Mask, seen: Array) -> Mask:
    return Mask(erode(lung.inside, RIM_MM, lung.grid.spacing) & seen, lung.ras_from_ijk)
