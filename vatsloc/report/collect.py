"""From a case and its result to what the report shows."""

from __future__ import annotations

import numpy as np

from poro.mesh import TetMesh
from registration.maps.rigid import RigidTransform
from registration.volume import Array
from vatsloc.case import Case
from vatsloc.formats.meshes import Surface, TetraMesh
from vatsloc.frames import flip_points
from vatsloc.report.data import LUNG, MESH, Comparison, Motion, Nodule, Outline, Picture, ReportData
from vatsloc.report.landmarks import depth_below, surface_landmarks
from vatsloc.report.words import WORDS
from vatsloc.results import ResultData, RunRecord


def report_data(case: Case, result: ResultData, pictures: tuple[Picture, ...] = ()) -> ReportData:
    """Both phases, the lung's meshes and surfaces, and the nodule's depth; `pictures` come after those made here.

    The ellipsoid is drawn where run.json holds its axes as well: details["nodule_ellipsoid95_axes_lps"], (3, 3), a unit
    vector per semi-axis.
    """
    inflated, deflated = _outer(result.lung_inflated), _outer(result.lung_deflated)
    nodule = Nodule(result.nodule_deflated_ras, _ellipsoid(result.run))
    phases = (
        Comparison(
            title=WORDS["phase1"],
            fixed_name=WORDS["inflated_cbct"],
            fixed=case.cbct_inflated,
            before_name=WORDS["ct"],
            before=case.ct,
            before_from_fixed=RigidTransform(result.rigid_inflated_from_ct).inverse(),
            after_name=WORDS["warped_ct"],
            after=result.ct_in_inflated,
            nodule=Nodule(result.nodule_inflated_ras),
            outlines=(Outline(WORDS["lung_model"], LUNG, inflated),),
        ),
        Comparison(
            title=WORDS["phase2"],
            fixed_name=WORDS["deflated_cbct"],
            fixed=case.cbct_deflated,
            before_name=WORDS["inflated_cbct"],
            before=case.cbct_inflated,
            before_from_fixed=RigidTransform(result.rigid_deflated_from_inflated).inverse(),
            after_name=WORDS["warped_ct"],
            after=result.ct_in_deflated,
            nodule=nodule,
            outlines=(Outline(WORDS["lung_model"], LUNG, deflated),),
        ),
    )
    own = (
        Picture(
            WORDS["model_in_ct"],
            WORDS["model_in_ct_says"],
            case.ct,
            case.nodule.centre_ras,
            (Outline(WORDS["lung_model"], LUNG, _outer(result.lung_ct)),),
        ),
        Picture(
            WORDS["contact"],
            WORDS["contact_says"],
            case.cbct_deflated,
            result.nodule_deflated_ras,
            (Outline(WORDS["contact_surface"], MESH, result.contact_surface),),
        ),
    )
    depth, nearest = depth_below(result.deflated_surface, result.nodule_deflated_ras)
    landmarks = () if nearest is None else surface_landmarks(result.deflated_surface, result.contact_surface, nearest)
    return ReportData(
        case_name=case.folder.resolve().name,
        run=result.run.as_json(),
        nodule=nodule,
        phases=phases,
        pictures=(*own, *pictures),
        depth_mm=depth,
        nearest_surface_ras=nearest,
        landmarks=landmarks,
        motion=_motion(result),
    )


def _motion(result: ResultData) -> Motion:
    """The lung's own nodes before and after, so that every state between is a line away."""
    border = TetMesh(result.lung_deflated.points_ras, result.lung_deflated.tets).boundary
    def_from_inf = RigidTransform(result.rigid_deflated_from_inflated)
    before = def_from_inf(result.lung_inflated.points_ras[border.nodes])
    nodule = def_from_inf(result.nodule_inflated_ras[None])[0]
    return Motion(border.triangles, before, border.points, result.contact_surface, nodule)


def _ellipsoid(run: RunRecord) -> Array | None:
    axes, length = run.details.get("nodule_ellipsoid95_axes_lps"), np.asarray(run.nodule_ellipsoid95_mm, dtype=float)
    if axes is None or not np.isfinite(length).all():
        return None
    return flip_points(np.asarray(axes, dtype=float)) * length[:, None]


def _outer(lung: TetraMesh) -> Surface:
    boundary = TetMesh(lung.points_ras, lung.tets).boundary
    return Surface(boundary.points, boundary.triangles)
