"""Two scans: where no inflated cone-beam CT was taken, the CT stands in for it, as the change of pose is expected to
have left the lung.

The change of pose is that of the calibration's phantoms (vatsloc/workflow/forecast.py): their mechanics turn the
weight, let the diaphragm rise and the mediastinum fall, and let air out. What is special about this patient's is left
to the second phase, whose model may strain and shift the lung as a whole, and whose keypoints are then matched between
the CT and the collapsed lung.
"""

from __future__ import annotations

import numpy as np

from poro.mesh import TetMesh, stuff
from registration.images.resample import resample
from registration.volume import Array, Grid, Mask, Volume
from vatsloc.case import CaseBefore
from vatsloc.imaging.cbct import Cupping, FieldOfView, PreparedCbct, tissue_hu
from vatsloc.maps import MeshMap, covered, sampled
from vatsloc.workflow.forecast import calibrated_motions, mean_motion, middle_of
from vatsloc.workflow.pose import ChangeOfPose
from vatsloc.workflow.prepare import PreparedBefore, PreparedCt
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import CT, Stages

EXPECTED = "expected change of pose"
VOXEL_MM, MAP_MM = 1.0, 4.0
MARGIN_MM = 60.0
"""What of the CT around the lung stands in: more than the spine and what lies about it."""
AIR_HU = -1000.0
MISSING = (
    "No inflated CBCT was taken: the change of pose is what phantoms' lungs do, not what this one was seen to do. "
    "Inside the lung keypoints make up for that; near the pleura and out of view errors are larger."
)


def stand_in(
    case: CaseBefore, ct: PreparedCt, settings: Settings, stages: Stages
) -> tuple[PreparedBefore, ChangeOfPose]:
    """What a run needs of an inflated scan and of the change of pose, expected instead of seen, in the CT's frame."""
    with stages.stage(EXPECTED, CT):
        mesh = stuff(ct.lung_ct.inside, ct.lung_ct.ras_from_ijk, settings.mesh.edge_mm)
        middle = middle_of(ct.lung_ct)
        motion = mean_motion(mesh.points, middle, case.side, calibrated_motions("inflated"))
        pose = expected_pose(mesh, mesh.points + motion, ct.lung_ct.grid)
        image = as_scan(moved_ct(case.ct, pose.inf_from_ct, pose.lung_inf.grid))
    stages.warn(MISSING)
    return PreparedBefore(ct.lungs, ct.lung_ct, ct.spine_ct, image, ct.spine_ct), pose


def expected_pose(mesh: TetMesh, points: Array, ct: Grid) -> ChangeOfPose:
    """The change of pose that takes a mesh of the CT's lung to points (n, 3), no part of it seen."""
    nowhere = np.zeros(len(points), dtype=bool)
    both = np.concatenate([mesh.points, points])
    ijk = ct.to_ijk(both)
    margin = MARGIN_MM / ct.spacing
    box = ct.box(ijk.min(axis=0) - margin, ijk.max(axis=0) + 1 + margin).with_spacing(np.maximum(ct.spacing, VOXEL_MM))
    lung = covered(TetMesh(points, mesh.tets), box)
    return ChangeOfPose(None, None, lung, mesh, points, nowhere, None, None, 1.0, None)


def moved_ct(ct: Volume, inf_from_ct: MeshMap, grid: Grid) -> Volume:
    """The CT with its lung as it is expected: moved, and denser by what it lost of its volume (HU tell mass)."""
    back = sampled(inf_from_ct.inverse(), grid.with_spacing(MAP_MM))
    moved = resample(ct, grid, back)
    ratio = inf_from_ct.inverse().mesh.volumes.sum() / inf_from_ct.mesh.volumes.sum()
    lung = covered(TetMesh(inf_from_ct.moved, inf_from_ct.mesh.tets), grid).inside
    by_mass = (moved.hu - AIR_HU) / np.float32(ratio) + np.float32(AIR_HU)
    return Volume(np.where(lung, by_mass, moved.hu).astype(np.float32), grid.ras_from_ijk)


def as_scan(image: Volume) -> PreparedCbct:
    """An image without rim, bad slices or cupping in the terms of a cone-beam CT."""
    everywhere = Mask(np.ones(image.hu.shape, dtype=bool), image.ras_from_ijk)
    axis = int(np.argmax(np.abs(image.grid.ras_from_ijk[2, :3])))
    field = FieldOfView(everywhere, everywhere, np.zeros(2), np.inf, axis)
    seen = tissue_hu(image.hu.ravel())
    return PreparedCbct(image, field, Cupping(np.array([0.0, 1.0]), np.zeros(2), 1.0, seen, seen))
