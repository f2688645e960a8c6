"""A result with a known error, from a case folder and a results folder to tre.csv, tre.json and report.html."""

from __future__ import annotations

import csv
import json
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from poro.mesh import stuff
from registration.maps.field import sample_map
from registration.maps.rigid import RigidTransform
from registration.volume import Grid, Mask, Volume
from vatsloc.case import sha256
from vatsloc.errors import CaseError, InputRefused
from vatsloc.evaluation import evaluate_case, table
from vatsloc.evaluation.inputs import MAX_BEYOND_MM, _check_extent, _check_place
from vatsloc.formats.markups import PointList, write_points
from vatsloc.formats.meshes import Surface, TetraMesh, read_vtu, write_vtu
from vatsloc.formats.nifti import write_volume
from vatsloc.frames import flip_points
from vatsloc.report.render import SCORES_FROM, SCORES_TO
from vatsloc.results import LUNG_DEFLATED, RIGID_INFLATED_FROM_CT, ResultData, RunRecord, write_results

PHASE1_ERROR, PHASE2_ERROR = np.array([0.0, 1.0, 0.0]), np.array([3.0, 0.0, -4.0])
NODULE_ERROR = np.array([2.0, 0.0, 0.0])
STRAIN1 = np.array([[0.9, 0.05, 0], [0, 1.0, 0], [0, 0, 0.95]])
STRAIN2 = np.array([[0.6, 0, 0], [0.1, 0.9, 0], [0, 0, 0.8]])
CT = np.array([[x, y, z] for x in (-20.0, 10) for y in (-15.0, 15) for z in (-25.0, 0, 20)])
NODULE = np.array([5.0, -10, 12])


def inflated_from_ct(x):
    return x @ STRAIN1.T + [4.0, -2, 1]


def deflated_from_inflated(x):
    return x @ STRAIN2.T + [-3.0, 2, 5]


RIGID1 = RigidTransform.about(np.zeros(3), np.array([0, 0, 0.1]), np.array([4.0, -2, 1]))
RIGID2 = RigidTransform.about(np.zeros(3), np.zeros(3), np.array([-3.0, 2, 5]))


@pytest.fixture
def folders(tmp_path):
    case, result = tmp_path / "case", tmp_path / "result"
    for folder in (case, case / "truth", result):
        folder.mkdir()
    grid = Grid((40, 40, 40), np.array([[3.0, 0, 0, -58], [0, 3, 0, -59], [0, 0, 3, -60], [0, 0, 0, 1]]))
    image = Volume(np.random.default_rng(0).normal(-400, 300, grid.shape).astype(np.float32), grid.ras_from_ijk)
    write_case(case, image)
    write_result(result, grid, image)
    return case, result


def write_case(case, image):
    names = {"ct": "ct", "inflated": "cbct_inflated", "deflated": "cbct_deflated"}
    lines = ['side = "right"', "[images]", *(f'{name} = "{name}.nii.gz"' for name in names.values())]
    (case / "case.toml").write_text("\n".join([*lines, "[nodule]", 'point = "nodule.mrk.json"']))
    for name in names.values():
        write_volume(case / f"{name}.nii.gz", image)
    labels = tuple(f"L{n}" for n in range(len(CT)))
    inflated = inflated_from_ct(CT) + PHASE1_ERROR
    deflated = deflated_from_inflated(inflated) + PHASE2_ERROR
    write_points(case / "landmarks_ct.mrk.json", PointList(CT, labels))
    # Reversed: the label pairs the points, not their order.
    write_points(case / "landmarks_cbct_inflated.mrk.json", PointList(inflated[::-1], labels[::-1]))
    write_points(case / "landmarks_cbct_deflated.mrk.json", PointList(deflated[1:], labels[1:]))
    truth = deflated_from_inflated(inflated_from_ct(NODULE)) + NODULE_ERROR
    write_points(case / "truth" / "nodule_cbct_deflated.mrk.json", PointList(truth[None], ("nodule",)))


def write_result(result, grid, image):
    lung = stuff(np.linalg.norm(grid.points(), axis=-1) < 40, grid.ras_from_ijk, 12.0)
    inflated = inflated_from_ct(lung.points)
    deflated = deflated_from_inflated(inflated)
    nodule = deflated_from_inflated(inflated_from_ct(NODULE))
    surface = Surface(deflated, np.array([[0, 1, 2]]))
    field = sample_map(inflated_from_ct, grid)
    chain = sample_map(lambda x: deflated_from_inflated(inflated_from_ct(x)), grid)
    digests = {"cbct_deflated": sha256(result.parent / "case" / "cbct_deflated.nii.gz")}
    details = {"nodule_ellipsoid95_axes_lps": np.eye(3), "input_sha256": digests}
    run = RunRecord(
        "converged", flip_points(nodule), np.array([2.5, 1, 1]), {"phi": 0.5}, {"total": 1.0}, 1.0, details=details
    )
    meshes = [TetraMesh(points, lung.tets) for points in (lung.points, inflated, deflated)]
    meshes[2] = replace(meshes[2], point_data={"radius95_mm": 5 + 0.2 * lung.points[:, 0]})
    rigid = (RIGID1.matrix, RIGID2.matrix)
    mask = Mask(grid.points()[..., 0] > 0, grid.ras_from_ijk)
    axes = dict.fromkeys(("ct", "cbct_inflated", "cbct_deflated"), "RAS")
    fields = (field, chain, field, chain)
    start = inflated_from_ct(NODULE), nodule, mask, image, image
    write_results(result, ResultData(*start, *meshes, surface, surface, *fields, *rigid, run, axes))
    (result / "report.html").write_text(f"<p>before</p>{SCORES_FROM}{SCORES_TO}<p>after</p>")


def test_known_errors_come_out(folders):
    case, result = folders
    scores = evaluate_case(case, result)
    assert scores == json.loads((result / "tre.json").read_text())
    assert_allclose([scores["phase1"][k] for k in ("mean", "median", "p95", "max")], 1.0, atol=2e-3)
    assert_allclose(scores["phase1"]["sd"], 0.0, atol=2e-3)
    assert_allclose([scores["phase2"][k] for k in ("mean", "median", "p95", "max")], 5.0, atol=2e-3)
    chain = np.linalg.norm(STRAIN2 @ PHASE1_ERROR + PHASE2_ERROR)
    assert_allclose(scores["chain"]["mean"], chain, atol=4e-3)
    assert [scores[m]["n"] for m in ("phase1", "phase2", "chain")] == [12, 11, 11]
    inflated = inflated_from_ct(CT) + PHASE1_ERROR
    assert_allclose(
        scores["rigid_ct_inflated"]["mean"], np.linalg.norm(RIGID1(CT) - inflated, axis=1).mean(), atol=1e-6
    )
    deflated = (deflated_from_inflated(inflated) + PHASE2_ERROR)[1:]
    before = {"rigid_ct_deflated": RIGID2(RIGID1(CT))[1:], "rigid_inflated_deflated": RIGID2(inflated)[1:]}
    for measure, predicted in before.items():
        assert_allclose(scores[measure]["mean"], np.linalg.norm(predicted - deflated, axis=1).mean(), atol=1e-6)


def test_nodule_error_and_ellipsoid(folders):
    case, result = folders
    scores = evaluate_case(case, result)
    assert_allclose(scores["nodule_deflated_mm"], 2.0, atol=1e-6)
    assert scores["nodule_inflated_mm"] is None
    assert scores["nodule_in_ellipsoid95"] is True


def test_landmarks_are_held_by_the_radius_that_the_result_gives_them(folders):
    case, result = folders
    held = evaluate_case(case, result)["in_radius95"]["landmarks"]
    rows = list(csv.DictReader((result / "tre.csv").read_text().splitlines()))
    radius, x = np.array([[float(row[key]) for key in ("radius95_mm", "ct_x_ras")] for row in rows]).T
    assert_allclose(radius, 5 + 0.2 * x, atol=1e-4)
    # 5 mm off everywhere; the first landmark has no truth in the deflated image.
    assert held["n"] == len(CT) - 1
    assert held["share"] == np.mean(x[1:] > 0)
    assert held["median_mm"] == pytest.approx(np.median(radius[1:]), abs=1e-4)
    assert f"{held['share']:.1%} of {held['n']} landmarks" in table(evaluate_case(case, result))


def test_a_result_without_radii_is_scored_without_them(folders):
    case, result = folders
    lung = read_vtu(result / "lung_deflated.vtu")
    write_vtu(result / "lung_deflated.vtu", TetraMesh(lung.points_ras, lung.tets))
    scores = evaluate_case(case, result)
    assert scores["in_radius95"]["landmarks"] == {"share": None, "n": 0, "median_mm": None}
    assert "95 % radius" not in table(scores)


def test_dense_tissue_is_scored_where_a_phantom_knows_it(folders):
    case, result = folders
    assert evaluate_case(case, result)["dense"] is None
    seen, far = CT, np.add(CT[:3], [0.0, 0, 500])  # the second lot lies outside every image
    ct = np.concatenate([seen, far])
    inflated = inflated_from_ct(ct) + PHASE1_ERROR
    deflated = deflated_from_inflated(inflated) + PHASE2_ERROR
    table_of = np.concatenate([ct, inflated, deflated], axis=1)
    np.savetxt(case / "truth" / "dense_ras_mm.csv", table_of, delimiter=",", header="x", comments="")
    dense = evaluate_case(case, result)["dense"]
    assert_allclose([dense["inside_fov"]["phase1"][k] for k in ("mean", "max")], 1.0, atol=2e-3)
    chain = np.linalg.norm(STRAIN2 @ PHASE1_ERROR + PHASE2_ERROR)
    assert_allclose(dense["inside_fov"]["chain"]["mean"], chain, atol=4e-3)
    assert dense["inside_fov"]["chain"]["n"] == len(CT)
    (case / "truth" / "dense_ras_mm.csv").write_text("x\n1,2,3\n")
    with pytest.raises(InputRefused, match="must hold 9 finite numbers a row"):
        evaluate_case(case, result)


def test_csv_rows_agree_with_the_summary(folders):
    case, result = folders
    scores = evaluate_case(case, result)
    rows = list(csv.DictReader((result / "tre.csv").read_text().splitlines()))
    assert [row["label"] for row in rows] == [f"L{n}" for n in range(len(CT))]
    assert rows[0]["deflated_x_ras"] == rows[0]["phase2_after_mm"] == ""
    assert_allclose([float(rows[1][f"ct_{c}_ras"]) for c in "xyz"], CT[1])
    assert_allclose(
        np.mean([float(r["chain_before_mm"]) for r in rows[1:]]), scores["rigid_ct_deflated"]["mean"], atol=1e-4
    )
    depth = 40 - np.linalg.norm(CT, axis=1)
    # 12 mm chords cut up to 12**2 / 40 / 3 = 1.2 mm off a sphere of 40 mm, and the mask's voxels add half of one.
    assert_allclose([float(r["depth_mm"]) for r in rows], depth, atol=1.7)
    assert {r["inside_mesh"] for r in rows} == {"true"}


def test_table_shows_what_was_computed(folders):
    text = table(evaluate_case(*folders))
    phase2 = next(line for line in text.splitlines() if line.startswith("phase2"))
    assert phase2.split()[1:7] == ["5.00", "0.00", "5.00", "5.00", "5.00", "11"]
    assert "2.00 mm in the deflated one, inside its 95 % ellipsoid" in text


def test_report_takes_the_scores_once_however_often_it_is_evaluated(folders):
    case, result = folders
    evaluate_case(case, result)
    once = (result / "report.html").read_text()
    evaluate_case(case, result)
    assert (result / "report.html").read_text() == once
    assert once.startswith("<p>before</p>")
    assert once.endswith("<p>after</p>")
    assert once.count('id="scores"') == 1
    assert '<td class="n">5.00</td>' in once


def test_landmarks_outside_the_field_of_view_are_named(folders):
    case, result = folders
    far = PointList(np.vstack([CT, [[0.0, 0, 90]]]), (*(f"L{n}" for n in range(len(CT))), "far"))
    write_points(case / "landmarks_ct.mrk.json", far)
    write_points(case / "landmarks_cbct_deflated.mrk.json", PointList(np.array([[0.0, 0, 80]]), ("far",)))
    scores = evaluate_case(case, result)
    assert [w[:20] for w in scores["warnings"]] == ["1 of 13 landmarks li"] * 3
    row = list(csv.DictReader((result / "tre.csv").read_text().splitlines()))[-1]
    assert (row["inside_fov"], row["inside_mesh"]) == ("false", "false")
    assert float(row["depth_mm"]) < -40


def test_case_without_landmarks_is_refused(folders):
    case, result = folders
    for path in case.glob("landmarks_cbct_*"):
        path.unlink()
    with pytest.raises(CaseError, match="no landmarks in the CT and a CBCT"):
        evaluate_case(case, result)


def test_landmarks_without_a_frame_are_refused(folders):
    case, result = folders
    path = case / "landmarks_ct.mrk.json"
    path.write_text(path.read_text().replace('"coordinateSystem": "LPS",', ""))
    with pytest.raises(InputRefused, match="states no coordinateSystem"):
        evaluate_case(case, result)


def test_folder_that_is_no_result_is_refused(folders, tmp_path):
    with pytest.raises(CaseError, match="not a result of localize"):
        evaluate_case(folders[0], tmp_path)


def test_result_of_another_case_is_refused(folders):
    case, result = folders
    other = Volume(
        np.full((40, 40, 40), -400, dtype=np.float32) + np.arange(40, dtype=np.float32), np.diag([3.0, 3, 3, 1])
    )
    write_volume(case / "cbct_deflated.nii.gz", other)
    with pytest.raises(CaseError, match="made from another image"):
        evaluate_case(case, result)
    assert not (result / "tre.json").exists()


def test_lungs_of_two_runs_are_not_mixed(folders):
    case, result = folders
    write_vtu(result / LUNG_DEFLATED, TetraMesh(np.eye(4, 3), np.array([[3, 0, 1, 2]])))
    with pytest.raises(InputRefused, match="different tetrahedra"):
        evaluate_case(case, result)


def test_transform_that_is_not_rigid_is_refused(folders):
    case, result = folders
    path = result / RIGID_INFLATED_FROM_CT
    path.write_text(path.read_text().replace("Parameters: 0.99", "Parameters: 1.99"))
    with pytest.raises(InputRefused, match="no rigid transform"):
        evaluate_case(case, result)


def rewritten(path, change):
    """A point list whose JSON was changed in place."""
    content = json.loads(path.read_text())
    change(content["markups"][0]["controlPoints"])
    path.write_text(json.dumps(content))


def test_landmarks_never_placed_are_left_out_and_said(folders):
    case, result = folders
    rewritten(case / "landmarks_ct.mrk.json", lambda points: points[4].update(positionStatus="undefined"))
    scores = evaluate_case(case, result)
    assert scores["phase1"]["n"] == len(CT) - 1
    assert "1 label(s) without a counterpart were left out: L4." in scores["warnings"]


@pytest.mark.parametrize(("beyond_mm", "refused"), [(MAX_BEYOND_MM, False), (MAX_BEYOND_MM + 1, True)])
def test_landmarks_may_lie_a_stated_length_beyond_their_image(beyond_mm, refused):
    grid = Grid((10, 20, 30), np.eye(4))
    for at in ([-beyond_mm, 4.0, 5.0], [9 + beyond_mm, 4.0, 5.0]):
        with pytest.raises(InputRefused, match="beyond it") if refused else nullcontext():
            _check_place(PointList(np.array([at]), ("1",)), grid, "ct.nii.gz")


@pytest.mark.parametrize("n", [2, 3])
def test_the_span_of_three_landmarks_is_judged_and_of_two_not(n):
    points = PointList(np.outer(np.arange(n), [0.01, 0.01, 0.01]), tuple("abc"[:n]))
    with pytest.raises(InputRefused, match="3 landmarks of ct") if n == 3 else nullcontext():
        _check_extent(points, "ct.nii.gz")


@pytest.mark.parametrize(
    ("image", "scale", "shift", "sentence"),
    [
        ("ct", 1e-3, 0.0, r"12 landmarks of ct\.nii\.gz span 0\.03 x 0\.03 x 0\.045 mm, which no lung does; save them"),
        (
            "cbct_inflated",
            1e-3,
            0.0,
            r"12 landmarks of cbct_inflated\.nii\.gz span 0\.0\d+ x .* mm, which no lung does",
        ),
        (
            "cbct_inflated",
            1.0,
            400.0,
            r"landmarks of cbct_inflated\.nii\.gz lie 594 mm beyond it, 150 mm allowed; save",
        ),
    ],
)
def test_landmarks_of_another_size_or_place_are_refused(folders, image, scale, shift, sentence):
    case, result = folders

    def change(points):
        for point in points:
            point["position"] = [scale * c + shift for c in point["position"]]

    rewritten(case / f"landmarks_{image}.mrk.json", change)
    with pytest.raises(InputRefused, match=sentence):
        evaluate_case(case, result)


@pytest.mark.parametrize(
    "broken",
    [
        {"nodule_ellipsoid95_mm": "large"},
        {"nodule_ellipsoid95_mm": [1, 2]},
        {"nodule_ellipsoid95_mm": 3},
        {"nodule_ellipsoid95_axes_lps": [[1, 0, 0]]},
        {"input_sha256": ["a"]},
    ],
)
def test_a_record_with_wrong_values_is_refused(folders, broken):
    case, result = folders
    run = json.loads((result / "run.json").read_text())
    (result / "run.json").write_text(json.dumps(run | broken))
    with pytest.raises(InputRefused, match=r"not a readable result of localize .*; run localize again"):
        evaluate_case(case, result)
