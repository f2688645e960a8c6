"""What a run writes of what it found, by value: each map, image, mesh and number in its own frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from poro.mesh import TetMesh
from registration.volume import Array, Grid
from tests.vatsloc import run_scene as known
from vatsloc.case import Case
from vatsloc.maps import covered
from vatsloc.report.data import LUNG, SURFACE
from vatsloc.results import ResultData
from vatsloc.workflow.choices import Choice
from vatsloc.workflow.fields import Carried
from vatsloc.workflow.gates import Gate
from vatsloc.workflow.localization import Localization
from vatsloc.workflow.model_selection import Refinement
from vatsloc.workflow.run import _in_deflated, _in_inflated, _nodule_mask, _pictures, _record, _residuals, _result
from vatsloc.workflow.settings import Settings, settings_of
from vatsloc.workflow.stages import Stages
from vatsloc.workflow.uncertainty import radius95

AXES = np.array([[0.6, 0.8, 0], [0, 0, 1.0], [0.8, -0.6, 0]])
ELLIPSOID_MM = np.array([6.0, 5.0, 4.0])
GATES = {"overlap": Gate(0.63, 0.4, True, "a"), "ellipsoid": Gate(6.0, 5.5, False, "b")}


def localization(scene: known.Scene) -> Localization:
    """What `locate_nodule` would make of a scene, with round numbers."""
    return Localization(
        scene.prepared, scene.pose, scene.collapse, known.NODULE_INF, known.NODULE_DEF, ELLIPSOID_MM, AXES, GATES
    )


@pytest.fixture(scope="module")
def found() -> Localization:
    scene = known.scene()
    return replace(localization(scene), radius95_mm=radius95(scene.pose, scene.collapse))


@pytest.fixture(scope="module")
def result(found: Localization) -> ResultData:
    case = known.scene().case
    return _result(case, found, *both_scans(case, found, 0.0), _record(case, found, Settings(), stages()))


def both_scans(case: Case, found: Localization, field_mm: float) -> tuple[Carried, Carried]:
    """What a run makes of the inflated and of the deflated scan, fields on voxels `field_mm` apart."""
    settings = settings_of("balanced", {"output": {"field_mm": field_mm}})
    inflated = _in_inflated(case, found, settings)
    assert inflated is not None
    return inflated, _in_deflated(case, found, settings)


def stages() -> Stages:
    log = Stages()
    log.seconds |= {"pose": 2.5, "fit": 4.0}
    log.peak_mb |= {"pose": 900.0, "fit": 700.0}
    log.skip("extrapolation", "all in view")
    log.warn("beware")
    log.choices.append(Choice("extrapolation", False, "0 %", 0.0, 0.1))
    return log


def mapped(grid: Grid, mesh: TetMesh, inside: known.Affine, around: known.Affine) -> Array:
    """Where one affine map takes the voxels of a mesh and another one all others."""
    points = grid.points()
    return np.where(covered(mesh, grid).inside[..., None], inside(points), around(points))


@pytest.fixture(scope="module")
def ct_of_inflated(found: Localization) -> Array:
    """Where in the CT every voxel of the inflated CBCT was."""
    rigid = known.as_affine(known.INF_FROM_CT_RIGID)
    return mapped(known.INFLATED_GRID, found.pose.mesh_inf, known.INF_FROM_CT.inverse(), rigid.inverse())


@pytest.fixture(scope="module")
def ct_of_deflated(found: Localization) -> Array:
    rigid = known.as_affine(known.DEF_FROM_CT_RIGID)
    return mapped(known.DEFLATED_GRID, found.collapse.mesh_after, known.DEF_FROM_CT.inverse(), rigid.inverse())


def test_images_look_for_each_voxel_of_their_own_grid_in_the_ct(
    result: ResultData, ct_of_inflated: Array, ct_of_deflated: Array
) -> None:
    for field, grid, wanted in (
        (result.ct_from_inflated, known.INFLATED_GRID, ct_of_inflated),
        (result.ct_from_deflated, known.DEFLATED_GRID, ct_of_deflated),
    ):
        assert field.grid.same_as(grid)
        assert_allclose(grid.points() + field.vectors, wanted, atol=1e-3)


def test_points_of_the_ct_go_to_either_image_from_the_lungs_box(found: Localization, result: ResultData) -> None:
    inside = np.argwhere(known.scene().prepared.lung_ct.inside)
    margin = np.ceil(10 / known.CT_GRID.spacing)
    low, high = inside.min(axis=0) - margin, inside.max(axis=0) + margin
    assert (low > 0).all()
    assert (high < np.array(known.CT_GRID.shape) - 1).all()
    for field, mapping in ((result.inflated_from_ct, known.INF_FROM_CT), (result.deflated_from_ct, known.DEF_FROM_CT)):
        assert field.grid.shape == tuple(high - low + 1)
        assert_allclose(field.grid.to_ras(np.zeros(3)), known.CT_GRID.to_ras(low))
        assert_allclose(field.grid.spacing, known.CT_GRID.spacing)
        lung = covered(found.pose.mesh_ct, field.grid).inside
        assert lung.sum() > 3000
        points = field.grid.points()[lung]
        assert_allclose(points + field.vectors[lung], mapping(points), atol=1e-3)


def test_beyond_the_lung_points_of_the_ct_follow_its_nearest_part(result: ResultData) -> None:
    start = np.add(known.CENTRE, [0.0, 38.0, 0.0])  # 8 mm out of the lung, in the box
    near = np.add(known.CENTRE, [0.0, 28.0, 0.0])
    for field, whole, rigid in (
        (result.inflated_from_ct, known.INF_FROM_CT, known.INF_FROM_CT_RIGID),
        (result.deflated_from_ct, known.DEF_FROM_CT, known.DEF_FROM_CT_RIGID),
    ):
        beside = rigid(start[None])[0] + whole(near) - rigid(near[None])[0]
        assert_allclose(field(start[None])[0], beside, atol=2.0)


def shown(points: Array) -> Array:
    """The CT at points (..., 3), -1000 beyond it, NaN within a voxel of its rim."""
    ijk, last = known.CT_GRID.to_ijk(points), np.array(known.CT_GRID.shape) - 1.0
    hu = np.where(((ijk >= 0) & (ijk <= last)).all(axis=-1), known.ct_hu(points), -1000)
    rim = (np.minimum(np.abs(ijk), np.abs(ijk - last)) < 1).any(axis=-1)
    return np.where(rim, np.nan, hu)


def assert_shows(hu: Array, wanted: Array) -> None:
    told = np.isfinite(wanted)
    assert told.mean() > 0.7
    assert_allclose(hu[told], wanted[told], atol=0.05)


def test_the_ct_is_warped_to_the_inflated_image(result: ResultData, ct_of_inflated: Array) -> None:
    assert result.ct_in_inflated.grid.same_as(known.INFLATED_GRID)
    assert_shows(result.ct_in_inflated.hu, shown(ct_of_inflated))


def test_the_ct_is_warped_to_the_deflated_image_and_gas_fills_what_the_lung_left(
    found: Localization, result: ResultData, ct_of_deflated: Array
) -> None:
    grid = known.DEFLATED_GRID
    before, after = (covered(mesh, grid).inside for mesh in (found.collapse.mesh_before, found.collapse.mesh_after))
    left = before & ~after
    assert left.sum() > 1000
    assert (after & ~before).any()
    assert result.ct_in_deflated.grid.same_as(grid)
    assert_array_equal(result.ct_in_deflated.hu[left], -1000)
    assert_shows(result.ct_in_deflated.hu, np.where(left, -1000, shown(ct_of_deflated)))


@pytest.mark.parametrize("marked", [True, False], ids=["a mask", "a point"])
def test_the_nodule_is_drawn_once_where_the_deflated_image_has_it(
    found: Localization, ct_of_deflated: Array, marked: bool
) -> None:
    case, radius = known.scene().case, known.NODULE_RADIUS_MM
    if not marked:
        case, radius = replace(case, nodule=replace(case.nodule, mask=None)), 5.0
    mask = _nodule_mask(case, found)
    assert mask.grid.same_as(known.DEFLATED_GRID)
    lung = covered(found.collapse.mesh_after, known.DEFLATED_GRID).inside
    far = np.linalg.norm(ct_of_deflated - known.NODULE_CT, axis=-1)
    assert (lung & (far < radius - 1.5)).sum() >= 3
    assert mask.inside[lung & (far < radius - 1.5)].all()
    assert not mask.inside[far > radius + 1.5].any()
    assert not mask.inside[~lung].any()  # the rigid map alone would find it again there
    volume = mask.inside.sum() * known.DEFLATED_GRID.spacing.prod() / known.DEF_FROM_CT.det
    assert volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.25)


def test_a_nodule_as_large_as_a_lobe_is_drawn_whole(found: Localization, ct_of_deflated: Array) -> None:
    case, radius = known.scene().case, 36.0
    large = known.ball(known.CT_GRID, known.NODULE_CT, radius)
    mask = _nodule_mask(replace(case, nodule=replace(case.nodule, mask=large)), found)
    lung = covered(found.collapse.mesh_after, known.DEFLATED_GRID).inside
    far = np.linalg.norm(ct_of_deflated - known.NODULE_CT, axis=-1)
    assert mask.inside[lung & (far < radius - 2.5)].all()
    assert (lung & (far < radius - 2.5)).sum() > 200


def test_each_state_of_the_lung_has_its_own_points_and_values(found: Localization, result: ResultData) -> None:
    ct = found.pose.mesh_ct.points
    inflated, before, deflated = known.INF_FROM_CT(ct), found.collapse.mesh_before.points, known.DEF_FROM_CT(ct)
    for lung, points, moved, det_f in (
        (result.lung_ct, ct, np.zeros_like(ct), 1.0),
        (result.lung_inflated, inflated, inflated - ct, known.INF_FROM_CT.det),
        (result.lung_deflated, deflated, deflated - inflated, known.DEF_FROM_INF.det),
    ):
        assert_allclose(lung.points_ras, points)
        assert_array_equal(lung.tets, found.pose.mesh_ct.tets)
        assert_allclose(lung.point_data["displacement"], moved, atol=1e-9)
        assert_allclose(lung.cell_data["det_f"], np.full(len(lung.tets), det_f))
    for lung in (result.lung_ct, result.lung_inflated):
        assert set(lung.point_data) == {"displacement", "pressure_kpa", "contact_pressure_kpa"}
        assert not np.any([lung.point_data["pressure_kpa"], lung.point_data["contact_pressure_kpa"]])
    assert_allclose(result.lung_deflated.point_data["pressure_kpa"], known.pressure(before))
    assert_allclose(result.lung_deflated.point_data["contact_pressure_kpa"], known.contact(before))


def test_each_node_of_the_deflated_lung_says_how_sure_it_is(found: Localization, result: ResultData) -> None:
    spread = known.modelled(found.collapse.mesh_before.points, 4.0)
    longest = np.sqrt(7.814728 * np.linalg.eigvalsh(spread)[:, -1])
    assert_allclose(result.lung_deflated.point_data["radius95_mm"], longest)


def test_surfaces_are_the_lungs_after_and_the_wall_before(found: Localization, result: ResultData) -> None:
    skin = found.collapse.mesh_before.boundary
    before = found.collapse.mesh_before.points[skin.nodes]
    assert_allclose(result.contact_surface.points_ras, before)
    assert_allclose(result.deflated_surface.points_ras, known.AFTER_FROM_BEFORE(before))
    for surface in (result.contact_surface, result.deflated_surface):
        assert_array_equal(surface.triangles, skin.triangles)


def test_nodules_and_rigid_parts_keep_their_names(result: ResultData) -> None:
    assert_allclose(result.nodule_inflated_ras, known.NODULE_INF)
    assert_allclose(result.nodule_deflated_ras, known.NODULE_DEF)
    assert_allclose(result.rigid_inflated_from_ct, known.INF_FROM_CT_RIGID.matrix, atol=1e-12)
    assert_allclose(result.rigid_deflated_from_inflated, known.DEF_FROM_INF_RIGID.matrix, atol=1e-12)
    assert result.stored_axes == {"ct": "RAS", "cbct_inflated": "LPS", "cbct_deflated": "SAL"}


def test_record_holds_each_number_under_its_name(result: ResultData) -> None:
    run = result.run.as_json()
    assert run["status"] == "gate failed"
    assert_allclose(run["nodule_lps"], known.NODULE_DEF * [-1, -1, 1])
    assert run["nodule_ellipsoid95_mm"] == [6.0, 5.0, 4.0]
    assert_allclose(run["nodule_ellipsoid95_axes_lps"], AXES * [-1, -1, 1])
    assert run["theta"] == {"kappa_b": 2e-8, "phi": 0.7, "d_diaph_mm": 11.0}
    assert set(run["seconds"]) == {"pose", "fit", "total"}
    assert (run["seconds"]["pose"], run["seconds"]["fit"], run["peak_mb"]) == (2.5, 4.0, 900.0)
    assert run["peak_mb_by_stage"] == {"pose": 900.0, "fit": 700.0}
    assert (run["skipped"], run["warnings"]) == ({"extrapolation": "all in view"}, ["beware"])
    assert run["gates"]["overlap"] == {"ok": True, "value": 0.63, "limit": 0.4, "says": "a"}
    assert run["gates"]["ellipsoid"] == {"ok": False, "value": 6.0, "limit": 5.5, "says": "b"}
    assert run["input_sha256"] == {"ct": "c0", "cbct_inflated": "1f", "cbct_deflated": "de"}
    assert (run["side"], run["gravity_ras"], run["seed"]) == ("right", [-0.6, 0.0, 0.8], 0)
    assert run["settings"] == Settings().model_dump()
    (choice,) = run["choices"]
    assert (choice["part"], choice["kept"], choice["limit"]) == ("extrapolation", False, 0.1)
    assert run["solid"] == {"strain": "linear strain", "why": "strains little", "share_out_of_range": 0.0004}
    removed = run["cbct_preparation"]
    assert (removed["inflated"]["cupping_hu"], removed["deflated"]["cupping_hu"]) == ([11.0, 0.0], [22.0, 0.0])


def test_residuals_hold_each_solvers_own_numbers() -> None:
    lung = known.scene().pose.mesh_ct
    away = np.full((2, *known.scene().collapse.system.mesh.points.shape), [3.0, 4.0, 0.0])
    away[1] = 0.0
    refinements = (Refinement("first", 4.0, 3.0, True), Refinement("second", 3.0, 2.5, False))
    scene = (
        known.scene().with_collapse(residual=known.corrected(lung)).with_model(ensemble=away, refinements=refinements)
    )
    run = _residuals(localization(scene))
    for name, ncc, other, overlap in (
        ("spine_ct_inflated", 0.81, 0.6, 0.93),
        ("spine_inflated_deflated", 0.72, 0.65, 0.88),
    ):
        assert (run[name]["ncc"], run[name]["runner_up"], run[name]["overlap"]) == (ncc, other, overlap)
    assert run["free_form"]["min_det"] == 0.31
    assert run["free_form"]["folded_share"] == 0.011
    seen = np.arange(len(lung.points)) % 3 > 0
    assert run["inversion_mm"]["max_at_seen_nodes"] == pytest.approx(0.001 * np.flatnonzero(seen)[-1])
    assert (run["extrapolation"]["seen_nodes"], run["extrapolation"]["released_nodes"]) == (seen.sum(), 2)
    assert run["extrapolation"]["min_det"] == 0.42
    assert_allclose(run["hilum"]["mean_mm"], [2.0, 4.0, 4.0])
    fit = run["fit"]
    assert (fit["steps"], fit["model_surface_rms_mm"], fit["contact_iterations"]) == (4, 1.7, 6)
    assert (fit["active_nodes"], fit["min_det"]) == (13, pytest.approx(0.37))
    assert fit["volume_ratio"] == pytest.approx(known.DEF_FROM_INF.det)
    assert fit["pressure_layer"].startswith("The pressure layer, 8.7 mm")
    assert_allclose(fit["identifiability"]["sigma"], np.sqrt(np.diag(known.COVARIANCE)))
    assert run["keypoints"] == {"found": 0, "held_out_mm": 3.0}
    assert run["perturbation_ensemble"] == {"number": 2, "rms_mm_at_nodule": pytest.approx(5 / np.sqrt(2))}
    assert [refinement["name"] for refinement in run["model_selection"]] == ["first", "second"]
    assert run["residual_registration"] == {
        "seen_nodes": 30,
        "agreed_share": 0.75,
        "model_error_mm": 2.5,
        "median_disagreement_mm": pytest.approx(1.45),
        "min_det": 0.55,
    }
    off = np.abs(known.OFF_SURFACE_MM)
    assert run["surface_mm"] == {f"p{n}": pytest.approx(np.percentile(off, n)) for n in (50, 75, 90, 95)}
    tets = len(scene.collapse.system.mesh.tets)
    assert run["mesh"] == {"tetrahedra": len(lung.tets), "model_tetrahedra": tets}


def test_what_the_ensemble_are_off_by_is_read_where_the_spine_puts_the_nodule() -> None:
    mesh = known.scene().collapse.system.mesh
    scene = known.scene().with_model(ensemble=(mesh.points - known.CENTRE)[None])
    placed = known.DEF_FROM_INF_RIGID(known.NODULE_INF[None])[0]
    rms = _residuals(localization(scene))["perturbation_ensemble"]["rms_mm_at_nodule"]
    assert rms == pytest.approx(np.linalg.norm(placed - known.CENTRE))


def test_residuals_say_what_did_not_run() -> None:
    scene = known.scene()
    bare = _residuals(localization(scene.with_pose(ffd=None, inversion=None, extrapolation=None)))
    assert (bare["free_form"], bare["extrapolation"], bare["residual_registration"]) == (None, None, None)
    whole = _residuals(localization(scene.with_pose(extrapolation=None)))
    assert whole["extrapolation"] is None
    assert whole["free_form"]["min_det"] == 0.31


def test_pictures_show_each_image_with_its_own_nodule_and_lung(found: Localization) -> None:
    inflated, deflated = _pictures(known.scene().case, found)
    for picture, title, image, nodule, lung, colour in (
        (
            inflated,
            "Inflated lung as segmented",
            found.prepared.inflated.volume,
            known.NODULE_INF,
            found.pose.lung_inf,
            LUNG,
        ),
        (
            deflated,
            "Collapsed lung as segmented",
            found.prepared.deflated.volume,
            known.NODULE_DEF,
            found.collapse.observed.found.lung,
            SURFACE,
        ),
    ):
        assert picture.title == title
        assert picture.image is image
        assert_allclose(picture.at_ras, nodule)
        (outline,) = picture.outlines
        assert outline.shape is lung
        assert outline.colour == colour
