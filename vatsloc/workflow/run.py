"""From a case folder to a results folder, whole or not at all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from poro.mesh import TetMesh
from poro.mesh.tetmesh import signed_volumes
from registration.images.resample import resample_mask
from registration.spine import RigidFit
from registration.volume import Array, Mask, Volume
from vatsloc.case import Case, read_case
from vatsloc.dicomout.export import dicom_of_run, write_objects
from vatsloc.formats.casefile import read_case_file
from vatsloc.formats.folder import whole_folder
from vatsloc.formats.meshes import Surface, TetraMesh
from vatsloc.frames import flip_points
from vatsloc.maps import covered, sampled
from vatsloc.report.collect import report_data
from vatsloc.report.data import LUNG, SURFACE, Outline, Picture
from vatsloc.report.render import render
from vatsloc.report.words import WORDS
from vatsloc.results import (
    RADIUS95,
    REPORT,
    ResultData,
    RunRecord,
    output_files,
    write_answer,
    write_inputs,
    write_results,
)
from vatsloc.slicer_scene import write_result_scenes
from vatsloc.workflow.fields import Carried, carried, fields_entry
from vatsloc.workflow.localization import Localization
from vatsloc.workflow.localize import localize
from vatsloc.workflow.pneumothorax import contact_surface
from vatsloc.workflow.pose import ChangeOfPose
from vatsloc.workflow.quality import surface_percentiles
from vatsloc.workflow.refinement import BlockRefinement
from vatsloc.workflow.residual import Residual
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import DEFLATED, INFLATED, Say, Stages, quiet
from vatsloc.workflow.state import State, read_state
from vatsloc.workflow.uncertainty import scatter

WARP, PAGE = "warp", "report"
FIELD_MARGIN_MM = 10.0
BALL_MM = 5.0
GAS_HU = -1000.0
SEED = 0
"""Of the spine's samples, the only thing drawn at random; fixed, so that a run can be repeated."""


def run_case(
    folder: Path,
    out: Path,
    settings: Settings,
    say: Say = quiet,
    state: Path | None = None,
    answered: Callable[[dict[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """Localize the nodule of the case in `folder`, write everything to `out`, return what run.json holds.

    state: folder that `prepare_case` made, to go on from; answered: is told what answer.json holds as soon as that is
    known, before images, fields and report are made. Raises the errors of reading and of `localize`, CaseError for
    a state of another case; `out` is then untouched.
    """
    stages = Stages(say)
    expected = output_files(read_case_file(folder).images.cbct_inflated is not None)
    with whole_folder(out, expected) as unfinished, stages.named(), stages.beside():
        with stages.stage("read"):
            case = read_case(folder)
        for sentence in case.warnings:
            stages.warn(sentence)
        known = None if state is None else _taken_up(state, case, settings, stages)
        found = localize(case, settings, stages, known)
        to_inflated = partial(_in_inflated, case, found, settings)
        stages.begin(WARP, INFLATED, to_inflated)
        record = _record(case, found, settings, stages)
        answer = write_answer(unfinished, record, found.nodule_def)
        if answered is not None:
            answered(answer)
        with stages.stage(WARP, DEFLATED):
            deflated = _in_deflated(case, found, settings)
        with stages.stage(WARP, INFLATED):
            inflated = stages.done(to_inflated)
        with stages.stage("write"):
            result = _result(case, found, inflated, deflated, record)
            objects, why = dicom_of_run(folder, result)
            if why:
                stages.warn(f"No DICOM objects were written: {why}")
            record = replace(record, warnings=tuple(stages.warnings))
            result = replace(result, run=_with_fields(record, inflated, deflated, found, stages))
            report = partial(_report, case, found, result)
            stages.begin(PAGE, "", report)
            write_results(unfinished, result)
            write_objects(unfinished, objects)
            write_inputs(unfinished, folder, out)
            write_result_scenes(unfinished, folder, out, result)
        with stages.stage(PAGE):
            (unfinished / REPORT).write_text(stages.done(report), encoding="utf-8")
    return result.run.as_json()


def _taken_up(folder: Path, case: Case, settings: Settings, stages: Stages) -> State:
    """The state in a folder, and what its stages had to say."""
    with stages.stage("read"):
        known = read_state(folder, case, settings)
    stages.resume(known.log)
    return known


def _in_inflated(case: Case, found: Localization, settings: Settings) -> Carried | None:
    lung, there, scan = found.prepared.lung_ct, found.pose.inf_from_ct, case.cbct_inflated
    return None if scan is None else carried(case.ct, lung, there, scan.grid, settings.output.field_mm)


def _in_deflated(case: Case, found: Localization, settings: Settings) -> Carried:
    """With the CT as the collapsed lung shows it: what was lung and is not any more has become pleural gas."""
    grid = case.cbct_deflated.grid
    there = carried(case.ct, found.prepared.lung_ct, found.def_from_ct, grid, settings.output.field_mm)
    before, after = (covered(mesh, grid).inside for mesh in (found.collapse.mesh_before, found.collapse.mesh_after))
    return replace(there, ct=Volume(np.where(before & ~after, np.float32(GAS_HU), there.ct.hu), grid.ras_from_ijk))


def _report(case: Case, found: Localization, result: ResultData) -> str:
    return render(report_data(case, result, _pictures(case, found)))


def _result(case: Case, found: Localization, inflated: Carried | None, deflated: Carried, run: RunRecord) -> ResultData:
    pose, collapse = found.pose, found.collapse
    state, after = collapse.fit.state, collapse.mesh_after
    before = collapse.mesh_before
    det_f = signed_volumes(after.points, after.tets) / before.volumes
    pressure, contact = collapse.on_lung(np.column_stack([state.p, state.contact_pressure])).T
    none = np.zeros(len(pressure))
    outer, wall = after.boundary, contact_surface(collapse)
    pose_det = pose.mesh_inf.volumes / pose.mesh_ct.volumes
    return ResultData(
        nodule_inflated_ras=found.nodule_inf,
        nodule_deflated_ras=found.nodule_def,
        nodule_mask_deflated=_nodule_mask(case, found),
        ct_in_inflated=None if inflated is None else inflated.ct,
        ct_in_deflated=deflated.ct,
        lung_ct=_tetra(pose.mesh_ct, np.zeros_like(pose.points_inf), none, np.ones(len(pose_det)), none),
        lung_inflated=_tetra(pose.mesh_inf, pose.points_inf - pose.mesh_ct.points, none, pose_det, none),
        lung_deflated=_with_radius95(found, _tetra(after, after.points - pose.points_inf, pressure, det_f, contact)),
        deflated_surface=Surface(outer.points, outer.triangles),
        contact_surface=Surface(wall.points, wall.triangles),
        inflated_from_ct=None if inflated is None else inflated.from_ct,
        deflated_from_ct=deflated.from_ct,
        ct_from_inflated=None if inflated is None else inflated.to_ct,
        ct_from_deflated=deflated.to_ct,
        rigid_inflated_from_ct=pose.inf_from_ct_rigid.matrix,
        rigid_deflated_from_inflated=collapse.def_from_inf_rigid.matrix,
        run=run,
        stored_axes=case.stored_axes,
    )


def _tetra(mesh: TetMesh, displacement: Array, pressure: Array, det_f: Array, contact: Array) -> TetraMesh:
    """A state of the lung for viewers: mm, kPa."""
    nodal = {"displacement": displacement, "pressure_kpa": pressure, "contact_pressure_kpa": contact}
    return TetraMesh(mesh.points, mesh.tets, nodal, {"det_f": det_f})


def _with_radius95(found: Localization, lung: TetraMesh) -> TetraMesh:
    """With the 95 % radius of each node's position, where it is known."""
    radius = found.radius95_mm
    return lung if radius is None else replace(lung, point_data={**lung.point_data, RADIUS95: radius})


def _nodule_mask(case: Case, found: Localization) -> Mask:
    """The nodule in the deflated CBCT; a nodule known by its centre alone is taken as a ball of 5 mm radius.

    Only about the predicted centre: elsewhere the surroundings' rigid map would find the nodule a second time, in what
    is now pleural air.
    """
    mask, grid = case.nodule.mask, case.cbct_deflated.grid
    if mask is None:
        ball = np.linalg.norm(case.ct.grid.points() - case.nodule.centre_ras, axis=-1) <= BALL_MM
        mask = Mask(ball, case.ct.ras_from_ijk)
    where = mask.grid.to_ras(np.argwhere(mask.inside))
    reach = np.linalg.norm(where - case.nodule.centre_ras, axis=1).max() + FIELD_MARGIN_MM
    at, margin = grid.to_ijk(found.nodule_def), reach / grid.spacing
    box, cut = grid.box(at - margin, at + margin + 1), grid.cut(at - margin, at + margin + 1)
    inside = np.zeros(grid.shape, dtype=bool)
    if min(box.shape) > 0:
        inside[cut] = resample_mask(mask, box, sampled(found.def_from_ct.inverse(), box)).inside
    return Mask(inside, grid.ras_from_ijk)


def _record(case: Case, found: Localization, settings: Settings, stages: Stages) -> RunRecord:
    theta = found.collapse.fit.theta
    return RunRecord(
        status=found.status,
        nodule_lps=flip_points(found.nodule_def),
        nodule_ellipsoid95_mm=found.ellipsoid_mm,
        theta={"kappa_b": theta.kappa_b, "phi": theta.phi, "d_diaph_mm": theta.d_diaph_mm},
        seconds={**stages.seconds, "total": stages.total_seconds},
        peak_mb=max(stages.peak_mb.values()),
        skipped=stages.skipped,
        gates={name: gate.as_json() for name, gate in found.gates.items()},
        warnings=tuple(stages.warnings),
        details={
            "nodule_ellipsoid95_axes_lps": flip_points(found.ellipsoid_axes),
            "peak_mb_by_stage": dict(stages.peak_mb),
            "seed": SEED,
            "settings": settings.model_dump(),
            "input_sha256": dict(case.input_sha256),
            "side": case.side,
            "side_evidence": {"told_by": case.side_told_by, **found.prepared.gas.entry()},
            "calibration": {name: by.entry() for name, by in case.calibration.items()},
            "gravity_ras": case.gravity_ras,
            "choices": [choice.entry() for choice in stages.choices],
            "pieces": {"n": 1, "fissures": []} if found.collapse.parted is None else found.collapse.parted.entry(),
            "solid": found.collapse.model.solid.entry(),
            "scans": case.scans,
            "cbct_preparation": {
                "inflated": None if case.cbct_inflated is None else found.prepared.inflated.removed.entry(),
                "deflated": found.prepared.deflated.removed.entry(),
            },
            "check": None if found.checks is None else found.checks.entry(found.nodule_inf, found.nodule_def),
            "residuals": _residuals(found),
        },
    )


def _with_fields(
    record: RunRecord, inflated: Carried | None, deflated: Carried, found: Localization, stages: Stages
) -> RunRecord:
    """The record with what the fields leave out, and the seconds and memory of what followed the answer."""
    details = {"peak_mb_by_stage": dict(stages.peak_mb), "fields": fields_entry(inflated, deflated, found)}
    return replace(
        record,
        seconds={**stages.seconds, "answer": record.seconds["total"], "total": stages.total_seconds},
        peak_mb=max(stages.peak_mb.values()),
        details={**record.details, **details},
    )


def _residuals(found: Localization) -> dict[str, Any]:
    """Residuals of each solver, with the status that it reports."""
    pose, collapse = found.pose, found.collapse
    state, motion = collapse.fit.state, collapse.observed.motion
    return {
        **_spines(pose.rigid, collapse.observed.rigid),
        **_change_of_pose(pose),
        "hilum": {"source": motion.source.value, "mean_mm": motion.displacement.mean(axis=0)},
        "fit": {
            "status": collapse.fit.status.value,
            "steps": len(collapse.fit.history),
            "model_surface_rms_mm": collapse.fit.surface_rms_mm,
            "contact_iterations": state.iterations,
            "pressure_layer": collapse.system.flow.layer(collapse.fit.theta.kappa_b),
            "active_nodes": int(state.active.sum()),
            "min_det": state.det_f.min(),
            "identifiability": collapse.identifiability.entry(),
            "volume_ratio": collapse.mesh_after.volumes.sum() / collapse.mesh_before.volumes.sum(),
        },
        "keypoints": {"found": len(collapse.model.correspondences), "held_out_mm": collapse.model.held_out_mm},
        "perturbation_ensemble": {"number": len(collapse.model.ensemble), "rms_mm_at_nodule": _scatter_mm(found)},
        "model_selection": [asdict(refinement) for refinement in collapse.model.refinements],
        "residual_registration": _corrected(collapse.residual),
        "block_refinement": {"inflated": _passes(pose.refinement), "deflated": _passes(collapse.refinement)},
        "surface_mm": surface_percentiles(collapse),
        "mesh": {"tetrahedra": len(pose.mesh_ct.tets), "model_tetrahedra": len(collapse.system.mesh.tets)},
    }


def _passes(refinement: BlockRefinement | None) -> list[dict[str, Any]] | None:
    return None if refinement is None else [asdict(one) for one in refinement.passes]


def _scatter_mm(found: Localization) -> float:
    """Root mean square distance in mm of the nodule in the ensemble from where the result puts it."""
    point = found.collapse.def_from_inf_rigid(found.nodule_inf[None])
    return float(np.sqrt(np.trace(scatter(found.collapse, point)[0])))


def _spines(inflated: RigidFit | None, deflated: RigidFit) -> dict[str, Any]:
    if inflated is None:
        return {"spine_ct_deflated": _spine(deflated)}
    return {"spine_ct_inflated": _spine(inflated), "spine_inflated_deflated": _spine(deflated)}


def _spine(fit: RigidFit) -> dict[str, Any]:
    return {"ncc": fit.ncc, "runner_up": fit.runner_up_ncc, "overlap": fit.overlap, "status": fit.status.value}


def _change_of_pose(pose: ChangeOfPose) -> dict[str, Any]:
    if pose.ffd is None or pose.inversion is None:
        return {"free_form": None, "extrapolation": None}
    extended = pose.extrapolation
    return {
        "free_form": {
            "status": pose.ffd.status.value,
            "min_det": pose.ffd.min_det,
            "folded_share": pose.ffd.folded_share,
        },
        "inversion_mm": {"max_at_seen_nodes": pose.inversion.residual_mm[pose.seen].max(initial=0.0)},
        "extrapolation": None
        if extended is None
        else {
            "status": extended.status.value,
            "seen_nodes": int(pose.seen.sum()),
            "released_nodes": len(extended.released),
            "min_det": extended.det_f.min(),
        },
    }


def _corrected(residual: Residual | None) -> dict[str, Any] | None:
    if residual is None:
        return None
    return {
        "seen_nodes": int(residual.seen.sum()),
        "agreed_share": residual.agreed_share,
        "model_error_mm": residual.model_error_mm,
        "median_disagreement_mm": float(np.median(residual.disagreement_mm[residual.seen])),
        "min_det": residual.min_det,
    }


def _pictures(case: Case, found: Localization) -> tuple[Picture, ...]:
    """Intermediate results that a reader should see before trusting the last one."""
    prepared, collapse = found.prepared, found.collapse
    return (
        Picture(
            WORDS["inflated_segmented" if case.cbct_inflated is not None else "inflated_expected"],
            WORDS["inflated_segmented_says" if case.cbct_inflated is not None else "inflated_expected_says"],
            prepared.inflated.volume,
            found.nodule_inf,
            (Outline(WORDS["inflated_lung"], LUNG, found.pose.lung_inf),),
        ),
        Picture(
            WORDS["collapsed_segmented"],
            WORDS["collapsed_segmented_says"],
            prepared.deflated.volume,
            found.nodule_def,
            (Outline(WORDS["collapsed_lung"], SURFACE, collapse.observed.found.lung),),
        ),
    )
