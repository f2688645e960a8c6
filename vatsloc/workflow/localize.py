"""The whole method: prepare, change of pose, pneumothorax, and where the nodule is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from poro.collapse import PoroStatus
from poro.fit import FitStatus, ellipsoid95
from poro.mesh import closest_points
from poro.mesh.tetmesh import signed_volumes
from registration.images.resample import coarsen
from registration.spine import RigidFit
from registration.volume import Array, Mask
from vatsloc.case import Case
from vatsloc.errors import NotConverged
from vatsloc.imaging.surface import Border
from vatsloc.maps import MeshMap
from vatsloc.workflow.check import VOXEL_MM, Checks, check_gates, compare
from vatsloc.workflow.gates import Gate, at_least, at_most
from vatsloc.workflow.hilum import HilumSource
from vatsloc.workflow.pneumothorax import Collapse, pneumothorax
from vatsloc.workflow.pose import ChangeOfPose, change_of_pose
from vatsloc.workflow.prepare import Prepared, prepare
from vatsloc.workflow.settings import GateSettings, Settings
from vatsloc.workflow.stages import Stages
from vatsloc.workflow.uncertainty import covariance


@dataclass(frozen=True)
class Localization:
    """Where the nodule is, and everything that says why.

    nodule_inf, nodule_def: (3,) RAS mm in the cone-beam CTs; ellipsoid_mm: (3,) semi-axes that hold it with 95 %,
    longest first; ellipsoid_axes: (3, 3), their directions in rows; checks: what the run's check of itself found, None
    before it.
    """

    prepared: Prepared
    pose: ChangeOfPose
    collapse: Collapse
    nodule_inf: Array
    nodule_def: Array
    ellipsoid_mm: Array
    ellipsoid_axes: Array
    gates: dict[str, Gate]
    checks: Checks | None = None

    @property
    def def_from_inf(self) -> MeshMap:
        """Inflated to deflated CBCT."""
        moved = self.collapse.mesh_after.points
        return MeshMap(self.pose.mesh_inf, moved, self.collapse.def_from_inf_rigid)

    @property
    def def_from_ct(self) -> MeshMap:
        """CT to deflated CBCT."""
        rigid = self.collapse.def_from_inf_rigid @ self.pose.inf_from_ct_rigid
        return MeshMap(self.pose.mesh_ct, self.collapse.mesh_after.points, rigid)

    @property
    def status(self) -> str:
        """ "done", or "gate failed"."""
        return "done" if all(gate.ok for gate in self.gates.values()) else "gate failed"


def localize(case: Case, settings: Settings, stages: Stages) -> Localization:
    """Find the nodule of a case in its deflated cone-beam CT.

    Raises InputRefused for images that do not show what they should, NotConverged when a solver has no answer.
    """
    prepared = prepare(case, stages)
    pose = change_of_pose(case, prepared, settings, stages)
    collapse = pneumothorax(case, prepared, pose, settings, stages)
    found = conclude(case, prepared, pose, collapse, settings, stages)
    with stages.stage("check"):
        return checked(case, found, settings)


def checked(case: Case, found: Localization, settings: Settings) -> Localization:
    """The answer beside the images by eyes that took no part in it: its gates, and a wider ellipsoid where it is off by
    more than it said.
    """
    ct, prepared, pose, collapse = coarsen(case.ct, VOXEL_MM), found.prepared, found.pose, found.collapse
    checks = Checks(
        compare(ct, prepared.inflated, pose.lung_inf, pose.inf_from_ct),
        compare(ct, prepared.deflated, collapse.observed.found.lung, found.def_from_ct),
    )
    here = found.nodule_inf[None], found.nodule_def[None]
    (lengths,), (axes,) = ellipsoid95(covariance(pose, collapse, *here, checks.chain))
    gates = {**found.gates, **check_gates(checks, settings.gates), "ellipsoid": ellipsoid_gate(lengths, settings.gates)}
    return replace(found, ellipsoid_mm=lengths, ellipsoid_axes=axes, gates=gates, checks=checks)


def conclude(
    case: Case, prepared: Prepared, pose: ChangeOfPose, collapse: Collapse, settings: Settings, stages: Stages
) -> Localization:
    """Where the nodule went, how sure that is, and which quality gates hold."""
    if collapse.fit.state.status is PoroStatus.NOT_CONVERGED or collapse.fit.status is FitStatus.CONTACT:
        raise NotConverged("The contact of the collapsing lung did not settle; try another mesh edge_mm.")
    nodule_inf = pose.inf_from_ct(case.nodule.centre_ras[None])[0]
    rigid = collapse.def_from_inf_rigid
    moved = MeshMap(pose.mesh_inf, collapse.mesh_after.points, rigid)
    nodule_def = moved(nodule_inf[None])[0]
    (lengths,), (axes,) = ellipsoid95(covariance(pose, collapse, nodule_inf[None], nodule_def[None]))
    gates = quality_gates(pose, collapse, settings.gates)
    gates["ellipsoid"] = ellipsoid_gate(lengths, settings.gates)
    shown = {
        "inflated": (prepared.inflated.field.usable, nodule_inf),
        "deflated": (prepared.deflated.field.usable, nodule_def),
    }
    gates["nodule_in_view"] = in_view(shown, settings.gates.max_out_of_view_mm, stages)
    _note(pose, collapse, stages)
    return Localization(prepared, pose, collapse, nodule_inf, nodule_def, lengths, axes, gates)


def ellipsoid_gate(semi_axes_mm: Array, limits: GateSettings) -> Gate:
    """Gate on the longest of the ellipsoid's semi-axes (3,)."""
    too_uncertain = "The nodule's position is too uncertain for a wedge resection."
    return at_most(semi_axes_mm.max(), limits.max_ellipsoid_mm, too_uncertain)


def in_view(shown: Mapping[str, tuple[Mask, Array]], limit_mm: float, stages: Stages) -> Gate:
    """Gate on how far out of each image's field of view the nodule (3,) lies there; warns wherever it does."""
    out_mm = {image: field.distance(nodule) for image, (field, nodule) in shown.items()}
    for image, distance in out_mm.items():
        if distance > 0:
            stages.warn(
                f"The nodule lies {distance:.0f} mm out of what the {image} CBCT shows, "
                "so its place there is the model's alone."
            )
    return at_most(max(out_mm.values()), limit_mm, "The nodule lies far out of a CBCT's view.")


def quality_gates(pose: ChangeOfPose, collapse: Collapse, limits: GateSettings) -> dict[str, Gate]:
    """Every check of a run but the nodule's own, by name."""
    gates: dict[str, Gate] = {}
    for name, rigid in (("ct_inflated", pose.rigid), ("inflated_deflated", collapse.observed.rigid)):
        gates |= _spine_gates(name, rigid, limits)
    after = collapse.mesh_after
    inverted = float((signed_volumes(after.points, after.tets) <= 0).mean())
    air, fissure = (len(collapse.observed.surface.only(border)) for border in (Border.AIR, Border.FISSURE))
    gates |= {
        "overlap": at_least(pose.overlap, limits.min_overlap, "The inflated CBCT shows too little of the lung."),
        "inverted_elements": at_most(inverted, limits.max_inverted_elements, "The collapse turns elements inside out."),
        "deflated_surface": at_least(air, limits.min_surface_points, "Too little of the collapsed lung is seen."),
        "fissures": at_most(
            fissure / max(air + fissure, 1),
            limits.max_fissure_share,
            "Lobes have come apart, but the lung is modelled in one piece.",
        ),
        "surface": at_most(
            float(np.median(surface_distances(collapse))),
            limits.max_surface_mm,
            "The lung's surface stays off the observed one.",
        ),
    }
    if pose.ffd is not None:
        folded = pose.ffd.folded_share
        gates["registration_folds"] = at_most(
            folded, limits.max_folded_share, "The registration of phase 1 folds space."
        )
    if collapse.model.held_out_mm is not None:
        gates["held_out"] = at_most(
            collapse.model.held_out_mm, limits.max_held_out_mm, "The model does not predict places it has not seen."
        )
    if collapse.residual is not None:
        gates["agreement"] = at_least(
            collapse.residual.agreed_share, limits.min_agreement, "Registrations there and back disagree."
        )
        gates["model_error"] = at_most(
            collapse.residual.model_error_mm, limits.max_model_error_mm, "The images contradict the model."
        )
    return gates


def surface_distances(collapse: Collapse) -> Array:
    """Distances (n,) in mm of the observed air border from the collapsed mesh, one infinite one where none was seen."""
    points = collapse.observed.surface.only(Border.AIR).points
    if len(points) == 0:
        return np.array([np.inf])
    return np.asarray(np.abs(closest_points(collapse.mesh_after.boundary, points).distance))


def _spine_gates(name: str, rigid: RigidFit, limits: GateSettings) -> dict[str, Gate]:
    lead = rigid.ncc - rigid.runner_up_ncc
    return {
        f"spine_{name}": at_least(rigid.ncc, limits.min_spine_ncc, "The spines do not match."),
        f"spine_slip_{name}": at_least(lead, limits.min_spine_margin, "The spine may have slipped by a vertebra."),
    }


def _note(pose: ChangeOfPose, collapse: Collapse, stages: Stages) -> None:
    if collapse.observed.motion.source in (HilumSource.SHIFT, HilumSource.STILL):
        stages.warn(f"The hilum's motion comes from {collapse.observed.motion.source.value}.")
    if collapse.residual is None and "residual registration" not in stages.skipped:
        stages.warn("Too little lung is seen in both CBCTs to correct the model by what they show inside it.")
    if not collapse.observed.found.is_collapsed:
        stages.warn("The deflated CBCT shows hardly any pleural air, so the lung may not have collapsed.")
    unsettled = collapse.fit.status
    if unsettled is not FitStatus.CONVERGED:
        stages.warn(f"The fit ended early: {unsettled.value}.")
    held = collapse.identifiability.at_bound
    if held:
        stages.warn(f"The fit ended at a bound of {' and '.join(held)}: the model makes up there for what it lacks.")
    if np.any(collapse.fit.state.conflicts):
        stages.warn(f"{collapse.fit.state.conflicts} nodes were pushed behind the cage by the diaphragm.")
