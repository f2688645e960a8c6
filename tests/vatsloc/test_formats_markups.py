"""Slicer point lists: frames, old and new schemas, and what is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.markups import PointList, read_points, write_points

RAS = np.array([[99.875, 86.875, -137.2], [-3.0, 4.5, 6.0]])
LPS = RAS * [-1, -1, 1]


def markup(frame, positions, **more):
    points = [{"id": str(n), "label": f"L{n}", "position": list(p)} for n, p in enumerate(positions, start=1)]
    stated = {} if frame is None else {"coordinateSystem": frame}
    return {"markups": [{"type": "Fiducial", **stated, "controlPoints": points, **more}]}


def save(path, content):
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(
    ("frame", "positions"), [("LPS", LPS), ("RAS", RAS), ("1", LPS), ("0", RAS), (1, LPS), (0, RAS)]
)
def test_json_frames_old_and_new(tmp_path, frame, positions):
    points = read_points(save(tmp_path / "p.mrk.json", markup(frame, positions)))
    assert_allclose(points.ras, RAS)
    assert points.labels == ("L1", "L2")


@pytest.mark.parametrize("units", ["mm", ["mm", "UCUM", "millimeter"]])
def test_json_units_of_both_schemas(tmp_path, units):
    assert_allclose(read_points(save(tmp_path / "p.mrk.json", markup("LPS", LPS, coordinateUnits=units))).ras, RAS)


def test_points_not_placed_yet_are_left_out(tmp_path):
    content = markup("LPS", LPS)
    content["markups"][0]["controlPoints"] += [
        {"label": "later", "position": [0, 0, 0], "positionStatus": "undefined"},
        {"label": "seen", "position": [1, 2, 3], "positionStatus": "defined", "description": "at a fork"},
    ]
    points = read_points(save(tmp_path / "p.mrk.json", content))
    assert points.labels == ("L1", "L2", "seen")
    assert points.descriptions == ("", "", "at a fork")
    assert_allclose(points.ras[2], [-1, -2, 3])


FCSV_NEW = """# Markups fiducial file version = 4.13
# CoordinateSystem = {frame}
# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID
0,{0[0]},{0[1]},{0[2]},0,0,0,1,1,1,0,L1,,
1,{1[0]},{1[1]},{1[2]},0,0,0,1,1,1,0,"L2, upper","at a fork",vtkMRMLScalarVolumeNode1,2,0
"""


@pytest.mark.parametrize(("frame", "positions"), [("LPS", LPS), ("RAS", RAS), ("0", RAS), ("1", LPS)])
def test_fcsv_frames_old_and_new(tmp_path, frame, positions):
    (tmp_path / "p.fcsv").write_text(FCSV_NEW.format(*positions, frame=frame))
    points = read_points(tmp_path / "p.fcsv")
    assert_allclose(points.ras, RAS)
    assert points.labels == ("L1", "L2, upper")
    assert points.descriptions == ("", "at a fork")


def test_fcsv_columns_may_come_in_another_order(tmp_path):
    (tmp_path / "p.fcsv").write_text("# CoordinateSystem = RAS\n# columns = label,x,y,z,sel,vis\nA,1,2,3,1,1\n")
    points = read_points(tmp_path / "p.fcsv")
    assert points.labels == ("A",)
    assert_allclose(points.ras, [[1, 2, 3]])


def test_written_points_are_lps_defined_and_come_back(tmp_path):
    points = PointList(RAS, ("nodule", "ünder the hilum"), ("predicted", ""))
    write_points(tmp_path / "p.mrk.json", points)
    content = json.loads((tmp_path / "p.mrk.json").read_text())["markups"][0]
    assert (content["type"], content["coordinateSystem"], content["coordinateUnits"]) == ("Fiducial", "LPS", "mm")
    assert [p["positionStatus"] for p in content["controlPoints"]] == ["defined", "defined"]
    assert_allclose([p["position"] for p in content["controlPoints"]], LPS)
    back = read_points(tmp_path / "p.mrk.json")
    assert_allclose(back.ras, RAS)
    assert (back.labels, back.descriptions) == (points.labels, points.descriptions)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (markup(None, LPS), 'states no coordinateSystem, so left and right are a guess; add "LPS" or "RAS"'),
        (markup("", LPS), "states no coordinateSystem"),
        (markup("IJK", LPS), 'coordinateSystem "IJK"; save the points in "LPS" or "RAS"'),
        (markup("LPS", LPS, coordinateUnits="cm"), "in cm, not mm"),
        (markup("LPS", LPS, type="ROI"), "holds a ROI, not points"),
        (markup("LPS", []), "no defined points; place them"),
        (markup("LPS", [[1, 2]]), "a point without three coordinates"),
        (markup("LPS", [[1, 2, None]]), "a point without three coordinates"),
        (markup("LPS", [[1, 2, float("nan")]]), "points that are not finite"),
        ({"markups": markup("LPS", LPS)["markups"] * 2}, "holds 2 markups, one needed"),
        ({"markups": []}, "holds 0 markups, one needed"),
        ({"points": []}, "not a Slicer markups file"),
        ([1, 2], "not a Slicer markups file"),
    ],
)
def test_json_refusals(tmp_path, content, sentence):
    with pytest.raises(InputRefused, match=sentence):
        read_points(save(tmp_path / "p.mrk.json", content))


def test_text_that_is_no_json_is_refused(tmp_path):
    (tmp_path / "p.mrk.json").write_text("nodule at 1 2 3")
    with pytest.raises(InputRefused, match="not a Slicer markups file"):
        read_points(tmp_path / "p.mrk.json")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("# columns = label,x,y,z\nA,1,2,3\n", "states no coordinateSystem"),
        ("# CoordinateSystem = 2\nA,1,2,3\n", "not a Slicer .fcsv file"),
        (FCSV_NEW.format(*LPS, frame="2"), 'coordinateSystem "2"'),
        ("# CoordinateSystem = LPS\n# columns = label,x,y\nA,1,2\n", "not a Slicer .fcsv file"),
        ("# CoordinateSystem = LPS\n", "no defined points"),
    ],
)
def test_fcsv_refusals(tmp_path, text, sentence):
    (tmp_path / "p.fcsv").write_text(text)
    with pytest.raises(InputRefused, match=sentence):
        read_points(tmp_path / "p.fcsv")


def test_missing_file_is_a_case_error(tmp_path):
    with pytest.raises(CaseError, match=r"p\.mrk\.json does not exist; correct the path"):
        read_points(tmp_path / "p.mrk.json")


@pytest.mark.parametrize(("shape", "labels"), [((2, 2), ("a", "b")), ((2, 3), ("a",))])
def test_point_list_checks_its_shape(shape, labels):
    with pytest.raises(ValueError, match=r"must be|points have"):
        PointList(np.zeros(shape), labels)
