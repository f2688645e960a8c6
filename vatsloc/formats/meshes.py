"""Meshes in LPS mm: tetrahedra as .vtu for ParaView and Slicer, surfaces as binary STL.

Three-component data in a .vtu are vectors and cross the border with the points. STL has no field for a frame; as Slicer
does, the 80-byte header says SPACE=LPS, and LPS is taken where a file says nothing.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import meshio
import numpy as np

from registration.volume import Array
from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.guard import guarded
from vatsloc.formats.markups import read_points
from vatsloc.frames import flip_points

_STL_HEADER = b"vatsloc surface, mm, SPACE=LPS"
_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


@dataclass(frozen=True)
class Surface:
    """Triangles (m, 3), m = 0 for bare points, of points_ras (n, 3) mm; frame_stated: by the file."""

    points_ras: Array
    triangles: Array
    frame_stated: bool = True


@dataclass(frozen=True)
class TetraMesh:
    """Tetrahedra with data. points_ras: (n, 3) mm; tets: (m, 4); point_data: (n, ...); cell_data: (m, ...)."""

    points_ras: Array
    tets: Array
    point_data: Mapping[str, Array] = field(default_factory=dict)
    cell_data: Mapping[str, Array] = field(default_factory=dict)


def write_vtu(path: Path, mesh: TetraMesh) -> None:
    """Write tetrahedra in LPS mm; data of shape (n, 3) are written as LPS vectors."""
    meshio.write_points_cells(
        path,
        flip_points(mesh.points_ras),
        [("tetra", np.asarray(mesh.tets))],
        point_data={name: _flip_vectors(values) for name, values in mesh.point_data.items()},
        cell_data={name: [_flip_vectors(values)] for name, values in mesh.cell_data.items()},
        file_format="vtu",
    )


@guarded(".vtu mesh", "write it again")
def read_vtu(path: Path) -> TetraMesh:
    """Tetrahedra and data of a .vtu in LPS mm. Raises InputRefused when unreadable, not finite or of other cells."""
    _check_exists(path)
    mesh = meshio.vtu.read(path)  # meshio.read prints and exits on a bad file
    if len(mesh.cells) != 1 or mesh.cells[0].type != "tetra":
        kinds = ", ".join(block.type for block in mesh.cells)
        raise InputRefused(f"{path} holds cells of type {kinds}, tetra needed; write linear tetrahedra.")
    points, tets = np.asarray(mesh.points, dtype=float), np.asarray(mesh.cells[0].data)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise InputRefused(f"{path} holds points that are not three finite numbers; write it again.")
    if len(tets) == 0 or tets.min() < 0 or tets.max() >= len(points):
        raise InputRefused(f"{path} holds no tetrahedra, or some of points that it does not hold; write it again.")
    return TetraMesh(
        flip_points(points),
        tets,
        {name: _flip_vectors(values) for name, values in mesh.point_data.items()},
        {name: _flip_vectors(values[0]) for name, values in mesh.cell_data.items()},
    )


def write_stl(path: Path, points_ras: Array, triangles: Array) -> None:
    """Write triangles (m, 3) of points (n, 3) as binary STL in LPS mm, outward normals by the winding."""
    corners = flip_points(points_ras)[np.asarray(triangles)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    records = np.zeros(len(corners), dtype=_STL_TRIANGLE)
    records["corners"] = corners
    records["normal"] = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    header = _STL_HEADER.ljust(80) + np.uint32(len(corners)).tobytes()
    path.write_bytes(header + records.tobytes())


_TEXT_TRIANGLE = (
    ([b"facet", b"normal"], 3),
    ([b"outer", b"loop"], 0),
    *(([b"vertex"], 3),) * 3,
    ([b"endloop"], 0),
    ([b"endfacet"], 0),
)
"""Lines of one triangle in a text STL: their words, and how many numbers follow."""


@guarded("STL surface")
def read_surface(path: Path) -> Surface:
    """Surface of an .stl, or points of a .mrk.json or .fcsv where a surface is expected.

    Raises CaseError when it is not there or of another format, InputRefused when it cannot be trusted.
    """
    _check_exists(path)
    suffix = path.suffix.lower()
    if suffix in (".json", ".fcsv"):
        return Surface(read_points(path).ras, np.empty((0, 3), dtype=int))
    if suffix != ".stl":
        raise CaseError(f"{path} is no surface file; give an .stl, or points in a .mrk.json.")
    _check_text_stl(path)
    with np.errstate(over="ignore"):  # meshio takes bytes of a text file for a count and multiplies it
        mesh = meshio.stl.read(path)  # a corner that triangles share is one point
    points, triangles = np.asarray(mesh.points, dtype=float), np.asarray(mesh.cells[0].data, dtype=int)
    if len(triangles) == 0 or not np.isfinite(points).all():
        raise InputRefused(f"{path} holds no triangles, or corners that are not finite; export it again.")
    stated = re.search(rb"SPACE\s*=\s*(RAS|LPS)", path.read_bytes()[:300])
    if stated is None or stated.group(1) == b"LPS":
        points = flip_points(points)
    return Surface(points, triangles, frame_stated=stated is not None)


def _check_text_stl(path: Path) -> None:
    """Refuse a text STL whose lines are not those of whole triangles, which meshio would skip or cut."""
    text = path.read_bytes()
    if not text.lstrip().startswith(b"solid") or b"facet" not in text:
        return
    lines = [(number, line.split()) for number, line in enumerate(text.splitlines(), 1) if line.split()][1:-1]
    for n, (number, words) in enumerate(lines):
        kind, count = _TEXT_TRIANGLE[n % len(_TEXT_TRIANGLE)]
        if words[: len(kind)] != kind or len(words) != len(kind) + count:
            wanted = " ".join(word.decode() for word in kind) + (f" and {count} numbers" if count else "")
            raise InputRefused(f"{path}, line {number}: {wanted} expected; export the surface again.")


def _flip_vectors(values: Array) -> Array:
    values = np.asarray(values)
    return flip_points(values) if values.ndim == 2 and values.shape[1] == 3 else values


def _check_exists(path: Path) -> None:
    if not path.is_file():
        raise CaseError(f"{path} does not exist; correct the path or put the mesh there.")
