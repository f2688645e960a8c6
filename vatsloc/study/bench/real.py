"""Benchmark on real lungs: one breath-hold's lungs moved into the other's by shape alone, scored at landmarks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from poro.arrays import Array
from poro.breathing.affine import affine_to_points, affine_to_shape
from poro.breathing.elastic import WALL_ALONE, Breathing, Lung, acting_at, breathe_out
from poro.mesh import TetMesh, interpolate, locate
from vatsloc.breathing.lungs import Pair
from vatsloc.errors import InputRefused
from vatsloc.evaluation.statistics import distances, summarize
from vatsloc.frames import Side
from vatsloc.study.bench.breaths import Marks, read_person
from vatsloc.study.bench.real_images import registered
from vatsloc.study.bench.real_images import table as images_table
from vatsloc.study.bench.spoilt_masks import SPOILT

UNMOVED, CENTROID, SHAPE_AFFINE = "unmoved", "centroid of the shape", "affine map fitted to the shape"
ELASTIC = "elastic lung that slides on its wall"
BREATHING = "the same with weight, bronchi and ribs"
BY_DEPTH = "these by the depth of the breath"
"""What `vatsloc breathe` does: in a quiet breath they hardly act."""
TRUE_AFFINE = "affine map fitted to the landmarks"
"""The last row has seen the truth: it is what a map of twelve numbers per lung can reach at best."""

Predict = Callable[[Lung], Array]


def by_centroid(lung: Lung) -> Array:
    """Nodes shifted as the lung's centre is."""
    return lung.inspired.points + _centre(lung.expired) - _centre(lung.inspired)


def by_shape_affine(lung: Lung) -> Array:
    """Nodes moved by the affine map that lays surface on surface."""
    return affine_to_shape(lung.inspired.boundary, lung.expired.boundary)(lung.inspired.points)


ROWS: dict[str, Predict] = {
    UNMOVED: lambda lung: lung.inspired.points,
    CENTROID: by_centroid,
    SHAPE_AFFINE: by_shape_affine,
    ELASTIC: lambda lung: breathe_out(lung, WALL_ALONE),
    BREATHING: lambda lung: breathe_out(lung, Breathing()),
}
"""Predictions of where the inspired lung's nodes (n, 3) lie after expiration; they are given no landmark."""


def predicted(name: str, pair: Pair) -> Array:
    """Nodes (n, 3) mm of a lung after expiration by a row of `ROWS`, or by `BY_DEPTH`."""
    return breathe_out(pair.lung, acting_at(pair.depth)) if name == BY_DEPTH else ROWS[name](pair.lung)


def bench_real(
    folders: Sequence[Path], say: Callable[[str], None] = lambda _: None, spoil: bool = False
) -> dict[str, Any]:
    """Errors at the landmarks of every person, from inspiration to expiration and (`back`) the other way, per lung and
    pooled; a case's own figures are those of the row `BY_DEPTH`. spoil: also with masks spoilt in each of `SPOILT`'s
    ways (`spoilt`).

    Raises as `read_person`.
    """
    return {"cases": [measure(f, say) | ({"spoilt": spoilt_masks(f, say)} if spoil else {}) for f in folders]}


def spoilt_masks(folder: Path, say: Callable[[str], None] = lambda _: None) -> list[dict[str, Any]]:
    """What the row `BY_DEPTH` makes of masks as they come and as people spoil them: its errors on the way out, volume
    of the mended expired lungs over that of the unspoilt ones, and what was mended; or why it was refused."""
    rows: list[dict[str, Any]] = []
    for way in (None, *SPOILT):
        name = way or "as they come"
        say(f"{folder.name}, masks {name} ...")
        try:
            person = read_person(folder, way=way)
        except InputRefused as refusal:
            rows.append({"masks": name, "refused": str(refusal)})
            continue
        parts = [errors(p.lung, predicted(BY_DEPTH, p), person.marks(p.side))[0] for p in person.pairs]
        volume = sum(float(g.expired.volumes.sum()) for g in person.lungs) / 1e3
        rows.append({"masks": name, "expired_ml": volume, "lungs": len(parts), "notes": list(person.notes)})
        rows[-1] |= _statistics(np.concatenate(parts))
    return rows


def measure(folder: Path, say: Callable[[str], None]) -> dict[str, Any]:
    """All rows of one person, both ways, and figures of registration (`images`, by side) where there are images.
    seconds: reading, meshing and the row `BY_DEPTH`."""
    began = perf_counter()
    say(f"{folder.name}: reading and meshing ...")
    person = read_person(folder)
    for note in person.notes:
        say(f"{person.name}: {note}")
    lungs = person.lungs
    nodes: dict[Side, dict[str, Array]] = {lung.side: {} for lung in lungs}
    marks = [person.marks(lung.side) for lung in lungs]
    out: dict[str, Any] = {}
    back: dict[str, Any] = {}
    seconds = perf_counter() - began
    for name in (*ROWS, BY_DEPTH):
        say(f"{person.name}: {name} ...")
        began = perf_counter()
        moved = [predicted(name, pair) for pair in person.pairs]
        if name == BY_DEPTH:
            seconds += perf_counter() - began
        for lung, there in zip(lungs, moved, strict=True):
            nodes[lung.side][name] = there
        ways = [errors(lung, there, known) for lung, there, known in zip(lungs, moved, marks, strict=True)]
        out[name] = _row({lung.side: way[0] for lung, way in zip(lungs, ways, strict=True)})
        back[name] = _row({lung.side: way[1] for lung, way in zip(lungs, ways, strict=True)})
    out[TRUE_AFFINE] = _row({g.side: _affine_errors(m.inspired, m.expired) for g, m in zip(lungs, marks, strict=True)})
    back[TRUE_AFFINE] = _row({g.side: _affine_errors(m.expired, m.inspired) for g, m in zip(lungs, marks, strict=True)})
    return {
        "name": person.name,
        **_way("inspiration to expiration", out),
        "seconds": seconds,
        "back": _way("expiration to inspiration", back),
        "images": {p.side: registered(person.case, p, nodes[p.side], say) for p in person.pairs}
        if person.case.images is not None
        else None,
        "notes": list(person.notes),
    }


def errors(lung: Lung, moved: Array, marks: Marks) -> tuple[Array, Array]:
    """Errors (k,) mm at the landmarks out and back: the way back is the inverse of the way out."""
    motion = moved - lung.inspired.points
    out = marks.inspired + interpolate(locate(lung.inspired, marks.inspired), motion)
    back = marks.expired - interpolate(locate(TetMesh(moved, lung.inspired.tets), marks.expired), motion)
    return distances(out, marks.expired), distances(back, marks.inspired)


def table(result: dict[str, Any]) -> str:
    """The benchmark as text: mean / 95 % / maximum in mm."""
    lines = []
    for case in result["cases"]:
        for way in (case, case["back"]):
            lines.append(f"{case['name']}, {way['direction']}: mean / 95 % / maximum in mm at the landmarks")
            lungs = list(next(iter(way["rows"].values())))
            lines.append(" " * 42 + "".join(f"{lung:>22s}" for lung in lungs))
            for name, row in way["rows"].items():
                cells = (f"{s['mean']:.2f} / {s['p95']:.1f} / {s['max']:.1f}" for s in row.values())
                lines.append(f"  {name:40s}" + "".join(f"{cell:>22s}" for cell in cells))
        for side, found in (case["images"] or {}).items():
            lines += images_table(case["name"], side, found)
        lines += _spoilt_table(case["name"], case.get("spoilt", ()))
    return "\n".join(lines)


def _spoilt_table(name: str, rows: Sequence[dict[str, Any]]) -> list[str]:
    """Lines of text about spoilt masks; none where they were not asked for."""
    if not rows:
        return []
    lines = [f"{name}, masks spoilt: lungs, ml of them expired, mean / 95 % / maximum in mm at the landmarks"]
    for row in rows:
        if "refused" in row:
            lines.append(f"  {row['masks']:22s} refused: {row['refused']}")
            continue
        cell = f"{row['mean']:.2f} / {row['p95']:.1f} / {row['max']:.1f}"
        lines.append(
            f"  {row['masks']:22s}{row['lungs']:3d}{row['expired_ml']:8.0f}{cell:>22s}  {' '.join(row['notes'])}"
        )
    return lines


def _way(direction: str, rows: dict[str, Any]) -> dict[str, Any]:
    best = rows[BY_DEPTH]["both"]
    figures = {key: best[key] for key in ("mean", "p95", "max")}
    return {"direction": direction, "initial_mean": rows[UNMOVED]["both"]["mean"], **figures, "rows": rows}


def _row(errors_mm: dict[str, Array]) -> dict[str, Any]:
    every = errors_mm | {"both": np.concatenate(list(errors_mm.values()))}
    return {lung: _statistics(e) for lung, e in every.items()}


def _affine_errors(points: Array, images: Array) -> Array:
    return distances(affine_to_points(points, images)(points), images)


def _statistics(errors_mm: Array) -> dict[str, float | int]:
    s = summarize(errors_mm)
    return {"mean": s.mean, "p95": s.p95, "max": s.max, "n": s.n}


def _centre(mesh: TetMesh) -> Array:
    return np.average(mesh.points, axis=0, weights=mesh.node_volumes)
