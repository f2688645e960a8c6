"""Phase 1 against itk-elastix: errors at landmarks, time, memory and folding, on the same images in the same run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from registration.images.resample import coarsen, resample_mask
from registration.maps.field import DisplacementField, PointMap, compose
from registration.volume import Array, Grid, Volume
from vatsloc.case import read_case
from vatsloc.evaluation.evaluate import DENSE_DEPTHS_MM, errors_by_depth
from vatsloc.evaluation.inputs import Truth, depth_below_pleura, read_truth, seen_in
from vatsloc.evaluation.statistics import distances, summarize
from vatsloc.study.bench.cost_registration import Images, measure_cost
from vatsloc.study.bench.elastix import ElastixSettings, elastix_version, run_elastix
from vatsloc.study.bench.isolated import isolated
from vatsloc.synthetic.case import write_phantom
from vatsloc.workflow.pose import ChangeOfPose, change_of_pose
from vatsloc.workflow.prepare import prepare
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import Say, Stages, quiet

PHANTOMS = (Path("small-right:11"), Path("left:12"), Path("high-diaphragm:13"))
"""Name and seed of the phantoms that are made when no case is given; nothing was chosen on these seeds."""

ROUNDS = 2
PEER_VOXEL_MM = 1.5
SHOWN = tuple(pairwise(DENSE_DEPTHS_MM))[:3]
"""Classes of depth that are shown: deeper in there is texture, and landmarks tell."""
SPINE, FREE_FORM = "spine CT to inflated", "free-form deformation"


@dataclass(frozen=True)
class Dense:
    """Tissue that the CBCT shows. fixed, moving: (n, 3) RAS mm in the CBCT and in the CT; depth_mm: (n,) below the
    pleura there; none without dense truth.
    """

    fixed: Array
    moving: Array
    depth_mm: Array

    def by_depth(self, errors_mm: Array) -> list[dict[str, Any]]:
        """Classes of depth with the mean, 95 % and maximum of errors (n,) mm."""
        return errors_by_depth({"mm": errors_mm}, self.depth_mm)


NOTHING = Dense(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


@dataclass(frozen=True)
class Ours:
    """Our row, and the images and tissue it was made of."""

    row: dict[str, Any]
    images: Images
    dense: Dense = NOTHING


def bench_registration(folders: Sequence[Path], say: Say = quiet) -> dict[str, Any]:
    """Rows of every case folder, and the cost against image size on the first; of three phantoms when there is none.

    Each program runs in a process of its own. "seconds" and "peak_mb" are of the free-form deformation from our rigid
    pose for both; "seconds_phase1" is everything automatic from the images on, the median of warm runs,
    "seconds_cold" the same from a cold start; "seconds_registered" of all that follows the spine. "by_depth" are errors
    at tissue, ours of the free-form deformation, "by_depth_whole" of all of phase 1, block refinement included.
    """
    with TemporaryDirectory() as temporary:
        cases, cost = [], None
        for folder in [case_folder(given, Path(temporary), say) for given in folders or PHANTOMS]:
            name = folder.resolve().name
            say(f"{name}: ours ...")
            ours = isolated(run_ours, folder)
            cases.append(_case(name, ours, ElastixSettings(), say))
            say("\n".join(_rows(cases[-1])))
            if cost is None:
                say("cost against image size ...")
                cost = measure_cost(ours.images)
    return {"cases": cases, "cost": cost, "elastix_version": elastix_version()}


def case_folder(given: Path, root: Path, say: Say) -> Path:
    """`given`, or the folder below `root` with the phantom that "NAME:SEED" names."""
    name, colon, seed = given.name.rpartition(":")
    if not colon or not seed.isdigit() or given.exists():
        return given
    folder = root / f"{name}-{seed}"
    write_phantom(name, folder, int(seed), say)
    return folder


def run_ours(folder: Path, rounds: int = ROUNDS) -> Ours:
    """Automatic phase 1 of a case: once from a cold start, then `rounds` times for the medians."""
    settings, case = Settings(), read_case(folder)
    logs, totals, registered = [], [], []
    for _ in range(rounds + 1):
        stages = Stages()
        prepared = prepare(case, stages)
        before = sum(stages.seconds.values())
        pose = change_of_pose(case, prepared, settings, stages)
        logs.append(stages)
        totals.append(stages.total_seconds)
        registered.append(sum(stages.seconds.values()) - before - stages.seconds[SPINE])
    truth = read_truth(folder)
    inflated, ct = truth.landmarks.inflated, truth.landmarks.ct
    known = seen_in(truth.fields_of_view["inflated"], inflated) & np.isfinite(inflated).all(axis=1)
    images = Images(
        prepared.inflated.volume,
        case.ct,
        pose.lung_inf,
        prepared.lung_ct,
        prepared.inflated.field.usable,
        pose.inf_from_ct_rigid.inverse(),
        inflated[known],
        ct[known],
    )
    if pose.ffd is None:
        raise ValueError("the free-form deformation is switched off; switch it on to compare it")
    found, tissue = pose.ffd.moving_from_fixed, _dense(truth, pose)
    row = score(images, found, found.dense(peer_grid(images)), tissue) | {
        "seconds": median(log.seconds[FREE_FORM] for log in logs[1:]),
        "peak_mb": max(log.peak_mb[FREE_FORM] for log in logs),
        "min_det_box": pose.ffd.min_det,
        "seconds_spine": median(log.seconds[SPINE] for log in logs[1:]),
        "seconds_phase1": median(totals[1:]),
        "seconds_cold": totals[0],
        "seconds_registered": median(registered[1:]),
        "by_depth_whole": tissue.by_depth(distances(pose.inf_from_ct(tissue.moving), tissue.fixed)),
        "tre_through_mesh": tre(distances(pose.inf_from_ct(images.marks_moving), images.marks_fixed)),
    }
    return Ours(row, images, tissue)


def _dense(truth: Truth, pose: ChangeOfPose) -> Dense:
    if truth.dense is None:
        return NOTHING
    ct, inflated = truth.dense[:, 0], truth.dense[:, 1]
    seen = seen_in(truth.fields_of_view["inflated"], inflated)
    return Dense(inflated[seen], ct[seen], depth_below_pleura(pose.mesh_ct, ct[seen]))


def run_peer(images: Images, settings: ElastixSettings, dense: Dense) -> dict[str, dict[str, Any]]:
    """elastix from our rigid pose, the metric over the field of view and over the lung in it."""
    placed = images.pose.inverse().matrix
    fixed, moving = coarsen(images.fixed, PEER_VOXEL_MM), coarsen(images.moving, PEER_VOXEL_MM)
    moving = Volume(moving.hu, placed @ moving.ras_from_ijk)
    rows = {}
    for name, region in (("whole image", images.usable), ("lung mask", images.seen_lung)):
        run = run_elastix(fixed, moving, resample_mask(region, fixed.grid), settings)
        found = compose(images.pose, run.moving_from_fixed)
        rows[name] = score(images, found, found, dense) | {"seconds": run.seconds, "peak_mb": run.peak_mb}
    return rows


def score(images: Images, found: PointMap, field: DisplacementField, dense: Dense = NOTHING) -> dict[str, Any]:
    """Errors of a map from CBCT to CT at landmarks and tissue, in the CT; folding of its field in the lung seen."""
    det = field.jacobian_determinant()[resample_mask(images.seen_lung, field.grid).inside]
    errors = tre(distances(found(images.marks_fixed), images.marks_moving))
    by_depth = dense.by_depth(distances(found(dense.fixed), dense.moving))
    return errors | {"min_det": float(det.min()), "folded_share": float(np.mean(det <= 0)), "by_depth": by_depth}


def tre(errors_mm: Array) -> dict[str, Any]:
    """Mean, 95 % and maximum of target registration errors (n,) in mm."""
    s = summarize(errors_mm)
    return {"tre_mean": s.mean, "tre_p95": s.p95, "tre_max": s.max, "n": s.n}


def peer_grid(images: Images) -> Grid:
    """Voxels on which both programs' folding is counted."""
    return images.fixed.grid.with_spacing(np.maximum(PEER_VOXEL_MM, images.fixed.grid.spacing))


def table(result: dict[str, Any]) -> str:
    """The benchmark as text."""
    lines = ["case              program              mean   95 %    max  seconds  peak MB  min det  folded"]
    for case in result["cases"]:
        lines += _rows(case)
    for case in result["cases"]:
        r = case["ours"]
        lines.append(
            f"{case['name']}: all of phase 1 from the images on {r['seconds_phase1']:.1f} s, "
            f"{r['seconds_cold']:.1f} s from a cold start; spine {r['seconds_spine']:.1f} s"
        )
    cost = result["cost"]
    for r in cost["sizes"]:
        lines.append(f"{r['voxels']:10d} voxels of {r['voxel_mm']:.2f} mm: {r['seconds']:6.2f} s, {r['mb']:6.0f} MB")
    lines.append(f"seconds ~ voxels^{cost['exponent_seconds']:.2f}, MB ~ voxels^{cost['exponent_mb']:.2f}")
    if result["elastix_version"] is None:
        lines.append("itk-elastix is not installed (pip install vatsloc[peers]): no comparison.")
    return "\n".join(lines)


def _rows(case: dict[str, Any]) -> list[str]:
    rows = {"rigid pose": case["rigid"], "ours": case["ours"]}
    rows |= {f"elastix, {name}": row for name, row in (case["elastix_rows"] or {}).items()}
    lines = []
    for name, r in rows.items():
        errors = f"{case['name']:17s} {name:20s} {r['tre_mean']:4.2f} {r['tre_p95']:6.2f} {r['tre_max']:6.2f}"
        cost = (
            ""
            if name == "rigid pose"
            else (f" {r['seconds']:8.1f} {r['peak_mb']:8.0f} {r['min_det']:8.3f} {100 * r['folded_share']:6.2f}%")
        )
        lines.append(errors + cost)
    return lines


def page(result: dict[str, Any]) -> str:
    """The benchmark as a page of the documentation."""
    lines = [
        "# Phase 1 beside itk-elastix\n",
        "Made by `vatsloc bench registration CASES --out FILE`, every program in its own process. Errors in mm at the",
        "landmarks inside the field of view; both start from our rigid pose. Seconds and peak memory are of the",
        "deformable registration alone; det and folded share count the lung that is seen.\n",
        "```",
        table(result),
        "```\n",
        "| case | faster than the better elastix row | mean no worse | 95 % no worse | max no worse |",
        "|---|---|---|---|---|",
    ]
    for case in result["cases"]:
        ours, peer = case["ours"], case["elastix"]
        if peer is not None:
            better = ["yes" if ours[key] <= peer[key] else "no" for key in ("tre_mean", "tre_p95", "tre_max")]
            lines.append(f"| {case['name']} | {peer['seconds'] / ours['seconds']:.1f} x | {' | '.join(better)} |")
    return "\n".join(lines) + "\n" + depth_table(result["cases"])


def depth_table(cases: Sequence[dict[str, Any]]) -> str:
    """Errors by depth below the pleura as a Markdown table; empty without dense truth."""
    lines: list[str] = []
    for case in cases:
        ours = case["ours"]
        classes, seconds = ours.get("by_depth_whole") or [], ours.get("seconds_registered", 0.0)
        if not any(told["n"] for told in classes):
            continue
        rows = {"ours, all of phase 1": (classes, seconds), "ours, free form": (ours["by_depth"], ours["seconds"])}
        rows |= {f"elastix, {n}": (r["by_depth"], r["seconds"]) for n, r in (case["elastix_rows"] or {}).items()}
        for program, (told, took) in rows.items():
            cells = [_mean_and_95(one["mm"]) for one in told[: len(SHOWN)]]
            lines.append(f"| {case['name']} | {program} | {' | '.join(cells)} | {took:.1f} |")
    if not lines:
        return ""
    head = " | ".join(f"{low:g}-{high:g} mm" for low, high in SHOWN)
    return "\n".join(
        [
            "\nTissue in view by its depth below the pleura, mean / 95 % mm; seconds after the rigid pose:\n",
            f"| case | program | {head} | s |",
            "|---" * (len(SHOWN) + 3) + "|",
            *lines,
            "",
        ]
    )


def _mean_and_95(mm: dict[str, float] | None) -> str:
    return "" if mm is None else f"{mm['mean']:.2f} / {mm['p95']:.2f}"


def _case(name: str, ours: Ours, settings: ElastixSettings, say: Say) -> dict[str, Any]:
    rows = None
    if elastix_version() is not None:
        say(f"{name}: elastix ...")
        rows = isolated(run_peer, ours.images, settings, ours.dense)
    best = min(rows.values(), key=lambda row: row["tre_mean"]) if rows else None
    start = tre(distances(ours.images.pose(ours.images.marks_fixed), ours.images.marks_moving))
    return {"name": name, "ours": ours.row, "elastix": best, "elastix_rows": rows, "rigid": start}
