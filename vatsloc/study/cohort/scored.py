"""A run in memory as evaluation scores it: its maps, and its errors at tissue of the dense truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from poro.mesh import stuff
from registration.volume import Array
from vatsloc.evaluation.inputs import Truth, depth_below_pleura, seen_in
from vatsloc.evaluation.statistics import distances
from vatsloc.evaluation.tre import RunMaps
from vatsloc.maps import MeshMap
from vatsloc.workflow.pneumothorax import Collapse
from vatsloc.workflow.pose import ChangeOfPose
from vatsloc.workflow.prepare import Prepared

DEPTH_EDGE_MM = 8.0
"""Tetrahedra of the lung that depths are taken from, as those of a run."""


@dataclass(frozen=True)
class Tissue:
    """The tissue of a dense truth that both cone-beam CTs show. ct, deflated: (n, 3) RAS mm; depth_mm: (n,) below the
    pleura, that of the CT's lung, the same for every variant.
    """

    ct: Array
    deflated: Array
    depth_mm: Array

    @classmethod
    def of(cls, prepared: Prepared, truth: Truth) -> Tissue:
        """Empty without dense truth."""
        if truth.dense is None:
            return cls(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
        ct, inflated, deflated = (truth.dense[:, n] for n in range(3))
        places = {"inflated": inflated, "deflated": deflated}
        seen = np.logical_and.reduce([seen_in(field, places[image]) for image, field in truth.fields_of_view.items()])
        lung = prepared.lung_ct
        depth = depth_below_pleura(stuff(lung.inside, lung.ras_from_ijk, DEPTH_EDGE_MM), ct[seen])
        return cls(ct[seen], deflated[seen], depth)

    def errors_mm(self, maps: RunMaps) -> Array:
        """Errors (n,) of the whole chain."""
        return distances(maps.def_from_ct(self.ct), self.deflated)


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
