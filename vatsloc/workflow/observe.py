"""What the images tell about the collapse, before any mechanics. Ref: Alvarez 2021, section 7.1."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from poro.collapse import still_lung
from poro.fem import Tissue
from poro.mesh import TetMesh, TriSurface, stuff
from registration.images.resample import resample_mask
from registration.maps.rigid import RigidTransform
from registration.spine import RigidFit, register_spine
from registration.volume import Array, Mask
from vatsloc.case import Case
from vatsloc.errors import InputRefused
from vatsloc.imaging.hilum import Hilum, find_hilum
from vatsloc.imaging.lattice import working_copy
from vatsloc.imaging.pleura import Pneumothorax, find_pneumothorax
from vatsloc.imaging.side import Seen
from vatsloc.imaging.surface import Border, SurfacePoints, deflated_surface
from vatsloc.imaging.thorax import SPACING_MM, ThoraxPrior, central_airways
from vatsloc.maps import MeshMap, covered, sampled
from vatsloc.workflow.hilum import HilumMotion, HilumSource, hilum_motion
from vatsloc.workflow.pose import ChangeOfPose, as_side
from vatsloc.workflow.prepare import SPINE_INFLATED_TO_DEFLATED, Prepared, PreparedCt, pose_between
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import DEFLATED, Stages

HILUM, SET_UP = "hilum", "model set-up"


@dataclass(frozen=True)
class Observed:
    """What was seen of a collapse, in the deflated CBCT's frame.

    rigid: of the spines; found, surface: the collapsed lung; mesh_before: the change of pose's tetrahedra, placed by
    the spine; model_mesh: the coarser ones of the model, likewise; hilum_nodes: (k,) its held nodes, and their motion.
    """

    rigid: RigidFit
    found: Pneumothorax
    surface: SurfacePoints
    mesh_before: TetMesh
    model_mesh: TetMesh
    hilum: Hilum
    hilum_nodes: Array
    motion: HilumMotion

    @property
    def def_from_inf_rigid(self) -> RigidTransform:
        """Rigid part, inflated to deflated CBCT."""
        return self.rigid.moving_from_fixed.inverse()


def observe(
    case: Case,
    prepared: Prepared,
    pose: ChangeOfPose,
    settings: Settings,
    stages: Stages,
    rigid: RigidFit | None = None,
) -> Observed:
    """Register the spines (unless `rigid` is given), find the collapsed lung's surface and how its hilum moved."""
    if rigid is None:
        with stages.stage(SPINE_INFLATED_TO_DEFLATED):
            inflated = Seen(prepared.inflated, prepared.spine_inflated)
            deflated = Seen(prepared.deflated, prepared.spine_deflated)
            rigid = stages.done(lambda: pose_between(inflated, deflated))
    def_from_inf = rigid.moving_from_fixed.inverse()
    before = TetMesh(def_from_inf(pose.points_inf), pose.mesh_ct.tets)
    with stages.stage(HILUM):
        hilum_ct, coarse = stages.done(partial(lung_of_model, prepared, case.side, settings))
        to_def = MeshMap(pose.mesh_ct, before.points, def_from_inf @ pose.inf_from_ct_rigid)
        hilum = Hilum(to_def(hilum_ct.point_ras[None])[0], hilum_ct.radius_mm, hilum_ct.on_airways)
        model_mesh = TetMesh(to_def(coarse.points), coarse.tets)
        nodes = held_nodes(model_mesh, hilum.point_ras, settings.model.hilum_radius_mm)
    with stages.stage("deflated surface", DEFLATED):
        prior = _prior(prepared, pose, def_from_inf, case.side)
        moved = partial(_motion, prepared, prior, hilum, def_from_inf, model_mesh.points[nodes], settings)
        stages.begin(HILUM, "", moved)
        stages.begin(SET_UP, "", partial(still_lung, model_mesh, Tissue(), case.gravity_ras, nodes))
        found = find_pneumothorax(prepared.deflated, prior)
        surface = _hinted_surface(case) or deflated_surface(found, prepared.deflated.field)
        if not surface.confidence.any():
            raise InputRefused(
                f"The {DEFLATED} shows nothing of the collapsed lung's surface; take a scan of the operated side after "
                "the lung was let down, or give points of its surface in case.toml, [hints] deflated_surface."
            )
    with stages.stage(HILUM):
        motion = stages.done(moved)
    return Observed(rigid, found, surface, before, model_mesh, hilum, nodes, motion)


def lung_of_model(prepared: PreparedCt, side: str, settings: Settings) -> tuple[Hilum, TetMesh]:
    """The lung's hilum in the CT, and the model's mesh there."""
    lung = prepared.lung_ct
    hilum = find_hilum(lung, prepared.lungs.airways, as_side(side))
    return hilum, stuff(lung.inside, lung.ras_from_ijk, settings.mesh.model_edge_mm)


def spine_from_ct(case: Case, prepared: Prepared, stages: Stages) -> RigidFit:
    """The spine of the CT itself registered to the deflated CBCT, where no inflated one was taken."""
    with stages.stage("spine CT to deflated"):
        return register_spine(
            prepared.deflated.volume,
            case.ct,
            prepared.spine_deflated.mask,
            prepared.spine_ct.mask,
            fixed_seen=prepared.deflated.field.usable,
        )


def held_nodes(mesh: TetMesh, hilum: Array, radius_mm: float) -> Array:
    """Nodes within `radius_mm` of the hilum (3,); at least the twelve nearest."""
    far = np.linalg.norm(mesh.points - hilum, axis=1)
    nodes = np.flatnonzero(far <= radius_mm)
    return nodes if len(nodes) >= 12 else np.sort(np.argsort(far)[:12])


def _prior(prepared: Prepared, pose: ChangeOfPose, def_from_inf: RigidTransform, side: str) -> ThoraxPrior:
    """Where the inflated lung, the other one and the airways lie in the deflated CBCT's frame, by the spine alone."""
    coarse = working_copy(prepared.deflated.volume, SPACING_MM).grid
    rigid = def_from_inf @ pose.inf_from_ct_rigid
    here = MeshMap(pose.mesh_ct, def_from_inf(pose.points_inf), rigid)
    ct_from_def = sampled(here.inverse(), coarse.with_spacing(4.0))
    other = prepared.lungs.left if side == "right" else prepared.lungs.right
    return ThoraxPrior(
        covered(TetMesh(here.moved, pose.mesh_ct.tets), coarse),
        resample_mask(other, coarse, rigid.inverse()),
        resample_mask(prepared.lungs.airways, coarse, ct_from_def),
    )


def _motion(
    prepared: Prepared,
    prior: ThoraxPrior,
    hilum: Hilum,
    def_from_inf: RigidTransform,
    points: Array,
    settings: Settings,
) -> HilumMotion:
    if not settings.model.hilum:
        return HilumMotion(np.zeros_like(points), HilumSource.OFF)
    grid = prior.airways.grid
    airways = Mask(central_airways(prior, grid), grid.ras_from_ijk)
    return hilum_motion(prepared.inflated, prepared.deflated, airways, hilum, def_from_inf.inverse(), points)


def _hinted_surface(case: Case) -> SurfacePoints | None:
    """Points by hand instead of found ones, all equally sure; None without the hint."""
    hint = case.hints.deflated_surface
    if hint is None:
        return None
    return hand_placed(hint.points_ras, hint.triangles)


def hand_placed(points: Array, triangles: Array) -> SurfacePoints:
    """Surface points from an STL (vertices with their normals) or from bare points (normals away from their middle)."""
    if len(triangles):
        normals = TriSurface(points, triangles, np.arange(len(points))).node_normals
    else:
        normals = points - points.mean(axis=0)
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    return SurfacePoints(points, normals, np.ones(len(points)), np.full(len(points), Border.AIR, dtype=np.int8))
