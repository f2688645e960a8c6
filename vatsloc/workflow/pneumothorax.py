"""Phase 2, pneumothorax: from the inflated to the deflated cone-beam CT. Ref: Alvarez 2021, section 7."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from poro.collapse import PoroSystem
from poro.fit import Fit, Identifiability, identifiability
from poro.mesh import TetMesh, TriSurface, interpolate, locate
from registration.maps.rigid import RigidTransform
from registration.volume import Array
from vatsloc.case import Case
from vatsloc.maps import MeshMap
from vatsloc.workflow.choices import weigh
from vatsloc.workflow.fissures import Fissure, Parted
from vatsloc.workflow.model_selection import CollapseModel, select_model
from vatsloc.workflow.observe import Observed
from vatsloc.workflow.pose import ChangeOfPose
from vatsloc.workflow.prepare import Prepared
from vatsloc.workflow.refinement import BlockRefinement, Compared, Prospect, Shape, prospect, refine_by_blocks
from vatsloc.workflow.residual import Residual, residual_registration
from vatsloc.workflow.seen_fissure import PIECES, seen_fissure
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import Stages

RESIDUAL = "residual registration"
REFINEMENT = "block refinement, deflated"


@dataclass(frozen=True)
class Collapse:
    """The lung after its collapse, in the deflated CBCT's frame.

    model: what mechanics made of the observations; residual: what images added to it; refinement: what small blocks of
    the CT added to that, None where it is off; points_after: (n, 3) mm, nodes of `observed.mesh_before` after all;
    fissure: the sheet along which it may have parted, None where that was not looked for; parted: how it was cut, None
    for one piece.
    """

    observed: Observed
    model: CollapseModel
    residual: Residual | None
    points_after: Array
    refinement: BlockRefinement | None = None
    fissure: Fissure | None = None
    parted: Parted | None = None

    @property
    def def_from_inf_rigid(self) -> RigidTransform:
        """Rigid part, inflated to deflated CBCT."""
        return self.observed.def_from_inf_rigid

    @property
    def mesh_before(self) -> TetMesh:
        """The lung before, placed by the spine."""
        return self.observed.mesh_before

    @property
    def mesh_after(self) -> TetMesh:
        """The collapsed lung."""
        return TetMesh(self.points_after, self.mesh_before.tets)

    @property
    def system(self) -> PoroSystem:
        """The model's lung."""
        return self.model.system

    @property
    def fit(self) -> Fit:
        """The model's parameters."""
        return self.model.fit

    @property
    def identifiability(self) -> Identifiability:
        """What the observations tell of each parameter."""
        return identifiability(self.fit, self.system)

    def on_lung(self, nodal: Array) -> Array:
        """A nodal field of the model's mesh on the nodes of the lung's."""
        return interpolate(locate(self.system.mesh, self.mesh_before.points), nodal)


def begin_refinement(case: Case, prepared: Prepared, observed: Observed, settings: Settings, stages: Stages) -> None:
    """Begin what `refined` needs of the images alone, beside the model."""
    if settings.refinement.on:
        stages.begin(REFINEMENT, "", partial(_prospect, case, prepared, observed, settings))


def collapse(
    case: Case, prepared: Prepared, pose: ChangeOfPose, observed: Observed, settings: Settings, stages: Stages
) -> Collapse:
    """Fit the poroelastic model to what was observed, and correct it by the images inside."""
    model = select_model(case.gravity_ras, prepared, observed, settings, stages)
    if model.is_refined:
        stages.begin(PIECES, "", partial(seen_fissure, pose, observed, model.correspondences))
    return modelled(prepared, pose, observed, model, settings, stages)


def modelled(
    prepared: Prepared, pose: ChangeOfPose, observed: Observed, model: CollapseModel, settings: Settings, stages: Stages
) -> Collapse:
    """The collapse as a model has it, with what the images add to it."""
    before = observed.mesh_before
    after = before.points + interpolate(locate(observed.model_mesh, before.points), model.displacement)
    residual = _residual(prepared, pose, observed, model, after, settings, stages)
    return Collapse(observed, model, residual, after if residual is None else after + residual.displacement)


def refined(
    case: Case, prepared: Prepared, pose: ChangeOfPose, collapse: Collapse, settings: Settings, stages: Stages
) -> Collapse:
    """The collapse, in one piece or in several, after it followed small blocks of the CT."""
    if not settings.refinement.on:
        stages.skip(REFINEMENT, "switched off in the settings")
        return collapse
    with stages.stage(REFINEMENT):
        around, parted = collapse.def_from_inf_rigid @ pose.inf_from_ct_rigid, collapse.parted
        shape = Shape(
            collapse.mesh_before,
            MeshMap(pose.mesh_ct, collapse.points_after, around),
            np.zeros(0, dtype=int),
            cut=None if parted is None else parted.fissure.sheet.distance,
            piece=None if parted is None else parted.pieces.node_piece(),
        )
        known = stages.done(partial(_prospect, case, prepared, collapse.observed, settings))
        refinement = refine_by_blocks(known, shape)
    return replace(collapse, points_after=refinement.points, refinement=refinement)


def _prospect(case: Case, prepared: Prepared, observed: Observed, settings: Settings) -> Prospect:
    """What is ready for the refinement by blocks as soon as the collapsed lung is found."""
    compared = Compared(case.ct, prepared.lung_ct, prepared.deflated, observed.found.lung)
    return prospect(compared, observed.mesh_before, settings.refinement)


def _residual(
    prepared: Prepared,
    pose: ChangeOfPose,
    observed: Observed,
    model: CollapseModel,
    after: Array,
    settings: Settings,
    stages: Stages,
) -> Residual | None:
    """What the images add to the model's nodes (n, 3) mm; None where they are not asked, or show too little."""
    if not settings.residual.on:
        stages.skip(RESIDUAL, "switched off in the settings")
        return None
    misfit_mm = np.inf if model.held_out_mm is None else model.held_out_mm
    seen = f"the model misses held-out keypoints by {misfit_mm:.2f} mm (median)"
    if not stages.choose(weigh(RESIDUAL, misfit_mm, settings.leave_out.residual_mm, seen)):
        return None
    with stages.stage(RESIDUAL):
        return residual_of_part(prepared, Collapse(observed, model, None, after), pose.mesh_inf, settings)


def residual_of_part(prepared: Prepared, modelled: Collapse, mesh_inf: TetMesh, settings: Settings) -> Residual | None:
    """What the images add to the model of a lung, or of a part of it whose mesh in the inflated CBCT is `mesh_inf`."""
    model, rigid, chosen = modelled.model, modelled.def_from_inf_rigid, settings.residual
    if model.is_refined:
        chosen = chosen.model_copy(update={"levels": max(chosen.levels - 1, 1)})
    return residual_registration(
        prepared,
        modelled.observed.found.lung,
        MeshMap(mesh_inf, modelled.points_after, rigid),
        modelled.mesh_before,
        modelled.observed.surface,
        chosen,
        model.correspondences.mapped(moving=rigid.inverse()),
    )


def contact_surface(collapse: Collapse) -> TriSurface:
    """What the collapsing lung may not pass: its own surface before the collapse."""
    return collapse.mesh_before.boundary
