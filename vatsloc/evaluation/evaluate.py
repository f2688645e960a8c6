"""Scoring a result: target registration errors, depth, field of view and nodule, as tables and in the report."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from poro.mesh import interpolate, locate
from registration.volume import Array
from vatsloc.evaluation.ellipsoid import in_ellipsoid
from vatsloc.evaluation.inputs import (
    Result,
    Truth,
    check_same_case,
    depth_below_pleura,
    read_result,
    read_truth,
    seen_in,
)
from vatsloc.evaluation.landmarks import LandmarkTriples
from vatsloc.evaluation.statistics import by_depth, distances, signed_rank_p, summarize
from vatsloc.evaluation.tre import BEFORE, MEASURES, Errors, target_registration_errors
from vatsloc.formats.folder import write_whole
from vatsloc.frames import flip_points
from vatsloc.report.data import TreSection
from vatsloc.report.render import with_scores
from vatsloc.results import REPORT

DENSE_DEPTHS_MM = (0.0, 5.0, 10.0, 20.0, 30.0, math.inf)
"""Bounds of the classes of depth below the pleura that tissue errors are told by; points outside count as the first."""


@dataclass(frozen=True)
class Evaluation:
    """Scores of one result. depth_mm: (n,) below the pleura of the CT; inside_*: (n,) bool; radius95_mm: (n,) how
    far off the run holds a landmark to be at most (95 %), NaN where it does not say; summary: for tre.json.
    """

    landmarks: LandmarkTriples
    errors: Errors
    depth_mm: Array
    inside_fov: Array
    inside_mesh: Array
    radius95_mm: Array
    summary: dict[str, Any]


def evaluate_case(case: Path, folder: Path) -> dict[str, Any]:
    """Score the result in `folder` with the landmarks of `case`; writes tre.csv and tre.json and fills in report.html.

    Returns what tre.json holds. Raises CaseError when the two do not belong together, and as `read_truth` and
    `read_result` do.
    """
    result = read_result(folder)
    check_same_case(case, folder, result.run)
    scores = evaluate(read_truth(case), result)
    write_whole(folder / "tre.csv", as_csv(scores))
    write_whole(folder / "tre.json", json.dumps(scores.summary, indent=1, allow_nan=False) + "\n")
    report = folder / REPORT
    if report.is_file():
        page = report.read_text(encoding="utf-8")
        write_whole(report, with_scores(page, TreSection(scores.summary, scores.errors.mm)))
    return scores.summary


def evaluate(truth: Truth, result: Result) -> Evaluation:
    """Errors of a result at the landmarks of a case. Ref: Alvarez 2021, section 8."""
    landmarks = truth.landmarks
    errors = target_registration_errors(landmarks, result.maps)
    depth = depth_below_pleura(result.whole_lung_ct, landmarks.ct)
    seen = {"inflated": landmarks.inflated, "deflated": landmarks.deflated}
    inside_fov = np.logical_and.reduce(
        [
            seen_in(truth.fields_of_view[image], points)
            for image, points in seen.items()
            if image in truth.fields_of_view
        ]
    )
    inside_mesh = depth >= 0
    if result.lung_inflated is not None:
        inflated = np.isfinite(landmarks.inflated).all(axis=1)
        inside_mesh[inflated] &= locate(result.lung_inflated, landmarks.inflated[inflated]).inside
    grid = result.field.grid
    ijk = grid.to_ijk(landmarks.ct)
    inside_field = np.all((ijk >= -0.5) & (ijk <= np.array(grid.shape) - 0.5), axis=1)
    summary: dict[str, Any] = {m: asdict(summarize(errors.mm[m])) for m in MEASURES}
    summary |= _nodule(truth, result)
    summary["wilcoxon_p"] = {
        after: signed_rank_p(errors.mm[before], errors.mm[after]) for after, before in BEFORE.items()
    }
    summary["inside_fov"] = {m: asdict(summarize(errors.mm[m][inside_fov])) for m in BEFORE}
    summary["by_depth"] = {m: _strata(errors.mm[m], depth) for m in BEFORE}
    radius = _radius95(result, landmarks.ct)
    summary["in_radius95"] = {"landmarks": _held(errors.mm["chain"], radius)}
    summary["dense"] = None
    if truth.dense is not None:
        summary["dense"], held = _dense(truth.dense, truth, result)
        summary["in_radius95"] |= held
    summary["warnings"] = _warnings(landmarks, inside_fov, inside_mesh, inside_field)
    return Evaluation(landmarks, errors, depth, inside_fov, inside_mesh, radius, _without_nan(summary))


def as_csv(scores: Evaluation) -> str:
    """One row per landmark; points in RAS mm, an empty cell where a truth is missing."""
    points = {
        "ct": scores.landmarks.ct,
        "inflated": scores.landmarks.inflated,
        "deflated": scores.landmarks.deflated,
        "predicted_inflated": scores.errors.inflated,
        "predicted_deflated": scores.errors.deflated,
        "predicted_deflated_from_inflated": scores.errors.deflated_from_inflated,
    }
    mm = scores.errors.mm
    tre = {
        f"{phase}_{when}_mm": mm[m]
        for phase, rigid in BEFORE.items()
        for when, m in (("before", rigid), ("after", phase))
    }
    head = [
        "label",
        *(f"{name}_{axis}_ras" for name in points for axis in "xyz"),
        *tre,
        "depth_mm",
        "radius95_mm",
        "inside_fov",
        "inside_mesh",
    ]
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(head)
    for n, label in enumerate(scores.landmarks.labels):
        numbers = [*(v for p in points.values() for v in p[n]), *(e[n] for e in tre.values())]
        numbers += [scores.depth_mm[n], scores.radius95_mm[n]]
        flags = [str(bool(flag[n])).lower() for flag in (scores.inside_fov, scores.inside_mesh)]
        table.writerow([label, *("" if math.isnan(v) else f"{v:.4f}" for v in numbers), *flags])
    return text.getvalue()


def _dense(points: Array, truth: Truth, result: Result) -> tuple[dict[str, Any], dict[str, Any]]:
    """Errors at tissue points all over the lung, and how many of them are within their radius, apart for those that
    both cone-beam CTs show and the others; of the former also by depth below the pleura.
    """
    ct, inflated, deflated = points[:, 0], points[:, 1], points[:, 2]
    seen = seen_in(truth.fields_of_view["deflated"], deflated)
    if "inflated" in truth.fields_of_view:
        seen &= seen_in(truth.fields_of_view["inflated"], inflated)
    errors = {
        "phase1": distances(result.maps.inf_from_ct(ct), inflated),
        "chain": distances(result.maps.def_from_ct(ct), deflated),
    }
    radius = _radius95(result, ct)
    parts = {"inside_fov": seen, "outside_fov": ~seen}
    scores: dict[str, Any] = {
        where: {m: asdict(summarize(e[at])) for m, e in errors.items()} for where, at in parts.items()
    }
    depth = depth_below_pleura(result.whole_lung_ct, ct)
    scores["by_depth"] = _dense_by_depth({m: e[seen] for m, e in errors.items()}, depth[seen], radius[seen])
    return scores, {where: _held(errors["chain"][at], radius[at]) for where, at in parts.items()}


def _dense_by_depth(errors: dict[str, Array], depth_mm: Array, radius_mm: Array) -> list[dict[str, Any]]:
    """Classes of depth below the pleura: n, mean, 95 % and maximum of each error (n,) mm, share within the radius."""
    classes = errors_by_depth(errors, depth_mm)
    for told, at in zip(classes, _classes(depth_mm), strict=True):
        told["share_in_radius95"] = _held(errors["chain"][at], radius_mm[at])["share"]
    return classes


def errors_by_depth(errors: dict[str, Array], depth_mm: Array) -> list[dict[str, Any]]:
    """Classes of depth (n,) mm below the pleura: n, and mean, 95 % and maximum of each error (n,) mm by its name, None
    where n is 0."""
    classes = []
    for (low, high), at in zip(pairwise(DENSE_DEPTHS_MM), _classes(depth_mm), strict=True):
        told: dict[str, Any] = {"from_mm": low, "to_mm": None if math.isinf(high) else high, "n": int(at.sum())}
        for measure, mm in errors.items():
            s = summarize(mm[at])
            told[measure] = {"mean": s.mean, "p95": s.p95, "max": s.max} if s.n else None
        classes.append(told)
    return classes


def _classes(depth_mm: Array) -> list[Array]:
    """Which points (n,) bool are of each class of depth."""
    return [(depth_mm < high) & (depth_mm >= (low if low > 0 else -np.inf)) for low, high in pairwise(DENSE_DEPTHS_MM)]


def _radius95(result: Result, points_ct: Array) -> Array:
    """How far off (n,) mm the run holds points (n, 3) of the CT to be at most, 95 %; NaN where it does not say."""
    if result.radius95_mm is None:
        return np.full(len(points_ct), np.nan)
    return np.asarray(interpolate(locate(result.lung_ct, points_ct), result.radius95_mm))


def _held(errors_mm: Array, radius_mm: Array) -> dict[str, Any]:
    """Share of the points whose error is within its radius, how many have both, the radius's median in mm."""
    known = np.isfinite(errors_mm) & np.isfinite(radius_mm)
    if not known.any():
        return {"share": None, "n": 0, "median_mm": None}
    share = float((errors_mm <= radius_mm)[known].mean())
    return {"share": share, "n": int(known.sum()), "median_mm": float(np.median(radius_mm[known]))}


def _nodule(truth: Truth, result: Result) -> dict[str, Any]:
    """Distance of both predicted nodules to the truth, None where that is not known."""
    inf, deflated = truth.nodule.nodule_inflated_ras, truth.nodule.nodule_deflated_ras
    if result.nodule_inflated_ras is None:
        inf = None
    contained, semi_axes = None, result.run.get("nodule_ellipsoid95_mm")
    if deflated is not None and semi_axes is not None and None not in semi_axes:
        offset = flip_points(deflated - result.nodule_deflated_ras)
        contained = in_ellipsoid(offset, np.array(semi_axes), result.run.get("nodule_ellipsoid95_axes_lps"))
    return {
        "nodule_inflated_mm": None if inf is None else float(np.linalg.norm(inf - result.nodule_inflated_ras)),
        "nodule_deflated_mm": None
        if deflated is None
        else float(np.linalg.norm(deflated - result.nodule_deflated_ras)),
        "nodule_in_ellipsoid95": contained,
    }


def _strata(errors_mm: Array, depth_mm: Array) -> list[dict[str, Any]]:
    return [
        {"from_mm": s.from_mm, "to_mm": s.to_mm if math.isfinite(s.to_mm) else None, **asdict(s.errors)}
        for s in by_depth(errors_mm, depth_mm)
    ]


def _warnings(landmarks: LandmarkTriples, inside_fov: Array, inside_mesh: Array, inside_field: Array) -> list[str]:
    n = len(landmarks)
    found = [
        (
            len(landmarks.unmatched),
            f"label(s) without a counterpart were left out: {', '.join(landmarks.unmatched[:5])}.",
        ),
        (int((~inside_fov).sum()), f"of {n} landmarks lie outside a CBCT's field of view."),
        (
            int((~inside_mesh).sum()),
            f"of {n} landmarks lie outside the lung model; they follow the nearest point of its surface.",
        ),
        (
            int((~inside_field).sum()),
            f"of {n} landmarks lie outside the exported field; its nearest displacement was taken.",
        ),
    ]
    return [f"{count} {sentence}" for count, sentence in found if count]


def _without_nan(value: Any) -> Any:
    """JSON knows no NaN: null stands for a number that does not exist."""
    if isinstance(value, dict):
        return {k: _without_nan(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_without_nan(v) for v in value]
    return None if isinstance(value, float) and math.isnan(value) else value
