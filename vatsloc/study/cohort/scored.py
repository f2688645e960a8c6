"""A run's maps in memory as evaluation scores them."""

from __future__ import annotations

from vatsloc.evaluation.tre import RunMaps
from vatsloc.maps import MeshMap
from vatsloc.workflow.pneumothorax import Collapse
from vatsloc.workflow.pose import ChangeOfPose


def run_maps(pose: ChangeOfPose, collapse: Collapse) -> RunMaps:
    """Rigid and deforming maps of both phases and of the chain."""
    rigid, then = pose.inf_from_ct_rigid, collapse.def_from_inf_rigid
    after = collapse.mesh_after.points
    return RunMaps(
        rigid_inf_from_ct=rigid,
        rigid_def_from_ct=then @ rigid,
        rigid_def_from_inf=then,
        inf_from_ct=pose.inf_from_ct,
        def_from_inf=MeshMap(pose.mesh_inf, after, then),
        def_from_ct=MeshMap(pose.mesh_ct, after, then @ rigid),
    )
