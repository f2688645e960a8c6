"""Benchmark on real lungs: one breath-hold's lungs moved into the other's by shape alone, scored at landmarks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from poro.correct import correct, pull_of
from poro.mesh import interpolate, locate
from poro.mesh.tetmesh import Array, TriSurface
from poro.observations import Target
from poro.tissue import Tissue
from vatsloc.evaluation.statistics import distances, summarize
from vatsloc.study.affine import affine_to_points, affine_to_shape
from vatsloc.study.breaths import Motion, Person, read_person

EDGE_MM = 10.0
PULLS, STRAIN, REACH_MM = 4, 0.02, 25.0
EMPTIED = 0.3
"""How much more the back of a lung on its back is squeezed than the middle, and its front less: dependent parts are
ventilated more. Ref: Kaneko 1966. Of 0, 0.1, 0.2 and 0.3 the
best on either person."""
UNMOVED, CENTROID, SHAPE_AFFINE = "unmoved", "centroid of the shape", "affine map fitted to the shape"
ELASTIC = "elastic lung that slides on its wall"
DEPENDENT = "the same, emptied more from its back"
TRUE_AFFINE = "affine map fitted to the landmarks"
"""The last row has seen the truth: it is what a map of twelve numbers per lung can reach at best."""

Predict = Callable[[Motion], Array]


def by_centroid(motion: Motion) -> Array:
    """Landmarks shifted as the lung's centroid is."""
    shift = _centroid(motion.onto.points, motion.onto.node_areas) - _centroid(
        motion.mesh.boundary.points, motion.mesh.boundary.node_areas
    )
    return motion.landmarks + shift


def by_shape_affine(motion: Motion) -> Array:
    """Landmarks moved by the affine map that lays surface on surface."""
    return affine_to_shape(motion.mesh.boundary, motion.onto)(motion.landmarks)


def by_sliding_elasticity(motion: Motion) -> Array:
    """Landmarks in an elastic lung whose surface, laid on the other by the affine map, is pulled onto it along the
    normals alone, so that it slides.
    """
    return _slid(motion, 0.0)


def by_dependent_emptying(motion: Motion) -> Array:
    """The same for a lung that rests as if its back had emptied more, or filled more where it grows."""
    shrinks = _volume(motion.onto) < motion.mesh.volumes.sum()
    return _slid(motion, EMPTIED if shrinks else -EMPTIED)


def emptied(points: Array, share: float) -> Array:
    """Displacements (n, 3) mm of a lung that lies on its back: front and back stay, and what lies between moves towards
    the back, so that this is squeezed along the front-back axis by `share` and the front is stretched by as much.
    """
    y = points[:, 1]
    height = (y - y.min()) / np.ptp(y)
    down = np.zeros_like(points)
    down[:, 1] = -share * height * (1 - height) * np.ptp(y)
    return down


def _slid(motion: Motion, share: float) -> Array:
    mesh, onto = motion.mesh, motion.onto
    u = affine_to_shape(mesh.boundary, onto)(mesh.points) - mesh.points + emptied(mesh.points, share)
    wall = Target(onto.points, onto.node_normals, np.ones(len(onto.points)))
    for number in range(PULLS):
        pull = pull_of(wall, mesh, u, correlation_mm=EDGE_MM, reach_mm=REACH_MM)
        robust = 3.0 if number == PULLS - 1 else np.inf
        u = u + correct(mesh, u, Tissue(), pull, STRAIN, robust, rounds=1).u
    return motion.landmarks + interpolate(locate(mesh, motion.landmarks), u)


def by_true_affine(motion: Motion) -> Array:
    """Landmarks moved by the affine map fitted to them."""
    return affine_to_points(motion.landmarks, motion.truth)(motion.landmarks)


ROWS: dict[str, Predict] = {
    UNMOVED: lambda motion: motion.landmarks,
    CENTROID: by_centroid,
    SHAPE_AFFINE: by_shape_affine,
    ELASTIC: by_sliding_elasticity,
    DEPENDENT: by_dependent_emptying,
    TRUE_AFFINE: by_true_affine,
}


def bench_real(folders: Sequence[Path], say: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Errors at the landmarks of every person, from inspiration to expiration and back, per lung and pooled.

    Raises as `read_person`, before anything is computed.
    """
    people = [read_person(folder) for folder in folders]
    return {"cases": [measure(person, deflate, say) for person in people for deflate in (True, False)]}


def measure(person: Person, deflate: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """All rows of one person and one direction."""
    direction = "inspiration to expiration" if deflate else "expiration to inspiration"
    say(f"{person.name}: {direction} ...")
    motions = person.motions(deflate, EDGE_MM)
    rows: dict[str, Any] = {}
    for name, predict in ROWS.items():
        errors = {str(motion.side): distances(predict(motion), motion.truth) for motion in motions}
        errors["both"] = np.concatenate(list(errors.values()))
        rows[name] = {lung: _statistics(e) for lung, e in errors.items()}
    return {"name": person.name, "direction": direction, "rows": rows}


def table(result: dict[str, Any]) -> str:
    """The benchmark as text: mean / 95 % / maximum in mm."""
    lines = []
    for case in result["cases"]:
        lines.append(f"{case['name']}, {case['direction']}: mean / 95 % / maximum in mm at the landmarks")
        lungs = list(next(iter(case["rows"].values())))
        lines.append(" " * 40 + "".join(f"{lung:>22s}" for lung in lungs))
        for name, row in case["rows"].items():
            cells = (f"{s['mean']:.2f} / {s['p95']:.1f} / {s['max']:.1f}" for s in row.values())
            lines.append(f"  {name:38s}" + "".join(f"{cell:>22s}" for cell in cells))
    return "\n".join(lines)


def _statistics(errors_mm: Array) -> dict[str, float | int]:
    s = summarize(errors_mm)
    return {"mean": s.mean, "p95": s.p95, "max": s.max, "n": s.n}


def _volume(surface: TriSurface) -> float:
    """Volume mm3 inside a closed surface."""
    a, b, c = np.moveaxis(surface.points[surface.triangles], 1, 0)
    return float(np.einsum("nd,nd->", a, np.cross(b, c)) / 6)


def _centroid(points: Array, areas: Array) -> Array:
    return np.average(points, axis=0, weights=areas)
