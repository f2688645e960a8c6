"""Phase 2, pneumothorax: from the inflated to the deflated cone-beam CT. Ref: Alvarez 2021, section 7."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from poro.collapse import PoroSystem
from poro.fit import Fit, Identifiability, identifiability
from poro.mesh import TetMesh, TriSurface, interpolate, locate
from registration.maps.rigid import RigidTransform
from registration.volume import Array
from vatsloc.case import Case
from vatsloc.maps import MeshMap
from vatsloc.workflow.choices import weigh
from vatsloc.workflow.model_selection import CollapseModel, select_model
from vatsloc.workflow.observe import Observed, observe
from vatsloc.workflow.pose import ChangeOfPose
from vatsloc.workflow.prepare import Prepared
from vatsloc.workflow.refinement import BlockRefinement, Compared, Shape, refine_by_blocks
from vatsloc.workflow.residual import Residual, residual_registration
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import Stages

RESIDUAL = "residual registration"
REFINEMENT = "block refinement, deflated"


@dataclass(frozen=True)
class Collapse:
    """The lung after its collapse, in the deflated CBCT's frame.

    model: what mechanics made of the observations; residual: what images added to it; refinement: what small blocks of
    the CT added to that, None where it is off; points_after: (n, 3) mm, nodes of `observed.mesh_before` after all.
    """

    observed: Observed
    model: CollapseModel
    residual: Residual | None
    points_after: Array
    refinement: BlockRefinement | None = None

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


def pneumothorax(case: Case, prepared: Prepared, pose: ChangeOfPose, settings: Settings, stages: Stages) -> Collapse:
    """See what there is of the collapsed lung, fit the poroelastic model to it, correct that by the images inside."""
    observed = observe(case, prepared, pose, settings, stages)
    return collapse(case, prepared, pose, observed, settings, stages)


def collapse(
    case: Case, prepared: Prepared, pose: ChangeOfPose, observed: Observed, settings: Settings, stages: Stages
) -> Collapse:
    """The part of `pneumothorax` that follows the observations."""
    model = select_model(case.gravity_ras, prepared, observed, settings, stages)
    before = observed.mesh_before
    after = before.points + interpolate(locate(observed.model_mesh, before.points), model.displacement)
    residual = _residual(prepared, pose, observed, model, after, settings, stages)
    after = after if residual is None else after + residual.displacement
    if not settings.refinement.on:
        stages.skip(REFINEMENT, "switched off in the settings")
        return Collapse(observed, model, residual, after)
    with stages.stage(REFINEMENT):
        to_deflated = MeshMap(pose.mesh_ct, after, observed.def_from_inf_rigid @ pose.inf_from_ct_rigid)
        refinement = refine_by_blocks(
            Compared(case.ct, prepared.lung_ct, prepared.deflated, observed.found.lung),
            Shape(before, to_deflated, np.zeros(0, dtype=int)),
            settings.refinement,
        )
    return Collapse(observed, model, residual, refinement.points, refinement)


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
    rigid, chosen = observed.def_from_inf_rigid, settings.residual
    if any(refinement.kept for refinement in model.refinements):
        chosen = chosen.model_copy(update={"levels": max(chosen.levels - 1, 1)})
    with stages.stage(RESIDUAL):
        return residual_registration(
            prepared,
            observed.found.lung,
            MeshMap(pose.mesh_inf, after, rigid),
            observed.mesh_before,
            observed.surface,
            chosen,
            model.correspondences.mapped(moving=rigid.inverse()),
        )


def contact_surface(collapse: Collapse) -> TriSurface:
    """What the collapsing lung may not pass: its own surface before the collapse."""
    return collapse.mesh_before.boundary
