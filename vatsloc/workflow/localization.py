"""Where the nodule is, and what says so: the result of a run, its uncertainty, its gates and its check."""

from __future__ import annotations

from dataclasses import dataclass, replace

from poro.collapse import PoroStatus
from poro.fit import FitStatus, ellipsoid95
from registration.images.resample import coarsen
from registration.verification import LeftOver
from registration.volume import Array
from vatsloc.case import Case
from vatsloc.errors import NotConverged
from vatsloc.maps import MeshMap
from vatsloc.workflow.check import CHECK, VOXEL_MM, Checks, check_gates, compare
from vatsloc.workflow.gates import Gate
from vatsloc.workflow.pneumothorax import Collapse
from vatsloc.workflow.pose import ChangeOfPose
from vatsloc.workflow.prepare import Prepared
from vatsloc.workflow.quality import ellipsoid_gate, in_view, quality_gates, warn_of_doubts, warn_of_unsure_tissue
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import Stages
from vatsloc.workflow.uncertainty import covariance, radius95


@dataclass(frozen=True)
class Localization:
    """Where the nodule is, and everything that says why.

    nodule_inf, nodule_def: (3,) RAS mm in the cone-beam CTs; ellipsoid_mm: (3,) semi-axes that hold it with 95 %,
    longest first; ellipsoid_axes: (3, 3), their directions in rows; checks: what the run's check of itself found;
    radius95_mm: (n,) of the lung's nodes, that hold where their tissue is with 95 %; both None before the check.
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
    radius95_mm: Array | None = None

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


def locate_nodule(
    case: Case, prepared: Prepared, pose: ChangeOfPose, collapse: Collapse, settings: Settings, stages: Stages
) -> Localization:
    """Where the nodule went, its 95 % ellipsoid, and which quality gates hold. Raises NotConverged."""
    if collapse.fit.state.status is PoroStatus.NOT_CONVERGED or collapse.fit.status is FitStatus.CONTACT:
        raise NotConverged("The contact of the collapsing lung did not settle; try another mesh edge_mm.")
    nodule_inf = pose.inf_from_ct(case.nodule.centre_ras[None])[0]
    rigid = collapse.def_from_inf_rigid
    moved = MeshMap(pose.mesh_inf, collapse.mesh_after.points, rigid)
    nodule_def = moved(nodule_inf[None])[0]
    (lengths,), (axes,) = ellipsoid95(covariance(pose, collapse, nodule_inf[None], nodule_def[None]))
    gates = quality_gates(pose, collapse, settings.gates)
    gates["ellipsoid"] = ellipsoid_gate(lengths, settings.gates)
    shown = {"deflated": (prepared.deflated.field.usable, nodule_def)}
    if case.cbct_inflated is not None:
        shown = {"inflated": (prepared.inflated.field.usable, nodule_inf), **shown}
    gates["nodule_in_view"] = in_view(shown, settings.gates.max_out_of_view_mm, stages)
    warn_of_doubts(pose, collapse, stages)
    return Localization(prepared, pose, collapse, nodule_inf, nodule_def, lengths, axes, gates)


def checked(
    case: Case, found: Localization, settings: Settings, stages: Stages, phase1: LeftOver | None = None
) -> Localization:
    """The result with the gates of its check by independent keypoints, and with a wider ellipsoid where these show an
    error that it does not hold. phase1: what is left over of the change of pose, None without an inflated scan.
    """
    with stages.stage(CHECK):
        ct, prepared, pose, collapse = coarsen(case.ct, VOXEL_MM), found.prepared, found.pose, found.collapse
        chain = compare(ct, prepared.deflated, collapse.observed.found.lung, found.def_from_ct)
        checks = Checks(phase1, chain)
        here = found.nodule_inf[None], found.nodule_def[None]
        (lengths,), (axes,) = ellipsoid95(covariance(pose, collapse, *here, checks.chain))
        gates = {
            **found.gates,
            **check_gates(checks, settings.gates),
            "ellipsoid": ellipsoid_gate(lengths, settings.gates),
        }
        radius = radius95(pose, collapse, checks.chain)
        warn_of_unsure_tissue(pose.mesh_ct, prepared.deflated.field.usable.holds(collapse.points_after), radius, stages)
        return replace(found, ellipsoid_mm=lengths, ellipsoid_axes=axes, gates=gates, checks=checks, radius95_mm=radius)
