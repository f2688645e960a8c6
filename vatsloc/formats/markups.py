"""Point lists as 3D Slicer stores them: .mrk.json and the older .fcsv, read to RAS, written in LPS.

A list that does not name its frame is refused: right and left would be a guess.
Ref: Slicer markups-schema-v1.0.3; Slicer developer guide, Markups (numeric frames 0 = RAS, 1 = LPS in
earlier versions).
"""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from registration.volume import Array
from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.guard import guarded
from vatsloc.frames import flip_points

SCHEMA = "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/markups-schema-v1.0.3.json#"
_FRAMES = {"RAS": "RAS", "LPS": "LPS", "0": "RAS", "1": "LPS"}
_POINT_TYPES = ("Fiducial", "Curve", "ClosedCurve", "Line")
_PLACED, _NOT_PLACED = "defined", ("undefined", "preview", "missing")
_FCSV_COLUMNS = "id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID"
_FCSV_NOT_PLACED, _FCSV_PLACED = ("0", "1", "3"), "2"
"""What Slicer 5 writes in the column after the last one that it names."""
_TURN_ROUNDING = 1e-3


@dataclass(frozen=True)
class PointList:
    """Labelled points. ras: (n, 3) mm; labels and descriptions: n strings; unplaced: labels of points that the file
    names but holds no place for."""

    ras: Array
    labels: tuple[str, ...]
    descriptions: tuple[str, ...] = field(default=())
    unplaced: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        if np.ndim(self.ras) != 2 or np.shape(self.ras)[1] != 3:
            raise ValueError(f"ras must be (n, 3), got {np.shape(self.ras)}")
        if not self.descriptions:
            object.__setattr__(self, "descriptions", ("",) * len(self.ras))
        if not len(self.ras) == len(self.labels) == len(self.descriptions):
            raise ValueError(
                f"{len(self.ras)} points have {len(self.labels)} labels and {len(self.descriptions)} descriptions"
            )

    def __len__(self) -> int:
        return len(self.labels)


@guarded("Slicer point list", "save the points as .mrk.json")
def read_points(path: Path) -> PointList:
    """Points of a .mrk.json, .json or .fcsv file, in the file's order; those that were never placed are left out.

    Raises CaseError when the file is not there, InputRefused when it is unreadable, states no frame, is not in mm or
    holds no finite point.
    """
    if not path.is_file():
        raise CaseError(f"{path} does not exist; correct the path or put the points there.")
    text = path.read_text(encoding="utf-8-sig")
    points = _from_fcsv(text, path) if path.suffix.lower() == ".fcsv" else _from_json(text, path)
    if len(points) == 0:
        raise InputRefused(f"{path} holds no defined points; place them and save again.")
    if not np.isfinite(points.ras).all():
        raise InputRefused(f"{path} holds points that are not finite numbers; place them again.")
    return points


def write_points(path: Path, points: PointList) -> None:
    """Write .mrk.json in LPS mm, every point "defined"."""
    control_points = [
        {
            "id": str(n),
            "label": label,
            "description": text,
            "position": list(map(float, xyz)),
            "positionStatus": "defined",
        }
        for n, (label, text, xyz) in enumerate(
            zip(points.labels, points.descriptions, flip_points(points.ras), strict=True), start=1
        )
    ]
    markup = {
        "type": "Fiducial",
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "controlPoints": control_points,
    }
    path.write_text(json.dumps({"@schema": SCHEMA, "markups": [markup]}, indent=1) + "\n", encoding="utf-8")


def _from_json(text: str, path: Path) -> PointList:
    try:
        markups = json.loads(text)["markups"]
        n_lists = len(markups)
        markup: dict[str, Any] = markups[0] if n_lists else {}
        entries = list(markup.get("controlPoints", []))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputRefused(f"{path} is not a Slicer markups file ({error}); save the points as .mrk.json.") from error
    if n_lists != 1:
        raise InputRefused(f"{path} holds {n_lists} markups, one needed; save one point list per file.")
    if markup.get("type", "Fiducial") not in _POINT_TYPES:
        raise InputRefused(f"{path} holds a {markup['type']}, not points; save a point list.")
    units = markup.get("coordinateUnits", "mm")
    if (units[0] if isinstance(units, list) and units else units) != "mm":
        raise InputRefused(f"{path} is in {units}, not mm; save the points in millimetres.")
    for entry in entries:
        if entry.get("positionStatus", _PLACED) not in (_PLACED, *_NOT_PLACED):
            raise InputRefused(f"{path} has a point of positionStatus {entry['positionStatus']!r}; save it again.")
    named = [(str(entry.get("label") or entry.get("id") or n), entry) for n, entry in enumerate(entries, start=1)]
    placed = [(label, entry) for label, entry in named if entry.get("positionStatus", _PLACED) == _PLACED]
    xyz = np.array([_position(entry, label, path) for label, entry in placed]).reshape(len(placed), 3)
    return PointList(
        _to_ras(xyz, markup.get("coordinateSystem"), path),
        tuple(label for label, _ in placed),
        tuple(str(entry.get("description", "")) for _, entry in placed),
        tuple(label for label, entry in named if entry.get("positionStatus", _PLACED) != _PLACED),
    )


def _position(entry: Mapping[str, Any], label: str, path: Path) -> list[float]:
    xyz = entry.get("position")
    numbers = isinstance(xyz, list) and all(isinstance(c, int | float) and not isinstance(c, bool) for c in xyz)
    if not isinstance(xyz, list) or not numbers or len(xyz) != 3:
        raise InputRefused(
            f"{path} has a point without three coordinates: {label} has position {xyz!r}, three numbers needed "
            "(with decimal points, without quotes); place it again."
        )
    return [float(c) for c in xyz]


def _from_fcsv(text: str, path: Path) -> PointList:
    comments: dict[str, str] = {}
    rows: list[str] = []
    for line in text.splitlines():
        if line.startswith("#"):
            key, _, value = line[1:].partition("=")
            comments[key.strip().lower()] = value.strip()
        elif line.strip():
            rows.append(line)
    columns = [name.strip() for name in comments.get("columns", _FCSV_COLUMNS).split(",")]
    if not {"x", "y", "z", "label"} <= set(columns) or len(set(columns)) != len(columns):
        raise InputRefused(
            f"{path} is not a Slicer .fcsv file (columns {', '.join(columns)}); save the points as .mrk.json."
        )
    table = [_fcsv_row(row, columns, path) for row in csv.reader(rows)]
    named = [(row["label"] or str(n), row) for n, row in enumerate(table, start=1)]
    placed = [(label, row) for label, row in named if row["status"] not in _FCSV_NOT_PLACED]
    xyz = np.array([[float(row[axis]) for axis in "xyz"] for _, row in placed]).reshape(len(placed), 3)
    return PointList(
        _to_ras(xyz, comments.get("coordinatesystem"), path),
        tuple(label for label, _ in placed),
        tuple(row.get("desc", "") for _, row in placed),
        tuple(label for label, row in named if row["status"] in _FCSV_NOT_PLACED),
    )


def _fcsv_row(values: list[str], columns: list[str], path: Path) -> dict[str, str]:
    """A row by column, "status" being what Slicer 5 adds after the last one.

    A decimal comma moves everything to its right by a column, so the columns with known contents are looked at too.
    """
    more = values[len(columns) :]
    row = dict(zip(columns, values, strict=False)) | {"status": more[0] if more else _FCSV_PLACED}
    try:
        numbers = [float(row[axis]) for axis in "xyz"]
        turn = [float(row[name]) for name in ("ow", "ox", "oy", "oz") if name in columns]
        known = all(row[name] in ("0", "1") for name in ("vis", "sel", "lock") if name in columns)
    except (KeyError, ValueError):
        numbers, turn, known = [], [], False
    unit = not turn or abs(float(np.linalg.norm(turn)) - 1) < _TURN_ROUNDING
    extra = not more or (columns[-1] == "associatedNodeID" and len(more) <= 2)
    if not (numbers and known and unit and extra and row["status"] in (_FCSV_PLACED, *_FCSV_NOT_PLACED)):
        raise InputRefused(
            f"{path} is not a Slicer .fcsv file (row {','.join(values)!r} does not fit the columns "
            f"{','.join(columns)}; decimal commas?); save the points as .mrk.json."
        )
    return row


def _to_ras(xyz: Array, stated: Any, path: Path) -> Array:
    if stated is None or str(stated).strip() == "":
        raise InputRefused(f'{path} states no coordinateSystem, so left and right are a guess; add "LPS" or "RAS".')
    frame = _FRAMES.get(str(stated).strip().upper())
    if frame is None:
        raise InputRefused(f'{path} states coordinateSystem "{stated}"; save the points in "LPS" or "RAS".')
    return flip_points(xyz) if frame == "LPS" else xyz
