"""A lung whose lobes have come apart, in two pieces.

The lung in one piece comes first. Where keypoints and gas agree on a sheet along which it parted, both pieces are laid
out by smooth maps of their own keypoints and corrected elastically, each for itself. That is kept if it predicts
keypoints held out from it better than the lung in one piece does, by the more, the weaker that evidence is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from poro.fem import Tissue
from poro.fit import Target, constraints_to, elastic_correction
from poro.mesh import TetMesh, interpolate, locate
from poro.mesh.pieces import Pieces, stuff_pieces
from registration.correspondences import Correspondences
from registration.images.resample import resample_mask
from registration.volume import Array, Mask
from vatsloc.maps import MeshMap, covered
from vatsloc.workflow.fissures import COVERED_MM, Fissure, Parted, mapped, smooth_map
from vatsloc.workflow.hold_out import held_out
from vatsloc.workflow.model_selection import Refinement, fit_settings, misfit
from vatsloc.workflow.observe import Observed
from vatsloc.workflow.pneumothorax import Collapse, residual_of_part
from vatsloc.workflow.pose import ChangeOfPose
from vatsloc.workflow.prepare import Prepared
from vatsloc.workflow.residual import Residual
from vatsloc.workflow.seen_fissure import PIECES, seen_fissure
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import Stages

JOINED_MM = 20.0
"""About the hilum, pieces share their nodes."""
COARSE_MM = 2.0
DEGREES, STRAINS = (1, 2), (0.05, 0.0125)
LEAST_STRETCH = 0.1
"""Smallest det of the gradient of a map that a piece may be laid out by."""


@dataclass(frozen=True)
class _Layout:
    """Both pieces at rest, in the deflated CBCT's frame: mesh, (n,) piece of every node; keypoints' piece (k,)."""

    mesh: TetMesh
    piece: Array
    of_keypoint: Array


def in_pieces(
    prepared: Prepared, pose: ChangeOfPose, collapse: Collapse, settings: Settings, stages: Stages
) -> tuple[ChangeOfPose, Collapse]:
    """The lung in two pieces where it has parted; what was given where it has not."""
    if not collapse.model.is_refined:
        stages.skip(PIECES, "no refinement of the model was kept")
        return pose, collapse
    with stages.stage(PIECES):
        fissure = stages.done(partial(seen_fissure, pose, collapse.observed, collapse.model.correspondences))
    if fissure is None or len(fissure.evidence) < 2 or fissure.is_bare:
        stages.skip(PIECES, _why(fissure))
        return pose, replace(collapse, fissure=fissure)
    with stages.stage(f"{PIECES}, fit"):
        fitted = _fitted(prepared, pose, collapse, fissure, settings)
    if fitted is None:
        stages.skip(PIECES, f"held-out keypoints are not predicted {_by_enough(fissure)} by a lung in two pieces")
        return pose, replace(collapse, fissure=fissure)
    pose, collapse = fitted
    if not settings.residual.on:
        return pose, collapse
    with stages.stage(f"{PIECES}, residual registration"):
        return pose, _with_residual(prepared, pose, collapse, fissure, settings)


def _why(fissure: Fissure | None) -> str:
    if fissure is None:
        return "too few keypoints to tell pieces apart"
    if fissure.is_bare:
        return f"half of a piece would lie over {fissure.bare_mm:.0f} mm from its own keypoints, {COVERED_MM:g} allowed"
    cost, share = f"{fissure.cost_share:.2f}", f"{100 * fissure.gas_share:.0f} %"
    gas = f"{fissure.gas} points of gas, {100 * fissure.gas / max(fissure.border, 1):.1f} % of its border,"
    return f"two smooth maps cost {cost} of one at keypoints, {share} of {gas} lie along a sheet"


def _by_enough(fissure: Fissure) -> str:
    least = 100 * (1 - fissure.most_misfit)
    return f"better by {least:.0f} %" if least else "better"


def cut_lung(prepared: Prepared, fissure: Fissure, edge_mm: float) -> Pieces:
    """The CT's lung cut by a fissure, in one piece about the hilum."""
    sheet, lung = fissure.sheet, prepared.lung_ct
    return stuff_pieces(
        lung.inside,
        lung.ras_from_ijk,
        edge_mm,
        sheet.distance,
        lambda points: np.linalg.norm(points - sheet.hilum, axis=1) < JOINED_MM,
    )


def _fitted(
    prepared: Prepared, pose: ChangeOfPose, collapse: Collapse, fissure: Fissure, settings: Settings
) -> tuple[ChangeOfPose, Collapse] | None:
    """The collapse in pieces, without its residual registration; None where it predicts too little better."""
    observed, model, found = collapse.observed, collapse.model, collapse.model.correspondences
    try:
        fine, coarse = (
            cut_lung(prepared, fissure, edge) for edge in (settings.mesh.edge_mm, settings.mesh.model_edge_mm)
        )
    except ValueError:  # a piece too thin for its elements
        return None
    placed = MeshMap(pose.mesh_ct, collapse.mesh_before.points, collapse.def_from_inf_rigid @ pose.inf_from_ct_rigid)
    rest = TetMesh(placed(coarse.mesh.points), coarse.mesh.tets)
    in_ct = interpolate(locate(collapse.mesh_before, found.moving), pose.mesh_ct.points)
    layout = _Layout(rest, coarse.node_piece(), (fissure.sheet.distance(in_ct) < 0).astype(int))
    hidden = held_out(found.fixed)
    before_mm = model.held_out_mm
    trials: dict[tuple[int, float], tuple[float, Array]] = {}
    for degree in DEGREES:
        for strain in STRAINS:
            u = _displaced(layout, observed, found, ~hidden, (degree, strain), settings)
            if u is not None:
                trials[degree, strain] = misfit(rest, u, found.only(hidden)), u
    if not trials or before_mm is None:
        return None
    best = min(trials, key=lambda name: trials[name][0])
    after_mm, training_only = trials[best]
    if not after_mm < fissure.most_misfit * before_mm:
        return None
    u = _displaced(layout, observed, found, np.ones(len(found), dtype=bool), best, settings)
    if u is None:
        return None
    refinement = Refinement(f"two pieces, degree {best[0]}, strain {best[1]:g}", before_mm, after_mm, True)
    ensemble = interpolate(locate(rest, model.system.mesh.points), training_only - u)[None]
    pose = _on_pieces(pose, fine)
    rest_fine = TetMesh(placed(fine.mesh.points), fine.mesh.tets)
    after = rest_fine.points + _carried(rest, coarse, u, rest_fine, fine)
    return pose, replace(
        collapse,
        observed=replace(observed, mesh_before=rest_fine),
        model=replace(model, refinements=(*model.refinements, refinement), ensemble=ensemble),
        residual=None,
        points_after=after,
        fissure=fissure,
        parted=Parted(fissure, fine),
    )


def _displaced(
    layout: _Layout, observed: Observed, found: Correspondences, used: Array, how: tuple[int, float], settings: Settings
) -> Array | None:
    """Displacement (n, 3) mm of the pieces' nodes: smooth maps of a degree, then an elastic correction of a strain."""
    degree, strain = how
    mesh, centre = layout.mesh, layout.mesh.points.mean(axis=0)
    u = np.zeros_like(mesh.points)
    for number in (0, 1):
        mine = used & (layout.of_keypoint == number)
        if mine.sum() < 20:
            return None
        told = smooth_map(found.moving[mine] - centre, (found.fixed - found.moving)[mine], degree)
        nodes = layout.piece == number
        u[nodes] = mapped(told, mesh.points[nodes] - centre)
    stretch = TetMesh(mesh.points + u, mesh.tets).volumes / mesh.volumes
    if degree == 2 and (stretch < LEAST_STRETCH).mean() > 0.001:
        return None
    surface, keypoints = observed.surface, found.only(used)
    target = Target(
        surface.points, surface.normals, surface.confidence, keypoints.moving, keypoints.fixed, keypoints.weights
    )
    wanted = constraints_to(target, mesh, u, fit_settings(settings))
    return np.asarray(u + elastic_correction(mesh, u, Tissue(), wanted, strain).u)


def _carried(rest: TetMesh, coarse: Pieces, u: Array, rest_fine: TetMesh, fine: Pieces) -> Array:
    """A displacement (n, 3) mm of coarse pieces on the nodes of fine ones, each on its own piece."""
    out, of_node = np.zeros_like(rest_fine.points), fine.node_piece()
    for number in (0, 1):
        part, nodes = coarse.part(number)
        mine = of_node == number
        out[mine] = interpolate(locate(TetMesh(rest.points[nodes], part.tets), rest_fine.points[mine]), u[nodes])
    return out


def _on_pieces(pose: ChangeOfPose, pieces: Pieces) -> ChangeOfPose:
    """The change of pose on a mesh in pieces, which moves as the one-piece mesh does."""
    points = pieces.mesh.points
    nearest = cKDTree(pose.mesh_ct.points).query(points)[1]
    inversion = pose.inversion
    if inversion is not None:
        inversion = replace(
            inversion, points_fixed=inversion.points_fixed[nearest], residual_mm=inversion.residual_mm[nearest]
        )
    return replace(
        pose,
        mesh_ct=pieces.mesh,
        points_inf=pose.inf_from_ct(points),
        seen=pose.seen[nearest],
        inversion=inversion,
    )


def _with_residual(
    prepared: Prepared, pose: ChangeOfPose, modelled: Collapse, fissure: Fissure, settings: Settings
) -> Collapse:
    """The collapse with what the images add to each piece, registered for itself, so that nothing is smoothed across
    the cut. Nodes that pieces share take the mean of both.
    """
    if modelled.parted is None:
        return modelled
    pieces, observed, found = modelled.parted.pieces, modelled.observed, modelled.model.correspondences
    parts = [pieces.part(number) for number in (0, 1)]
    moved = [TetMesh(modelled.points_after[nodes], part.tets) for part, nodes in parts]
    lungs, faces = _shared_out(observed.found.lung, moved), _nearest_piece(observed.surface.points, moved)
    in_ct = interpolate(locate(modelled.mesh_before, found.moving), pose.mesh_ct.points)
    of_keypoint = (fissure.sheet.distance(in_ct) < 0).astype(int)
    count = len(modelled.points_after)
    sums, hits = np.zeros((count, 3)), np.zeros(count)
    compared, seen, apart, dets = np.zeros(count, bool), np.zeros(count, bool), np.zeros(count), []
    for number, (part, nodes) in enumerate(parts):
        residual = residual_of_part(
            prepared,
            replace(
                modelled,
                observed=replace(
                    observed,
                    found=replace(observed.found, lung=lungs[number]),
                    surface=observed.surface.where(faces == number),
                    mesh_before=TetMesh(modelled.mesh_before.points[nodes], part.tets),
                ),
                model=replace(modelled.model, correspondences=found.only(of_keypoint == number)),
                points_after=modelled.points_after[nodes],
            ),
            TetMesh(pose.points_inf[nodes], part.tets),
            settings,
        )
        hits[nodes] += 1
        if residual is None:
            continue
        sums[nodes] += residual.displacement
        compared[nodes] |= residual.compared
        seen[nodes] |= residual.seen
        apart[nodes] = np.maximum(apart[nodes], residual.disagreement_mm)
        dets.append(residual.min_det)
    if not dets:
        return modelled
    together = Residual(sums / np.maximum(hits, 1)[:, None], compared, seen, apart, min(dets))
    return replace(modelled, residual=together, points_after=modelled.points_after + together.displacement)


def _shared_out(lung: Mask, moved: list[TetMesh]) -> list[Mask]:
    """The collapsed lung as it was segmented, each voxel given to the piece whose modelled mesh is nearest."""
    grid = lung.grid.with_spacing(COARSE_MM)
    far = [
        ndimage.distance_transform_edt(~covered(mesh, grid).inside, sampling=grid.spacing).astype(np.float32)
        for mesh in moved
    ]
    first = resample_mask(Mask(far[0] <= far[1], grid.ras_from_ijk), lung.grid).inside
    return [Mask(lung.inside & mine, lung.ras_from_ijk) for mine in (first, ~first)]


def _nearest_piece(points: Array, moved: list[TetMesh]) -> Array:
    """Number (n,) of the piece whose modelled surface is nearest to points (n, 3)."""
    far = [cKDTree(mesh.boundary.points).query(points)[0] for mesh in moved]
    return np.asarray((far[1] < far[0]).astype(int))
