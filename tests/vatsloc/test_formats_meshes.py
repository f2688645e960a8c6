"""Tetrahedra as .vtu and surfaces as STL, in LPS millimetres."""

from __future__ import annotations

import json

import meshio
import numpy as np
import pytest
from numpy.testing import assert_allclose

from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.meshes import TetraMesh, read_surface, read_vtu, write_stl, write_vtu

POINTS = np.array([[10.0, 20, 30], [11, 20, 30], [10, 22, 30], [10, 20, 33], [12, 23, 34]])
TETS = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])
TRIANGLES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


def test_vtu_is_lps_with_lps_vectors_and_comes_back(tmp_path):
    displacement, pressure = np.arange(15.0).reshape(5, 3), np.arange(5.0)
    mesh = TetraMesh(
        POINTS, TETS, {"displacement": displacement, "pressure": pressure}, {"det F": np.array([0.5, 0.7])}
    )
    write_vtu(tmp_path / "m.vtu", mesh)
    stored = meshio.read(tmp_path / "m.vtu")
    assert_allclose(stored.points, POINTS * [-1, -1, 1])
    assert_allclose(stored.point_data["displacement"], displacement * [-1, -1, 1])
    back = read_vtu(tmp_path / "m.vtu")
    assert_allclose(back.points_ras, POINTS)
    assert np.array_equal(back.tets, TETS)
    assert_allclose(back.point_data["displacement"], displacement)
    assert_allclose(back.point_data["pressure"], pressure)
    assert_allclose(back.cell_data["det F"], [0.5, 0.7])


def test_crossing_the_border_keeps_tetrahedra_the_right_way_round(tmp_path):
    write_vtu(tmp_path / "m.vtu", TetraMesh(POINTS, TETS))
    x = meshio.read(tmp_path / "m.vtu").points[TETS[0]]
    assert_allclose(np.linalg.det(x[1:] - x[0]), 6.0)


def test_vtu_of_other_cells_is_refused(tmp_path):
    meshio.write_points_cells(tmp_path / "m.vtu", POINTS, [("triangle", TRIANGLES)])
    with pytest.raises(InputRefused, match="cells of type triangle, tetra needed"):
        read_vtu(tmp_path / "m.vtu")


def test_garbage_vtu_is_refused(tmp_path):
    (tmp_path / "m.vtu").write_text("<VTKFile")
    with pytest.raises(InputRefused, match=r"not a readable \.vtu mesh"):
        read_vtu(tmp_path / "m.vtu")


def test_stl_is_lps_and_says_so(tmp_path):
    write_stl(tmp_path / "s.stl", POINTS, TRIANGLES)
    assert b"SPACE=LPS" in (tmp_path / "s.stl").read_bytes()[:80]
    stored = meshio.stl.read(tmp_path / "s.stl")
    assert_allclose([stored.points.min(axis=0), stored.points.max(axis=0)], [[-11, -22, 30], [-10, -20, 33]])
    assert_allclose(np.linalg.det(stored.points[stored.cells[0].data]).sum() / 6, 1.0, rtol=1e-5)
    back = read_surface(tmp_path / "s.stl")
    assert back.frame_stated
    assert len(back.triangles) == 4
    assert_allclose(np.sort(back.points_ras, axis=0), np.sort(POINTS[:4], axis=0))


def test_normals_of_a_written_stl_point_outwards(tmp_path):
    write_stl(tmp_path / "s.stl", POINTS, TRIANGLES)
    first = np.frombuffer((tmp_path / "s.stl").read_bytes()[84:96], "<f4")
    assert_allclose(first, [0, 0, -1])


@pytest.mark.parametrize(("frame", "signs"), [("RAS", [1, 1, 1]), ("LPS", [-1, -1, 1]), (None, [-1, -1, 1])])
def test_stl_frame_is_taken_from_its_header(tmp_path, frame, signs):
    space = "" if frame is None else f"; SPACE={frame}"
    facets = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x} {y} {z}\n" for x, y, z in POINTS[t])
        + "endloop\nendfacet\n"
        for t in TRIANGLES
    )
    (tmp_path / "s.stl").write_text(f"solid lung{space}\n{facets}endsolid lung\n")
    surface = read_surface(tmp_path / "s.stl")
    assert surface.frame_stated == (frame is not None)
    assert_allclose(np.sort(surface.points_ras * signs, axis=0), np.sort(POINTS[:4], axis=0))


def test_points_are_accepted_as_a_surface(tmp_path):
    points = [{"label": str(n), "position": list(p)} for n, p in enumerate(POINTS * [-1, -1, 1])]
    markups = [{"type": "Fiducial", "coordinateSystem": "LPS", "controlPoints": points}]
    (tmp_path / "s.mrk.json").write_text(json.dumps({"markups": markups}))
    surface = read_surface(tmp_path / "s.mrk.json")
    assert_allclose(surface.points_ras, POINTS)
    assert surface.triangles.shape == (0, 3)


def test_bad_surfaces_are_refused(tmp_path):
    (tmp_path / "s.stl").write_bytes(b"nothing of the kind")
    with pytest.raises(InputRefused, match=r"STL surface|no triangles"):
        read_surface(tmp_path / "s.stl")
    (tmp_path / "s.ply").write_bytes(b"ply")
    with pytest.raises(CaseError, match=r"no surface file; give an \.stl, or points"):
        read_surface(tmp_path / "s.ply")
    with pytest.raises(CaseError, match="does not exist"):
        read_surface(tmp_path / "gone.stl")
