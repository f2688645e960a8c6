"""Keypoints inside the lung matched between both cone-beam CTs: first about where a model of the collapse puts them,
then by propagation from the matches to their neighbours. Where these are few, the model may be far off: they are looked
for anew about places to all sides of it, in a smaller and a larger lung, and in tissue without air, in a band of the
images; those that move in large groups count, and once more about a lung that follows them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from poro.fem import Tissue
from poro.fit import PointConstraints, elastic_correction
from poro.mesh import TetMesh, interpolate, locate
from registration.correspondences import Correspondences
from registration.images.morphology import dilate, erode
from registration.images.resample import coarsen, resample_mask
from registration.kernels.threads import ahead
from registration.keypoints.groups import GroupSettings, in_groups
from registration.keypoints.matching import MatchSettings, match_keypoints
from registration.keypoints.propagation import PropagationSettings, propagate_matches
from registration.volume import Array, Mask, Volume
from vatsloc.maps import MeshMap, covered
from vatsloc.workflow.fissures import mapped, smooth_map
from vatsloc.workflow.observe import Observed
from vatsloc.workflow.prepare import Prepared
from vatsloc.workflow.refinement import unfolded
from vatsloc.workflow.settings import KeypointSettings
from vatsloc.workflow.warped_pair import warped_pair

RIM_MM = 2.0
"""Blocks nearer than this to the lung's border also show what lies beyond it."""
FEW = 400
"""With fewer keypoints than this, they are looked for anew, more widely."""
SHIFT_MM = 12.0
"""How far aside of the model keypoints are then looked for, less than the reach, so that no gap is left."""
SIZES = (0.85, 1.15)
"""And how much smaller and larger than modelled the lung may be, along every axis."""
VOTERS, VOTES, ALIKE_MM = 6, 2, 8.0
"""A match found there counts if so many of so many neighbours move as it does, within ALIKE_MM."""
BAND_VOXELS = (0.7, 1.6)
"""What is compared at first where few were found: tissue that loses its air by patches looks unlike itself, vessels do
not."""
SEED_CELL_MM, CELL_MM = 6.0, 5.0
"""One keypoint in each such cell, instead of 10 mm: about the model, and propagated."""
LEAST_NCC, REACH_MM, VOTES_BESIDE, AGREE_MM = 0.5, 6.0, 3, 3.0
"""A propagated match correlates less, for its neighbours, more of them and more exactly, have to expect it there."""
ROUNDS, MORE = 3, 1.2
"""How often keypoints are looked for, and how many times as many have to be found for another time."""
SIGMA_MM = 2.0
"""Standard deviation of a keypoint that a lung follows in between."""
ROOM_MM, AIRLESS_MM, GAS_RIM_MM = 6.0, 25.0, 1.5
"""Tissue is looked for so far beyond where the inflated lung was, so far from gas and aerated lung, and not so near to
gas, where a voxel holds both."""
BONE_HU = 150.0


@dataclass(frozen=True)
class _Regions:
    """What is compared. deflated, inflated: CBCTs, the inflated one placed by the spine; lung: what may be lung in the
    deflated one; before: where the inflated lung lay.
    """

    deflated: Volume
    inflated: Volume
    lung: Mask
    before: Mask


def find_correspondences(
    prepared: Prepared, observed: Observed, displacement: Array, settings: KeypointSettings
) -> Correspondences:
    """Keypoints of the deflated CBCT matched in the inflated one, starting from a displacement (n, 3) mm of the model.

    `moving` is where they lie before the collapse, placed by the spine.
    """
    match = MatchSettings(voxel_mm=settings.voxel_mm, reach_mm=settings.reach_mm)
    near = _near_model(prepared, observed, displacement, match)
    regions = _regions(prepared, observed, match)
    found = _propagated(regions, near, PropagationSettings(match))
    for band in (BAND_VOXELS, None) if len(found) < FEW else ():
        seeds = replace(match, cell_mm=SEED_CELL_MM, band_voxels=band)
        widely = _looked_for_widely(prepared, observed, displacement, regions, seeds)
        if len(widely) > len(found):
            return widely
    return found


def _regions(prepared: Prepared, observed: Observed, match: MatchSettings) -> _Regions:
    deflated, inflated = (coarsen(image.volume, match.voxel_mm) for image in (prepared.deflated, prepared.inflated))
    placed = Volume(inflated.hu, observed.def_from_inf_rigid.matrix @ inflated.ras_from_ijk)
    usable = resample_mask(prepared.inflated.field.usable, inflated.grid).inside
    before = _inner(covered(observed.mesh_before, placed.grid), usable)
    seen = resample_mask(prepared.deflated.field.usable, deflated.grid).inside
    return _Regions(deflated, placed, _inner(resample_mask(observed.found.lung, deflated.grid), seen), before)


def _looked_for_widely(
    prepared: Prepared, observed: Observed, displacement: Array, regions: _Regions, seeds: MatchSettings
) -> Correspondences:
    """Keypoints where the model may be far off: to all sides of it, in a smaller and in a larger lung, and in tissue
    without air; then about a lung that follows those, as long as that finds many more.
    """
    seen = resample_mask(prepared.deflated.field.usable, regions.deflated.grid).inside
    everywhere = replace(regions, lung=_inner(tissue(prepared, observed, regions.deflated), seen))
    mesh = observed.model_mesh
    found, laid_out = Correspondences.none(), [displacement, *_others(mesh.points, displacement)]
    for _ in range(ROUNDS):
        half = len(laid_out) // 2
        others = ahead(partial(_near_models, prepared, observed, laid_out[half:], seeds))
        first = found.joined(_near_models(prepared, observed, laid_out[:half], seeds)).joined(others())
        again = _moving_in_groups((regions, everywhere), _consistent(first), seeds)
        if len(again) < MORE * len(found) or not len(again):
            break
        found = again
        laid_out = [_following(mesh, start, found) for start in (displacement, _affine(mesh.points, found))]
    return found


def _moving_in_groups(places: tuple[_Regions, ...], first: Correspondences, match: MatchSettings) -> Correspondences:
    """What matches lead to in one place after the other, where it moves in groups."""
    how = PropagationSettings(
        replace(match, cell_mm=CELL_MM, least_ncc=LEAST_NCC), reach_mm=REACH_MM, votes=VOTES_BESIDE, agree_mm=AGREE_MM
    )
    found = first
    for regions in places:
        found = _propagated(regions, found, how)
    return found.only(in_groups(found, GroupSettings()))


def _affine(points: Array, found: Correspondences) -> Array:
    """Displacement (n, 3) mm of points (n, 3) by the affine map that keypoints follow best."""
    centre = found.moving.mean(axis=0)
    return mapped(smooth_map(found.moving - centre, found.fixed - found.moving, 1), points - centre)


def _following(mesh: TetMesh, displacement: Array, found: Correspondences) -> Array:
    """A displacement (n, 3) mm of a mesh and an elastic field on top that follows keypoints."""
    off = found.fixed - found.moving - interpolate(locate(mesh, found.moving), displacement)
    wanted = PointConstraints(found.moving, off, np.full(len(found), SIGMA_MM), np.zeros((len(found), 3)))
    field = elastic_correction(mesh, displacement, Tissue(), wanted).u
    return displacement + unfolded(mesh.points + displacement, field, mesh.tets)


def _propagated(regions: _Regions, seeds: Correspondences, how: PropagationSettings) -> Correspondences:
    return propagate_matches(regions.deflated, regions.inflated, regions.lung, regions.before, seeds, how)


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


def _near_models(
    prepared: Prepared, observed: Observed, displacements: list[Array], match: MatchSettings
) -> Correspondences:
    """What `_near_model` finds about each of several displacements."""
    found = Correspondences.none()
    for displacement in displacements:
        found = found.joined(_near_model(prepared, observed, displacement, match))
    return found


def _inner(lung: Mask, seen: Array) -> Mask:
    return Mask(erode(lung.inside, RIM_MM, lung.grid.spacing) & seen, lung.ras_from_ijk)
