"""Phase 1, change of pose: from the CT to the inflated cone-beam CT. Ref: Alvarez 2021, section 6."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy import ndimage

from poro.fem import Extrapolation, Tissue, extrapolate
from poro.mesh import TetMesh, stuff
from poro.mesh.tetmesh import signed_volumes
from registration.ffd import FfdFit, FfdSettings, Weights
from registration.images.resample import coarsen_mask
from registration.maps.inversion import Inversion, invert_at
from registration.maps.monomials import monomials
from registration.maps.rigid import RigidTransform
from registration.sliding import LungImage, SlidingFit, register_sliding
from registration.spine import RigidFit, SpineSearch, register_spine
from registration.volume import Array, Mask
from vatsloc.case import CaseBefore
from vatsloc.imaging.lungs import Side
from vatsloc.imaging.surface import inflated_surface
from vatsloc.imaging.thorax import carry_prior, inflated_lung, require_share, visible_share
from vatsloc.maps import MeshMap
from vatsloc.workflow.choices import Choice, weigh
from vatsloc.workflow.prepare import PreparedBefore
from vatsloc.workflow.refinement import BlockRefinement, Compared, Shape, prospect, refine_by_blocks
from vatsloc.workflow.settings import RegistrationSettings, Settings
from vatsloc.workflow.stages import CT, INFLATED, Stages

RIM_MM = 4.0
"""Nodes nearer than this to the rim of what the scanner saw are left to the extrapolation."""
SEEN, UNSEEN = 100.0, 1.0
"""Weights of the registration at nodes that the scanner saw, and of its smooth continuation at the others. Elastic
tissue that nothing holds there falls back towards the spine's pose: it was 3 to 12 mm off, and is 2 to 4 continued."""
SHALLOW, SHALLOW_MM, DEEP_MM = 0.01, 4.0, 16.0
"""Weight of the registration at seen nodes up to a depth below the pleura, and from which depth on it counts in full.
Near the wall no texture told it anything, and a spline runs on straight while the tissue slides."""
POLYNOMIAL_MM = 50.0
LEAST_STRETCH = 0.3
"""Smallest det of the gradient of a polynomial map that the lung may be laid out by."""
REFINEMENT = "block refinement, inflated"
HINT_REACH_MM = 10.0
"""How far a marked vertebra may be off: less than half the distance to the next one."""
FIRST = "first registration"
"""A part that the scene has a say in: the coarse levels, led by keypoints matched far off the spine's pose."""
Register = Callable[..., FfdFit]
"""A registration that is called as `register_sliding` is."""


@dataclass(frozen=True)
class ChangeOfPose:
    """The lung before its collapse. mesh_ct, points_inf: the same nodes in the CT and in the inflated CBCT, mm.

    rigid: None without an inflated CBCT; what stands in for it (vatsloc/workflow/stand_in.py) lies in the CT's frame.
    ffd, its inversion at the nodes: None where the lung was left to the spine alone; extrapolation: None there too, and
    what it left before the refinement; seen: (n,) nodes that the scanner saw; lung_inf: lung mask in the CBCT; overlap:
    share of the lung in its field of view; refinement: what blocks near the pleura added, None where it is off.
    """

    rigid: RigidFit | None
    ffd: FfdFit | None
    lung_inf: Mask
    mesh_ct: TetMesh
    points_inf: Array
    seen: Array
    inversion: Inversion | None
    extrapolation: Extrapolation | None
    overlap: float
    refinement: BlockRefinement | None = None

    @property
    def inf_from_ct_rigid(self) -> RigidTransform:
        """Rigid part, CT to inflated CBCT."""
        return RigidTransform.identity() if self.rigid is None else self.rigid.moving_from_fixed.inverse()

    @property
    def inf_from_ct(self) -> MeshMap:
        """CT to inflated CBCT."""
        return MeshMap(self.mesh_ct, self.points_inf, self.inf_from_ct_rigid)

    @property
    def mesh_inf(self) -> TetMesh:
        """The lung's mesh in the inflated CBCT."""
        return TetMesh(self.points_inf, self.mesh_ct.tets)


def change_of_pose(
    case: CaseBefore,
    prepared: PreparedBefore,
    settings: Settings,
    stages: Stages,
    register: Register = register_sliding,
) -> ChangeOfPose:
    """Register the CT to the inflated CBCT and continue the motion to the whole lung."""
    hinted = _hinted(case)
    with stages.stage("spine CT to inflated"):
        rigid = register_spine(
            prepared.inflated.volume,
            case.ct,
            prepared.spine_inflated.mask,
            prepared.spine_ct.mask,
            initial=hinted,
            fixed_seen=prepared.inflated.field.usable,
            search=None if hinted is None else SpineSearch(shift_mm=HINT_REACH_MM),
        )
    ct_from_inf_rigid, inf_from_ct_rigid = rigid.moving_from_fixed, rigid.moving_from_fixed.inverse()
    overlap = visible_share(prepared.lung_ct, prepared.inflated.field, inf_from_ct_rigid)
    require_share(overlap, as_side(case.side), settings.gates.min_overlap)
    with stages.stage("inflated lung", INFLATED):
        prior = carry_prior(prepared.lungs, as_side(case.side), prepared.inflated.volume, ct_from_inf_rigid)
        lung_inf = inflated_lung(prepared.inflated, prior)
    with stages.stage("mesh", CT):
        mesh = stuff(prepared.lung_ct.inside, prepared.lung_ct.ras_from_ijk, settings.mesh.edge_mm)
    placed = TetMesh(inf_from_ct_rigid(mesh.points), mesh.tets)
    compared = Compared(case.ct, prepared.lung_ct, prepared.inflated, lung_inf)
    ready = partial(prospect, compared, placed, settings.refinement)
    if settings.registration.on and settings.refinement.on:
        stages.begin(REFINEMENT, "", ready)
    stages.fail_early()  # before what takes long
    if not settings.registration.on:
        stages.skip("free-form deformation", "switched off in the settings")
        nowhere = np.zeros(len(mesh.points), dtype=bool)
        return ChangeOfPose(rigid, None, lung_inf, mesh, placed.points, nowhere, None, None, overlap, None)
    with stages.stage("free-form deformation"):
        ffd = register(
            LungImage(prepared.inflated.volume, lung_inf, prepared.inflated.field.usable),
            LungImage(case.ct, prepared.lung_ct),
            ffd_settings(settings.registration),
            ct_from_inf_rigid,
            coarse_beyond_mm=settings.leave_out.first_registration_mm,
            progress=lambda what, _share: stages.say(what),
        )
        if isinstance(ffd, SlidingFit):
            stages.choose(moved_far(ffd, settings.leave_out.first_registration_mm))
    with stages.stage("inversion and extrapolation"):
        inversion = invert_at(ffd.moving_from_fixed, mesh.points, placed.points)
        settled = inversion.residual_mm < settings.gates.max_inversion_mm
        seen = _deep_inside(prepared.inflated.field.usable, inversion.points_fixed) & settled
        extension = continued(mesh, placed, inversion.points_fixed, seen, settled)
    points, refinement = placed.points + extension.u, None
    if settings.refinement.on:
        with stages.stage(REFINEMENT):
            anchors = np.flatnonzero(seen & (mesh.node_depths > DEEP_MM))
            wall = inflated_surface(lung_inf, prepared.inflated.volume, prepared.inflated.field)
            shape = Shape(placed, MeshMap(mesh, points, inf_from_ct_rigid), anchors, DEEP_MM, wall)
            refinement = refine_by_blocks(stages.done(ready), shape)
        points = refinement.points
    else:
        stages.skip(REFINEMENT, "switched off in the settings")
    return ChangeOfPose(
        rigid=rigid,
        ffd=ffd,
        lung_inf=lung_inf,
        mesh_ct=mesh,
        points_inf=points,
        seen=seen,
        inversion=inversion,
        extrapolation=extension,
        overlap=overlap,
        refinement=refinement,
    )


def moved_far(fit: SlidingFit, limit_mm: float) -> Choice:
    """Whether keypoints inside the lung moved so far that the coarse levels were needed."""
    moved, seen = fit.moved_mm, "too few keypoints were matched inside the lung about the spine's pose"
    if fit.matched:
        seen = f"95 % of {fit.matched} keypoints inside the lung moved by at most {moved:.1f} mm against the spine"
    return weigh(FIRST, moved, limit_mm, seen)


def continued(mesh: TetMesh, placed: TetMesh, points: Array, seen: Array, settled: Array) -> Extrapolation:
    """The registration's motion, believed where the images told it and continued elastically elsewhere.

    mesh, placed: the lung in the CT, and there placed by the spine; points: (n, 3) where the registration puts the
    nodes; seen, settled: (n,) bool, in view; inverted. The elastic lung is first laid out by the best quadratic map of
    the nodes that are believed in full, since linear elasticity loses large rotations and strains.
    """
    depth = mesh.node_depths
    deep = np.clip((depth - SHALLOW_MM) / (DEEP_MM - SHALLOW_MM), 0, 1)
    told = SHALLOW * (SEEN / SHALLOW) ** deep
    weights = np.where(seen, told, np.minimum(told, UNSEEN))
    laid_out = TetMesh(_laid_out(placed, points, seen & (depth > (SHALLOW_MM + DEEP_MM) / 2)), mesh.tets)
    nodes = np.flatnonzero(settled)
    found = extrapolate(laid_out, nodes, (points - laid_out.points)[nodes], Tissue(), weights[nodes])
    u = laid_out.points + found.u - placed.points
    return replace(found, u=u, det_f=signed_volumes(placed.points + u, mesh.tets) / placed.volumes)


def _laid_out(placed: TetMesh, points: Array, believed: Array) -> Array:
    """Nodes (n, 3) under the best quadratic map of the believed ones, or the best affine one, or none: the first that
    keeps every element's shape.
    """
    centre = placed.points.mean(axis=0)
    for degree in (2, 1):
        terms = np.stack(monomials(((placed.points - centre) / POLYNOMIAL_MM).T, degree), axis=1)
        if believed.sum() < 4 * terms.shape[1]:
            continue
        laid_out = terms @ np.linalg.lstsq(terms[believed], points[believed], rcond=None)[0]
        if (signed_volumes(laid_out, placed.tets) > LEAST_STRETCH * placed.volumes).all():
            return np.asarray(laid_out)
    return placed.points


def ffd_settings(settings: RegistrationSettings) -> FfdSettings:
    """The registration's own settings, from those of a run."""
    return FfdSettings(
        spacing_mm=settings.grid_mm,
        levels=settings.levels,
        voxel_mm=settings.voxel_mm,
        window_mm=settings.window_mm,
        weights=Weights(bending=settings.bending),
    )


def as_side(side: str) -> Side:
    """ "left" or "right", for the type checker too."""
    return "left" if side == "left" else "right"


def _hinted(case: CaseBefore) -> RigidTransform | None:
    """Start of the spine search from the same vertebra marked in both images; None without hints."""
    ct, inflated = case.hints.spine_ct_ras, case.hints.spine_cbct_inflated_ras
    if ct is None or inflated is None:
        return None
    return RigidTransform.about(inflated, np.zeros(3), ct - inflated)


def _deep_inside(usable: Mask, points_ras: Array) -> Array:
    """Which points (n, 3) lie more than RIM_MM inside the region."""
    coarse = coarsen_mask(usable, 4.0)
    inside = np.pad(coarse.hu >= 0.5, 1)
    depth = ndimage.distance_transform_edt(inside, sampling=coarse.grid.spacing)
    ijk = coarse.grid.to_ijk(points_ras).T + 1
    return np.asarray(ndimage.map_coordinates(depth, ijk, order=1, mode="constant", cval=0.0) > RIM_MM)
