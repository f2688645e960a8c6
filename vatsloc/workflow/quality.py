"""Quality gates and warnings of a run: what marks a result that should not be trusted, and why."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from poro.fit import FitStatus
from poro.mesh import TetMesh, closest_points
from poro.mesh.tetmesh import signed_volumes
from registration.spine import RigidFit
from registration.volume import Array, Mask
from vatsloc.imaging.surface import Border
from vatsloc.workflow.gates import Gate, at_least, at_most
from vatsloc.workflow.hilum import HilumSource
from vatsloc.workflow.pneumothorax import Collapse
from vatsloc.workflow.pose import ChangeOfPose
from vatsloc.workflow.settings import GateSettings
from vatsloc.workflow.stages import Stages

PERCENTILES = {"p50": 50, "p75": 75, "p90": 90, "p95": 95}
NEAR_PLEURA_MM, SURE_MM = 10.0, 12.0
"""Nodules that cannot be felt lie so near to the pleura; where a quarter of the lung there is known less exactly than
this, tissue is several millimetres off on average in most of the lungs that were looked at, below it in hardly any."""


def quality_gates(pose: ChangeOfPose, collapse: Collapse, limits: GateSettings) -> dict[str, Gate]:
    """Every check of a run but the nodule's own, by name."""
    gates: dict[str, Gate] = {}
    gates |= spine_gates(pose.rigid, collapse.observed.rigid, limits)
    after = collapse.mesh_after
    inverted = float((signed_volumes(after.points, after.tets) <= 0).mean())
    air = len(collapse.observed.surface.only(Border.AIR))
    gates |= {
        "inverted_elements": at_most(inverted, limits.max_inverted_elements, "The collapse turns elements inside out."),
        "deflated_surface": at_least(air, limits.min_surface_points, "Too little of the collapsed lung is seen."),
        "fissures": at_most(
            unexplained_gas(collapse),
            limits.max_fissure_share,
            "Gas lies where the lung was, and no cut between lobes explains it.",
        ),
        "surface": at_most(
            float(np.median(surface_distances(collapse))),
            limits.max_surface_mm,
            "The lung's surface stays off the observed one.",
        ),
    }
    if pose.rigid is not None:
        too_little = "The inflated CBCT shows too little of the lung."
        gates["overlap"] = at_least(pose.overlap, limits.min_overlap, too_little)
    if pose.ffd is not None:
        folded = pose.ffd.folded_share
        gates["registration_folds"] = at_most(
            folded, limits.max_folded_share, "The registration of phase 1 folds space."
        )
    if collapse.model.held_out_mm is not None:
        gates["held_out"] = at_most(
            collapse.model.held_out_mm, limits.max_held_out_mm, "The model does not predict held-out keypoints."
        )
    if collapse.residual is not None:
        gates["agreement"] = at_least(
            collapse.residual.agreed_share, limits.min_agreement, "Registrations there and back disagree."
        )
        gates["model_error"] = at_most(
            collapse.residual.model_error_mm, limits.max_model_error_mm, "The images contradict the model."
        )
    return gates


def unexplained_gas(collapse: Collapse) -> float:
    """Share of the gas's border that came from inside the lung, cuts left out; where too few keypoints tell where it
    came from, the share that faces lung again.
    """
    if collapse.fissure is not None:
        return collapse.fissure.unexplained(collapse.parted is not None)
    air, facing = (len(collapse.observed.surface.only(border)) for border in (Border.AIR, Border.FISSURE))
    return facing / max(air + facing, 1)


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


def surface_distances(collapse: Collapse) -> Array:
    """Distances (n,) in mm of the observed air border from the collapsed mesh, one infinite one where none was seen."""
    points = collapse.observed.surface.only(Border.AIR).points
    if len(points) == 0:
        return np.array([np.inf])
    return np.asarray(np.abs(closest_points(collapse.mesh_after.boundary, points).distance))


def surface_percentiles(collapse: Collapse) -> dict[str, float]:
    """Of those distances in mm, by name; infinite where no air border was seen."""
    distances = surface_distances(collapse)
    if not np.isfinite(distances).all():  # numpy interpolates between two infinite ones
        return dict.fromkeys(PERCENTILES, np.inf)
    return {name: float(np.percentile(distances, share)) for name, share in PERCENTILES.items()}


def warn_of_doubts(pose: ChangeOfPose, collapse: Collapse, stages: Stages) -> None:
    """Warn of what the reader of a result has to know beyond its gates."""
    if collapse.observed.motion.source in (HilumSource.SHIFT, HilumSource.FEW, HilumSource.STILL):
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
        stages.warn(f"{collapse.fit.state.conflicts} nodes were pushed behind the chest wall by the diaphragm.")


def warn_of_unsure_tissue(mesh: TetMesh, seen: Array, radius_mm: Array, stages: Stages) -> None:
    """Warn where a quarter of the lung near the pleura, and in view, may be far from where it is shown, though every
    gate holds. mesh: the lung in the CT; seen: (n,) which nodes the deflated image shows; radius_mm: (n,) that hold
    their tissue with 95 %.
    """
    near = seen & (mesh.node_depths <= NEAR_PLEURA_MM)
    if not near.any():
        return
    of_a_quarter = np.quantile(radius_mm[near], 0.75, weights=mesh.node_volumes[near], method="inverted_cdf")
    if of_a_quarter > SURE_MM:
        stages.warn(
            f"A quarter of the lung in view within {NEAR_PLEURA_MM:.0f} mm of the pleura may be more than "
            f"{of_a_quarter:.0f} mm from where it is shown (radius95_mm of lung_deflated.vtu, 95 %): "
            "away from the nodule, trust that radius and not the picture."
        )


def spine_gates(inflated: RigidFit | None, deflated: RigidFit, limits: GateSettings) -> dict[str, Gate]:
    """Of the CT's spine in the inflated CBCT, if there is one, and of that one's, or the CT's, in the deflated one."""
    if inflated is None:
        return _spine_gates("ct_deflated", deflated, limits)
    return _spine_gates("ct_inflated", inflated, limits) | _spine_gates("inflated_deflated", deflated, limits)


def _spine_gates(name: str, rigid: RigidFit, limits: GateSettings) -> dict[str, Gate]:
    lead = rigid.ncc - rigid.runner_up_ncc
    return {
        f"spine_{name}": at_least(rigid.ncc, limits.min_spine_ncc, "The spines do not match."),
        f"spine_slip_{name}": at_least(lead, limits.min_spine_margin, "The spine may have slipped by a vertebra."),
    }
