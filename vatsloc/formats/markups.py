"""Point lists as 3D Slicer stores them: .mrk.json and the older .fcsv, read to RAS, written in LPS.

A list that does not name its frame is refused: right and left would be a guess.
Ref: Slicer markups-schema-v1.0.3; Slicer developer guide, Markups (numeric frames 0 = RAS, 1 = LPS in
earlier versions).
"""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from registration.volume import Array
from vatsloc.errors import CaseError, InputRefused
from vatsloc.frames import flip_points

SCHEMA = "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/markups-schema-v1.0.3.json#"
_FRAMES = {"RAS": "RAS", "LPS": "LPS", "0": "RAS", "1": "LPS"}
_POINT_TYPES = ("Fiducial", "Curve", "ClosedCurve", "Line")
_FCSV_COLUMNS = "id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID"


@dataclass(frozen=True)
class PointList:
    """Labelled points. ras: (n, 3) mm; labels and descriptions: n strings."""

    ras: Array
    labels: tuple[str, ...]
    descriptions: tuple[str, ...] = field(default=())

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


def read_points(path: Path) -> PointList:
    """Defined points of a .mrk.json, .json or .fcsv file, in the file's order.

    Raises CaseError when the file is not there, InputRefused when it is unreadable, states no frame, is not in mm or
    holds no finite point.
    """
    if not path.is_file():
        raise CaseError(f"{path} does not exist; correct the path or put the points there.")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputRefused(f"{path} cannot be read as text ({error}); save the points again.") from error
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
    entries = [entry for entry in entries if entry.get("positionStatus", "defined") == "defined"]
    try:
        xyz = np.array([[float(c) for c in entry["position"]] for entry in entries]).reshape(len(entries), 3)
    except (KeyError, TypeError, ValueError) as error:
        raise InputRefused(f"{path} has a point without three coordinates; place it again.") from error
    labels = tuple(str(entry.get("label") or entry.get("id") or n) for n, entry in enumerate(entries, start=1))
    descriptions = tuple(str(entry.get("description", "")) for entry in entries)
    return PointList(_to_ras(xyz, markup.get("coordinateSystem"), path), labels, descriptions)


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
    try:
        at = {name: columns.index(name) for name in ("x", "y", "z", "label")}
        table = list(csv.reader(rows))
        xyz = np.array([[float(row[at[axis]]) for axis in "xyz"] for row in table]).reshape(len(table), 3)
        labels = tuple(row[at["label"]] or str(n) for n, row in enumerate(table, start=1))
    except (ValueError, IndexError) as error:
        raise InputRefused(f"{path} is not a Slicer .fcsv file ({error}); save the points as .mrk.json.") from error
    desc = columns.index("desc") if "desc" in columns else -1
    descriptions = tuple(row[desc] if 0 <= desc < len(row) else "" for row in table)
    return PointList(_to_ras(xyz, comments.get("coordinatesystem"), path), labels, descriptions)


def _to_ras(xyz: Array, stated: Any, path: Path) -> Array:
    if stated is None or str(stated).strip() == "":
        raise InputRefused(f'{path} states no coordinateSystem, so left and right are a guess; add "LPS" or "RAS".')
    frame = _FRAMES.get(str(stated).strip().upper())
    if frame is None:
        raise InputRefused(f'{path} states coordinateSystem "{stated}"; save the points in "LPS" or "RAS".')
    return flip_points(xyz) if frame == "LPS" else xyz
