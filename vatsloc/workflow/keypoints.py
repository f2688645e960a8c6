"""Keypoints inside the lung matched between both cone-beam CTs: first about where a model of the collapse puts them,
then by propagation from the matches to their neighbours. Where these are few, the model may be far off: they are looked
for about places to all sides of it too, in a smaller and a larger lung, and in tissue without air.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from poro.mesh import TetMesh
from registration.correspondences import Correspondences
from registration.images.morphology import dilate, erode
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
FEW = 400
"""With fewer keypoints than this, more are looked for: in airless tissue, and one in every smaller cell."""
SHIFT_MM = 12.0
"""How far aside of the model keypoints are then looked for, less than the reach, so that no gap is left."""
SIZES = (0.85, 1.15)
"""And how much smaller and larger than modelled the lung may be, along every axis."""
VOTERS, VOTES, ALIKE_MM = 6, 2, 8.0
"""A match found there counts if so many of so many neighbours move as it does, within ALIKE_MM."""
SHRUNK_CELL_MM = 7.0
"""What a cell of 10 mm becomes where the lung has shrunk to a third."""
ROOM_MM, AIRLESS_MM, GAS_RIM_MM = 6.0, 25.0, 1.5
"""Tissue is looked for so far beyond where the inflated lung was, so far from gas and aerated lung, and not so near to
gas, where a voxel holds both."""
BONE_HU = 150.0


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
    seen = resample_mask(prepared.deflated.field.usable, deflated.grid).inside
    after = _inner(resample_mask(observed.found.lung, deflated.grid), seen)
    found = propagate_matches(deflated, placed, after, before, first, PropagationSettings(match))
    if len(found) >= FEW:
        return found
    for other in _others(observed.model_mesh.points, displacement):
        first = first.joined(_near_model(prepared, observed, other, match))
    found = propagate_matches(deflated, placed, after, before, _consistent(first), PropagationSettings(match))
    after, finer = _inner(tissue(prepared, observed, deflated), seen), replace(match, cell_mm=SHRUNK_CELL_MM)
    return propagate_matches(deflated, placed, after, before, found, PropagationSettings(finer))


def _others(rest: Array, displacement: Array) -> list[Array]:
    """Displacements (n, 3) mm of nodes at rest (n, 3) that put the collapsed lung aside of the model, or make it
    smaller or larger.
    """
    shifts = SHIFT_MM * np.concatenate([np.eye(3), -np.eye(3)])
    after = rest + displacement
    about = after - after.mean(axis=0)
    return [displacement + shift for shift in shifts] + [displacement + (size - 1) * about for size in SIZES]


def _consistent(found: Correspondences) -> Correspondences:
    """Of matches that share a keypoint, the one that correlates best, where two of its nearest neighbours move alike.

    Lobes that have come apart move differently, so that a majority need not agree.
    """
    by_ncc = found.only(np.argsort(-found.ncc, kind="stable"))
    best = by_ncc.only(np.unique(by_ncc.fixed, axis=0, return_index=True)[1])
    if len(best) <= VOTERS:
        return best
    motion = best.fixed - best.moving
    near = cKDTree(best.fixed).query(best.fixed, VOTERS + 1)[1][:, 1:]
    alike = np.linalg.norm(motion[near] - motion[:, None], axis=2) < ALIKE_MM
    return best.only(alike.sum(axis=1) >= VOTES)


def tissue(prepared: Prepared, observed: Observed, deflated: Volume) -> Mask:
    """What may be lung on the grid of a deflated CBCT, airless parts included: all that is neither gas nor bone where
    the inflated lung was, near the collapsed lung's space. Mediastinum and diaphragm that moved there are in it too.
    """
    grid, found = deflated.grid, observed.found
    gas, space = (resample_mask(mask, grid).inside for mask in (found.air, found.space))
    room = dilate(covered(observed.mesh_before, grid).inside, ROOM_MM, grid.spacing)
    room &= dilate(space, AIRLESS_MM, grid.spacing) & ~dilate(gas, GAS_RIM_MM, grid.spacing)
    return Mask(room & (deflated.hu > found.limit_hu) & (deflated.hu < BONE_HU), grid.ras_from_ijk)


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
