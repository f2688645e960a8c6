"""An evaluation by value where no two states, maps, views, depths and errors are alike."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from poro.mesh import TetMesh
from registration.maps.field import sample_map
from registration.volume import Array, Grid, Mask
from tests.vatsloc import run_scene as known
from vatsloc.case import Landmarks
from vatsloc.evaluation.evaluate import Evaluation, as_csv, evaluate
from vatsloc.evaluation.inputs import Result, Truth, depth_below_pleura
from vatsloc.evaluation.landmarks import LandmarkTriples
from vatsloc.evaluation.statistics import signed_rank_p
from vatsloc.evaluation.table import table
from vatsloc.evaluation.tre import RunMaps, target_registration_errors

# The lung of the CT is a ball of 40 mm about the origin, moved by 100 mm along R in each further image.
INFLATED_AT, DEFLATED_AT = np.array([100.0, 0, 0]), np.array([200.0, 0, 0])
# Along A, in mm: where each map puts a point too far, and where the truth is.
OFF = {
    "rigid_inf_from_ct": 21.0,
    "inf_from_ct": 3.0,
    "rigid_def_from_ct": 45.0,
    "rigid_def_from_inf": 32.0,
    "def_from_inf": 5.0,
    "def_from_ct": 8.0,
}
RADIAL = np.array([2.0, 6.0, 12.0, 13.0, 22.0, 23.0, 24.0, 30.5, 33.0, 35.0, 37.0, 50.0])  # mm from the middle
CT = RADIAL[:, None] * [0.0, 0.0, 1.0]
ERRORS = np.linspace(0.0, 1.1, 12)  # mm that landmark n's truth lies further along S in either cone-beam CT
LABELS = tuple(f"L{n}" for n in range(12))


def shifted(by: Array, off_mm: float) -> Any:
    return lambda x: x + by + [0, off_mm, 0]


def maps() -> RunMaps:
    both = DEFLATED_AT - INFLATED_AT
    return RunMaps(
        rigid_inf_from_ct=shifted(INFLATED_AT, OFF["rigid_inf_from_ct"]),
        rigid_def_from_ct=shifted(DEFLATED_AT, OFF["rigid_def_from_ct"]),
        rigid_def_from_inf=shifted(both, OFF["rigid_def_from_inf"]),
        inf_from_ct=shifted(INFLATED_AT, OFF["inf_from_ct"]),
        def_from_inf=shifted(both, OFF["def_from_inf"]),
        def_from_ct=shifted(DEFLATED_AT, OFF["def_from_ct"]),
    )


def triples() -> LandmarkTriples:
    up = ERRORS[:, None] * [0.0, 0.0, 1.0]
    inflated, deflated = CT + INFLATED_AT + up, CT + DEFLATED_AT - up
    inflated[0] = deflated[1] = np.nan
    return LandmarkTriples(LABELS, CT, inflated, deflated, ("lost", "stray", "odd", "gone"))


def wanted() -> dict[str, Array]:
    """Error of every landmark by measure."""
    e, no_inf, no_def = ERRORS, np.arange(12) == 0, np.arange(12) == 1
    along = {
        "rigid_ct_inflated": (OFF["rigid_inf_from_ct"], e, no_inf),
        "phase1": (OFF["inf_from_ct"], e, no_inf),
        "rigid_ct_deflated": (OFF["rigid_def_from_ct"], e, no_def),
        "rigid_inflated_deflated": (OFF["rigid_def_from_inf"], 2 * e, no_inf | no_def),
        "phase2": (OFF["def_from_inf"], 2 * e, no_inf | no_def),
        "chain": (OFF["def_from_ct"], e, no_def),
    }
    return {name: np.where(lost, np.nan, np.hypot(off, up)) for name, (off, up, lost) in along.items()}


def test_each_measure_takes_its_own_map_its_own_start_and_its_own_truth() -> None:
    errors = target_registration_errors(triples(), maps())
    assert list(errors.mm) == list(wanted())
    for name, mm in wanted().items():
        assert_allclose(errors.mm[name], mm, err_msg=name)
    assert_allclose(errors.inflated, CT + INFLATED_AT + [0, 3.0, 0])
    assert_allclose(errors.deflated, CT + DEFLATED_AT + [0, 8.0, 0])
    known_inf = triples().inflated + DEFLATED_AT - INFLATED_AT + [0, 5.0, 0]
    assert_allclose(errors.deflated_from_inflated, known_inf)


def slab(at: Array, below_mm: float) -> Mask:
    """A field of view about a point, up to a height."""
    grid = Grid((12, 12, 90), np.array([[4.0, 0, 0, at[0] - 22], [0, 4, 0, -22], [0, 0, 1, -20], [0, 0, 0, 1]]))
    return Mask(grid.points()[..., 2] <= below_mm, grid.ras_from_ijk)


TURN = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()
ELLIPSOID_MM = np.array([9.0, 4.0, 2.0])


@pytest.fixture(scope="module")
def lung() -> TetMesh:
    return known.ball_mesh(np.zeros(3), 40.0, 16.0)


@pytest.fixture(scope="module")
def result(lung: TetMesh) -> Result:
    low = np.diag([8.0, 8.0, 3.0, 1.0])
    low[:3, 3] = [-40, -40, -20]
    grid = Grid((11, 11, 22), low)  # up to 43 mm along S
    run = {"nodule_ellipsoid95_mm": ELLIPSOID_MM.tolist(), "nodule_ellipsoid95_axes_lps": (TURN * [-1, -1, 1]).tolist()}
    inflated = TetMesh(lung.points * [1, 1, 0.83] + INFLATED_AT, lung.tets)
    return Result(
        run=run,
        maps=maps(),
        field=sample_map(lambda x: x, grid),
        lung_ct=lung,
        lung_inflated=inflated,
        nodule_inflated_ras=np.array([100.0, 1, 2]),
        nodule_deflated_ras=np.array([200.0, 3, 4]),
        radius95_mm=7.0 + 0.1 * lung.points[:, 2],
    )


def truth(nodule_off: Array | None = None) -> Truth:
    off = np.array([0.0, 6.0, 0.0]) if nodule_off is None else nodule_off
    nodule = Landmarks(None, None, None, np.array([103.0, 1, 6]), np.array([200.0, 3, 4]) + off)
    views = {"inflated": slab(INFLATED_AT, 32.5), "deflated": slab(DEFLATED_AT, 22.6)}
    return Truth(triples(), nodule, views)


@pytest.fixture(scope="module")
def scores(result: Result) -> Evaluation:
    return evaluate(truth(), result)


def mean(values: Array) -> float:
    return float(np.nanmean(values))


def test_summary_of_each_measure_is_of_its_own_errors(scores: Evaluation) -> None:
    for name, mm in wanted().items():
        known_mm = mm[np.isfinite(mm)]
        got = scores.summary[name]
        assert got["mean"] == pytest.approx(known_mm.mean()), name
        assert got["sd"] == pytest.approx(known_mm.std(ddof=1)), name
        assert (got["median"], got["max"]) == (pytest.approx(np.median(known_mm)), pytest.approx(known_mm.max()))
        assert got["p95"] == pytest.approx(np.percentile(known_mm, 95))
        assert got["n"] == len(known_mm)


def test_depth_is_below_the_surface_of_the_ct(scores: Evaluation) -> None:
    # A faceted ball of 16 mm edges lies up to 16**2 / 40 / 3 = 2.1 mm inside its sphere.
    assert_allclose(scores.depth_mm, 40 - RADIAL, atol=2.2)


def test_strata_hold_the_errors_of_their_own_depth(scores: Evaluation) -> None:
    for measure in ("phase1", "phase2", "chain"):
        strata, mm = scores.summary["by_depth"][measure], wanted()[measure]
        assert [(s["from_mm"], s["to_mm"]) for s in strata] == [(0, 10), (10, 20), (20, 30), (30, None)]
        for stratum, members in zip(strata, ([7, 8, 9, 10, 11], [4, 5, 6], [2, 3], [0, 1]), strict=True):
            values = mm[members][np.isfinite(mm[members])]
            assert stratum["n"] == len(values)
            assert stratum["mean"] == (pytest.approx(values.mean()) if len(values) else None)


def test_a_landmark_is_in_view_where_both_images_show_it(scores: Evaluation) -> None:
    # In the inflated image up to 32.5 mm, in the deflated one up to 22.6 mm; a missing point counts as seen.
    height_inf, height_def = RADIAL + ERRORS, RADIAL - ERRORS
    seen = (height_inf <= 32.9) & (height_def <= 22.9)
    assert seen.tolist() == [True] * 6 + [False] * 6
    assert scores.inside_fov.tolist() == seen.tolist()
    for measure in ("phase1", "phase2", "chain"):
        mm = wanted()[measure][seen]
        assert scores.summary["inside_fov"][measure]["mean"] == pytest.approx(mean(mm))
        assert scores.summary["inside_fov"][measure]["n"] == np.isfinite(mm).sum()


@pytest.mark.parametrize("training_only", ["inflated", "deflated"])
def test_either_image_alone_can_put_a_landmark_out_of_view(result: Result, training_only: str) -> None:
    at = {"inflated": INFLATED_AT, "deflated": DEFLATED_AT}
    views = {name: slab(where, 14.0 if name == training_only else 60.0) for name, where in at.items()}
    seen = evaluate(replace(truth(), fields_of_view=views), result).inside_fov
    assert seen.tolist() == [True] * 4 + [False] * 8


def test_a_landmark_is_in_the_mesh_where_both_lungs_hold_it(scores: Evaluation) -> None:
    # The inflated lung is a ball that ends 33.2 mm along S, the CT's one at 40 mm.
    assert scores.inside_mesh.tolist() == [True] * 8 + [False] * 4


def test_warnings_count_what_they_name(scores: Evaluation) -> None:
    counted = [(int(w.split()[0]), w) for w in scores.summary["warnings"]]
    assert [n for n, _ in counted] == [4, 6, 4, 1]
    for (_, sentence), words in zip(
        counted, ("without a counterpart", "field of view", "outside the lung model", "exported field"), strict=True
    ):
        assert words in sentence
    assert "lost, stray, odd, gone" in counted[0][1]


def test_before_and_after_are_compared_within_each_phase(scores: Evaluation) -> None:
    mm = wanted()
    pairs = {"phase1": "rigid_ct_inflated", "phase2": "rigid_inflated_deflated", "chain": "rigid_ct_deflated"}
    assert scores.summary["wilcoxon_p"] == {
        after: pytest.approx(signed_rank_p(mm[before], mm[after])) for after, before in pairs.items()
    }
    assert len({scores.summary["wilcoxon_p"][m] for m in ("phase1", "phase2")}) == 2  # 11 pairs and 10


def test_radii_hold_the_chains_errors_at_the_points_of_the_ct(scores: Evaluation) -> None:
    inner = RADIAL < 38
    assert_allclose(scores.radius95_mm[inner], 7 + 0.1 * RADIAL[inner])
    chain = wanted()["chain"]
    told = np.isfinite(chain)
    held = scores.summary["in_radius95"]["landmarks"]
    assert held["n"] == told.sum() == 11
    assert held["share"] == pytest.approx((chain <= scores.radius95_mm)[told].mean())
    assert 0.1 < held["share"] < 0.95
    assert held["median_mm"] == pytest.approx(np.median(scores.radius95_mm[told]))


def test_each_nodule_is_measured_from_its_own_truth(scores: Evaluation) -> None:
    assert scores.summary["nodule_inflated_mm"] == pytest.approx(5.0)
    assert scores.summary["nodule_deflated_mm"] == pytest.approx(6.0)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(("share", "inside"), [(0.99, True), (1.01, False)])
def test_the_nodules_ellipsoid_is_read_in_its_own_oblique_axes(
    result: Result, axis: int, share: float, inside: bool
) -> None:
    off = share * ELLIPSOID_MM[axis] * TURN[axis]
    assert evaluate(truth(off), result).summary["nodule_in_ellipsoid95"] is inside


def test_nothing_is_said_of_a_nodule_that_is_not_known(result: Result) -> None:
    unknown = replace(truth(), nodule=Landmarks(None, None, None, None, None))
    summary = evaluate(unknown, result).summary
    keys = ("nodule_inflated_mm", "nodule_deflated_mm", "nodule_in_ellipsoid95")
    assert [summary[key] for key in keys] == [None, None, None]


def test_dense_tissue_is_scored_in_and_out_of_view(result: Result) -> None:
    heights = np.array([1.0, 10.0, 25.0, 31.0])  # the second half is seen in the inflated image alone
    ct = heights[:, None] * [0.0, 0, 1]
    inflated, deflated = ct + INFLATED_AT + [0, 1.0, 0], ct + DEFLATED_AT + [0, 0.0, 0]
    inflated[0, 1] += 7.0
    deflated[2, 1] -= 1.5
    dense = np.stack([ct, inflated, deflated], axis=1)
    summary = evaluate(replace(truth(), dense=dense), result).summary
    got = {
        (where, measure): (s["mean"], s["max"], s["n"])
        for where, measures in summary["dense"].items()
        if where != "by_depth"
        for measure, s in measures.items()
    }
    assert got == {
        ("inside_fov", "phase1"): (pytest.approx(3.5), pytest.approx(5.0), 2),
        ("inside_fov", "chain"): (pytest.approx(8.0), pytest.approx(8.0), 2),
        ("outside_fov", "phase1"): (pytest.approx(2.0), pytest.approx(2.0), 2),
        ("outside_fov", "chain"): (pytest.approx(8.75), pytest.approx(9.5), 2),
    }
    held = summary["in_radius95"]
    assert (held["inside_fov"]["share"], held["inside_fov"]["n"]) == (0.5, 2)
    assert held["inside_fov"]["median_mm"] == pytest.approx(7 + 0.1 * 5.5)
    assert held["outside_fov"]["median_mm"] == pytest.approx(7 + 0.1 * 28.0)


def test_dense_tissue_in_view_is_scored_by_depth_below_the_pleura(result: Result) -> None:
    lung = result.lung_ct
    centre = lung.boundary.points.mean(axis=0)
    ct = centre + np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0, 0.2], [500.0, 0, 0]])  # the last one far outside
    depth = depth_below_pleura(lung, ct)
    inflated, deflated = ct + INFLATED_AT + np.array([0, 1.0, 0]), ct + DEFLATED_AT
    everywhere = Mask(np.ones((2, 2, 2), bool), np.diag([2000.0, 2000, 2000, 1]) - np.array([[0, 0, 0, 1000.0]] * 4))
    known = replace(
        truth(),
        dense=np.stack([ct, inflated, deflated], axis=1),
        fields_of_view={"inflated": everywhere, "deflated": everywhere},
    )
    classes = evaluate(known, result).summary["dense"]["by_depth"]
    assert [(told["from_mm"], told["to_mm"]) for told in classes] == [(0, 5), (5, 10), (10, 20), (20, 30), (30, None)]
    bounds = [(-np.inf, 5), (5, 10), (10, 20), (20, 30), (30, np.inf)]
    counts = [int(((depth >= a) & (depth < b)).sum()) for a, b in bounds]
    assert [told["n"] for told in classes] == counts
    assert counts[0] >= 1
    assert sum(counts) == 4
    errors = np.linalg.norm(result.maps.inf_from_ct(ct) - inflated, axis=1)
    for told, (a, b) in zip(classes, bounds, strict=True):
        at = (depth >= a) & (depth < b)
        if not at.any():
            assert (told["phase1"], told["chain"], told["share_in_radius95"]) == (None, None, None)
            continue
        assert told["phase1"]["mean"] == pytest.approx(errors[at].mean())
        assert told["phase1"]["max"] == pytest.approx(errors[at].max())
        assert told["phase1"] != told["chain"]


def test_csv_has_each_value_in_its_own_column(scores: Evaluation) -> None:
    rows = list(csv.DictReader(as_csv(scores).splitlines()))
    mm, marks = wanted(), triples()
    errors = {
        f"{phase}_{when}_mm": mm[name]
        for phase, names in {
            "phase1": ("rigid_ct_inflated", "phase1"),
            "phase2": ("rigid_inflated_deflated", "phase2"),
            "chain": ("rigid_ct_deflated", "chain"),
        }.items()
        for when, name in zip(("before", "after"), names, strict=True)
    }
    points = {
        "ct": marks.ct,
        "inflated": marks.inflated,
        "deflated": marks.deflated,
        "predicted_inflated": CT + INFLATED_AT + [0, 3.0, 0],
        "predicted_deflated": CT + DEFLATED_AT + [0, 8.0, 0],
        "predicted_deflated_from_inflated": marks.inflated + INFLATED_AT + [0, 5.0, 0],
    }
    columns = errors | {f"{name}_{axis}_ras": p[:, n] for name, p in points.items() for n, axis in enumerate("xyz")}
    columns |= {"depth_mm": scores.depth_mm, "radius95_mm": scores.radius95_mm}
    for name, values in columns.items():
        assert_allclose([float(row[name] or "nan") for row in rows], values, atol=6e-5, err_msg=name)
    assert [row["label"] for row in rows] == list(LABELS)
    assert [row["inside_fov"] for row in rows] == ["true"] * 6 + ["false"] * 6
    assert [row["inside_mesh"] for row in rows] == ["true"] * 8 + ["false"] * 4
    assert len(columns) + 3 == len(rows[0])


def test_table_prints_each_measure_on_its_own_line(scores: Evaluation) -> None:
    lines = table(scores.summary).splitlines()
    for line, (name, mm) in zip(lines[1:7], wanted().items(), strict=True):
        e = mm[np.isfinite(mm)]
        numbers = (e.mean(), e.std(ddof=1), np.median(e), np.percentile(e, 95), e.max())
        assert line.split()[:7] == [name, *(f"{v:.2f}" for v in numbers), str(len(e))]
        assert len(line.split()) == (8 if name in ("phase1", "phase2", "chain") else 7)
    assert "nodule: 5.00 mm off in the inflated CBCT, 6.00 mm in the deflated one" in lines[-5]
    assert json.dumps(scores.summary, allow_nan=False)
