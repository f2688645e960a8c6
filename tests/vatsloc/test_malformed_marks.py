"""Each field of point lists, surfaces, meshes, transforms, tables and case.toml, mutated: read right or refused."""

from __future__ import annotations

import base64
import copy
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.vatsloc.malformed import bounded, junk, read_or_refused
from vatsloc.errors import CaseError, InputRefused
from vatsloc.evaluation.inputs import _dense
from vatsloc.formats.casefile import read_case_file
from vatsloc.formats.markups import PointList, read_points, write_points
from vatsloc.formats.meshes import Surface, TetraMesh, read_surface, read_vtu, write_stl, write_vtu
from vatsloc.formats.transforms import read_tfm, write_tfm
from vatsloc.study.bench.breaths import _landmarks

POINTS = np.array([[10.0, 20, 30], [11.5, 20, 30], [10, 22.25, 30], [10, 20, 33]])
TRIANGLES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
MARKUP = {
    "@schema": "markups-schema-v1.0.3.json#",
    "markups": [
        {
            "type": "Fiducial",
            "coordinateSystem": "LPS",
            "coordinateUnits": "mm",
            "locked": False,
            "controlPoints": [
                {"id": "1", "label": "a", "position": [-10.5, -20.25, 30.5], "positionStatus": "defined"},
                {"id": "2", "label": "b", "position": [-11.5, -21.25, 31.5], "positionStatus": "defined"},
            ],
        }
    ],
}
RAS = np.array([[10.5, 20.25, 30.5], [11.5, 21.25, 31.5]])
JSON_JUNK = (None, "", "12,5", "NaN", [], {}, True, -1, [1, 2], {"a": 1}, float("nan"), float("inf"), "LPS ", 10**400)


def paths_of(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Where each value of nested dicts and lists lies."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path] * bool(path) + [p for key, item in inner for p in paths_of(item, (*path, key))]


COORDINATES = [p for p in paths_of(MARKUP) if "position" in p and isinstance(p[-1], int)]


@bounded(150)
@given(where=st.sampled_from(paths_of(MARKUP)), value=st.sampled_from(JSON_JUNK), gone=st.booleans())
def test_fields_of_markups(tmp_path: Path, where: tuple[Any, ...], value: Any, gone: bool) -> None:
    content = copy.deepcopy(MARKUP)
    holder: Any = content
    for key in where[:-1]:
        holder = holder[key]
    if gone:
        del holder[where[-1]]
    else:
        holder[where[-1]] = value
    if not gone and value == -1 and where in COORDINATES:
        return  # a right value, of another point
    if where[-2:] == ("controlPoints", 0) or where[-2:] == ("controlPoints", 1):
        right = np.delete(RAS, where[-1], axis=0) if gone else RAS
    else:
        right = RAS
    (tmp_path / "p.mrk.json").write_text(json.dumps(content))
    read_or_refused(lambda: read_points(tmp_path / "p.mrk.json"), lambda points: np.array_equal(points.ras, right))


FCSV = [
    "# Markups fiducial file version = 4.13",
    "# CoordinateSystem = LPS",
    "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID",
    "1,-10.5,-20.25,30.5,0,0,0,1,1,1,0,a,,vtkMRMLScalarVolumeNode1,2,0",
    "2,-11.5,-21.25,31.5,0,0,0,1,1,1,0,b,,vtkMRMLScalarVolumeNode1,2,0",
]
WRONG_NUMBERS = ("", "12,5", "1,0", "abc", "nan", "inf", "1.5.2", "1 2", "null", "12;5", "1e400")


@bounded(150)
@given(row=st.integers(3, 4), column=st.integers(0, 15), value=st.one_of(st.sampled_from(WRONG_NUMBERS), junk))
def test_cells_of_an_fcsv(tmp_path: Path, row: int, column: int, value: str) -> None:
    """Also with decimal commas, which move all cells to their right by one."""
    lines, cells = list(FCSV), FCSV[row].split(",")
    if column in (1, 2, 3) and _number(value):
        return  # a right value, of another point
    cells[column] = value
    lines[row] = ",".join(cells)
    (tmp_path / "p.fcsv").write_text("\n".join(lines), encoding="utf-8")
    kept = np.delete(RAS, row - 3, axis=0)
    unplaced = column == 14 and value in ("0", "1", "3")
    read_or_refused(
        lambda: read_points(tmp_path / "p.fcsv"), lambda points: np.array_equal(points.ras, kept if unplaced else RAS)
    )


@pytest.mark.parametrize("commas", ["x", "xy", "xyz", "z"])
@pytest.mark.parametrize("extra", ["", "n1", "n1,2,0"])
@pytest.mark.parametrize("place", [(12.5, 3.25, 4.5), (12.5, 10.1, 0.0), (1.5, 0.5, 1.0), (0.5, 1.0, 0.0)])
def test_decimal_commas_in_an_fcsv_are_refused(
    tmp_path: Path, commas: str, extra: str, place: tuple[float, ...]
) -> None:
    cells = [f"{v}".replace(".", "," if axis in commas else ".") for v, axis in zip(place, "xyz", strict=True)]
    row = ",".join(["1", *cells, "0,0,0,1,1,1,0", "a", "", extra])
    (tmp_path / "p.fcsv").write_text("\n".join([*FCSV[:3], row]))
    with pytest.raises(InputRefused, match=r"does not fit the columns .*decimal commas"):
        read_points(tmp_path / "p.fcsv")


@bounded(150)
@given(line=st.integers(0, 4), value=junk)
def test_lines_of_an_fcsv(tmp_path: Path, line: int, value: str) -> None:
    lines = list(FCSV)
    lines[line] = value if line > 2 else f"{lines[line].partition(' = ')[0]} = {value}"
    right = RAS if line < 3 or value.strip() else np.delete(RAS, line - 3, axis=0)
    (tmp_path / "p.fcsv").write_text("\n".join(lines), encoding="utf-8")
    if line > 2 and value.startswith("#"):
        right = np.delete(RAS, line - 3, axis=0)
    read_or_refused(
        lambda: read_points(tmp_path / "p.fcsv"),
        lambda points: np.array_equal(points.ras, right) or (line == 1 and value.strip().upper() in ("RAS", "0")),
    )


def _number(value: str) -> bool:
    try:
        return bool(np.isfinite(float(value)))
    except ValueError:
        return False


def sorted_corners(surface: Surface) -> np.ndarray:
    corners = surface.points_ras[surface.triangles].reshape(-1, 3)
    return corners[np.lexsort(corners.T)]


CORNERS = POINTS[TRIANGLES].reshape(-1, 3)
CORNERS = CORNERS[np.lexsort(CORNERS.T)]
STL = ["solid lung SPACE=LPS"]
for triangle in TRIANGLES:
    STL += ["facet normal 0 0 1", "outer loop", *(f"vertex {-x} {-y} {z}" for x, y, z in POINTS[triangle])]
    STL += ["endloop", "endfacet"]
STL += ["endsolid"]


@bounded(150)
@given(line=st.integers(1, len(STL) - 1), value=junk, whole=st.booleans())
def test_lines_of_a_text_stl(tmp_path: Path, line: int, value: str, whole: bool) -> None:
    lines = list(STL)
    lines[line] = value if whole else f"{STL[line].split()[0]} {value}"
    (tmp_path / "s.stl").write_text("\n".join(lines), encoding="utf-8")
    numbers = value.split()
    if lines[line].startswith("vertex") and len(numbers) == 3 and all(map(_number, numbers)):
        return  # a right value, of another corner
    read_or_refused(
        lambda: read_surface(tmp_path / "s.stl"),
        lambda surface: (
            sorted_corners(surface).shape == CORNERS.shape and np.allclose(sorted_corners(surface), CORNERS)
        ),
    )


@bounded(150)
@given(
    count=st.sampled_from((0, 1, 3, 4, 5, 2**31, 2**32 - 1)),
    number=st.sampled_from((np.nan, np.inf, -np.inf, -2.0, 1e38)),
    at=st.integers(0, 47),
    cut=st.integers(0, 300),
)
def test_parts_of_a_binary_stl(tmp_path: Path, count: int, number: float, at: int, cut: int) -> None:
    path = tmp_path / "s.stl"
    write_stl(path, POINTS, TRIANGLES)
    data = bytearray(path.read_bytes())
    data[80:84] = struct.pack("<I", count)
    struct.pack_into("<f", data, 84 + 50 * (at // 12) + 4 * (at % 12), number)
    path.write_bytes(bytes(data[: len(data) - cut] if cut < 200 else data))
    read_or_refused(
        lambda: read_surface(path),
        lambda surface: len(surface.triangles) == 4 and np.isfinite(surface.points_ras).all(),
    )


TETS = np.array([[0, 1, 2, 3]])


@bounded(120)
@given(data=st.data())
def test_attributes_and_parts_of_a_vtu(tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "m.vtu"
    write_vtu(path, TetraMesh(POINTS, TETS, {"pressure": np.arange(4.0)}))
    text = path.read_text()
    pieces = text.split('"')
    at = data.draw(st.sampled_from(range(1, len(pieces), 2)))
    value = data.draw(junk.filter(lambda s: '"' not in s))
    name = pieces[at - 1].rsplit(maxsplit=1)[-1]
    pieces[at] = value
    path.write_text('"'.join(pieces), encoding="utf-8")
    read_or_refused(
        lambda: read_vtu(path),
        lambda mesh: (
            name in ("Name=", "version=") or (np.allclose(mesh.points_ras, POINTS) and np.array_equal(mesh.tets, TETS))
        ),
    )


@bounded(100)
@given(
    index=st.sampled_from((-1, 4, 99, 2**40)),
    coordinate=st.sampled_from((np.nan, np.inf, -np.inf)),
    which=st.booleans(),
)
def test_contents_of_a_vtu(tmp_path: Path, index: int, coordinate: float, which: bool) -> None:
    points, tets = POINTS.copy(), TETS.copy()
    if which:
        tets[0, 0] = index
    else:
        points[0, 0] = coordinate
    write_vtu(tmp_path / "m.vtu", TetraMesh(points, tets))
    assert read_or_refused(lambda: read_vtu(tmp_path / "m.vtu"), lambda _mesh: False)


MATRIX = np.eye(4)
MATRIX[:3, 3] = [10.0, 20.0, 30.0]


@bounded(120)
@given(
    line=st.integers(0, 4), word=st.integers(1, 12), value=junk, how=st.sampled_from(("line", "word", "gone", "more"))
)
def test_lines_of_an_itk_transform(tmp_path: Path, line: int, word: int, value: str, how: str) -> None:
    write_tfm(tmp_path / "t.tfm", MATRIX)
    lines = (tmp_path / "t.tfm").read_text().splitlines()
    key, _, rest = lines[line].partition(": ")
    words = rest.split()
    if how == "word" and words:
        words[min(word, len(words)) - 1] = value
        if _number(value):
            return  # a right value, of another transform
    changed = {"line": f"{key}: {value}", "word": f"{key}: {' '.join(words)}", "more": f"{lines[line]} {value}"}
    lines[line : line + 1] = [changed[how]] if how in changed else []
    if len(lines) > line and lines[line].startswith("FixedParameters") and all(map(_number, lines[line].split()[1:])):
        return
    (tmp_path / "t.tfm").write_text("\n".join(lines), encoding="utf-8")
    read_or_refused(lambda: read_tfm(tmp_path / "t.tfm"), lambda matrix: np.allclose(matrix, MATRIX))


@bounded(150)
@given(row=st.integers(0, 1), column=st.integers(0, 8), value=st.one_of(st.sampled_from(WRONG_NUMBERS), junk))
def test_cells_of_a_table_of_landmarks(tmp_path: Path, row: int, column: int, value: str) -> None:
    table = np.arange(18.0).reshape(2, 9) + 0.5
    cells = [[repr(float(v)) for v in values] for values in table]
    if _number(value):
        return
    cells[row][column] = value
    (tmp_path / "d.csv").write_text("h\n" + "\n".join(map(",".join, cells)) + "\n", encoding="utf-8")
    assert read_or_refused(lambda: _dense(tmp_path / "d.csv"), lambda _table: False)


TOML = {
    "side": '"right"', "images.ct": '"ct.nii.gz"', "images.cbct_inflated": '"i.nii.gz"',
    "images.cbct_deflated": '"d.nii.gz"', "nodule.mask": '"n.nii.gz"', "nodule.label": "2",
    "setup.gravity_cbct": "[-1.0, 0.0, 0.0]", "setup.pleural_gas": '"air"', "hints.lung_mask_ct": '"l.nii.gz"',
    "hints.lung_label": '["right lung", 3]', "hints.spine_ct": "[0.0, 0.0, 0.0]",
    "hints.spine_cbct_inflated": "[0.0, 0.0, 0.0]", "landmarks.ct": '"l.mrk.json"',
}  # fmt: skip
TOML_JUNK = (
    "", "null", '""', '" "', "true", "[]", "{}", "-1", "0", "nan", "[nan, 0, 0]", "[inf, 0.0, 0.0]",
    '["1,0", "0", "0"]', "[true, 0, 0]", "[0, 0]", "[0.0, 0.0, 0.0, 0.0]", "1979-05-27", '{ct = "a"}', '"\\u0000"',
    '"a\\nb"', "[[1]]", "1,5", '["a", ""]', "[0]", "2.5", f'"{"x" * 300}"',
)  # fmt: skip


NAMES = ('"a\\nb"', f'"{"x" * 300}"', '["1,0", "0", "0"]')


@bounded(150)
@given(key=st.sampled_from(list(TOML)), value=st.sampled_from(TOML_JUNK))
def test_values_of_case_toml(tmp_path: Path, key: str, value: str) -> None:
    (tmp_path / "case.toml").write_text("\n".join(f"{k} = {v}" for k, v in (TOML | {key: value}).items()))
    # Any text may be a segment's name.
    named = key.endswith("label") and value in NAMES
    assert read_or_refused(lambda: read_case_file(tmp_path), lambda _file: named) or named


def test_case_toml_is_read_as_the_mutations_begin(tmp_path: Path) -> None:
    (tmp_path / "case.toml").write_text("\n".join(f"{k} = {v}" for k, v in TOML.items()))
    file = read_case_file(tmp_path)
    assert file.nodule.label == (2,)
    assert file.hints.lung_label == ("right lung", 3)
    assert file.setup.gravity_cbct == (-1.0, 0.0, 0.0)


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b'side = "right"\x00', b"[" * 5000, b"\xef\xbb\xbf\xef\xbb\xbf"])
def test_case_toml_that_is_none_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "case.toml").write_bytes(content)
    with pytest.raises(CaseError, match=r"case\.toml"):
        read_case_file(tmp_path)


@bounded(30)
@given(text=st.one_of(junk, st.binary(max_size=200).map(lambda b: base64.b64encode(b).decode())))
@pytest.mark.parametrize("name", ["p.mrk.json", "p.fcsv", "s.stl", "m.vtu", "t.tfm"])
def test_garbage_is_refused(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    read = {"p": read_points, "s": read_surface, "m": read_vtu, "t": read_tfm}[name[0]]
    assert read_or_refused(lambda: read(tmp_path / name), lambda _got: False)


def test_points_written_here_are_read_as_the_mutations_begin(tmp_path: Path) -> None:
    (tmp_path / "p.fcsv").write_text("\n".join(FCSV))
    (tmp_path / "p.mrk.json").write_text(json.dumps(MARKUP))
    (tmp_path / "s.stl").write_text("\n".join(STL))
    write_points(tmp_path / "w.mrk.json", PointList(RAS, ("a", "b")))
    for name in ("p.fcsv", "p.mrk.json", "w.mrk.json"):
        assert np.array_equal(read_points(tmp_path / name).ras, RAS)
    assert np.allclose(sorted_corners(read_surface(tmp_path / "s.stl")), CORNERS)


@pytest.mark.parametrize("cell", [b"1,5", b"\xff\xfe", b"", b"nan", b"six"])
def test_cells_of_a_breath_s_landmarks_are_refused(tmp_path: Path, cell: bytes) -> None:
    columns = b"insp_x,insp_y,insp_z,exp_x,exp_y,exp_z\n"
    (tmp_path / "l.csv").write_bytes(columns + b"1,2,3,4,5,6\n1,2,3,4,5," + cell + b"\n")
    with pytest.raises(InputRefused, match=r"l\.csv"):
        _landmarks(tmp_path / "l.csv")
    (tmp_path / "l.csv").write_bytes(columns + b"1,2,3,4,5,6\n")
    assert _landmarks(tmp_path / "l.csv").tolist() == [[1, 2, 3, 4, 5, 6]]
