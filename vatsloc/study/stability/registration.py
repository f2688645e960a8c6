"""Where registration stops being right: noise, view, motion, collapse; and the spine's pose from afar.

The scene is a lung of soft balls inside a patterned wall that stays. The lung moves along the wall and is stretched,
so the truth is known at every point.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from registration.ffd import FfdFit, FfdSettings
from registration.maps.field import PointMap
from registration.maps.rigid import RigidTransform
from registration.sliding import LungImage, register_sliding
from registration.spine import register_spine
from registration.volume import Array, Grid, Mask, Volume
from vatsloc.study.chart import variants as chart_variants
from vatsloc.study.tables import markdown
from vatsloc.workflow.pose import Register

Row = dict[str, Any]
SUCCESS_MM = 1.5
"""A registration succeeds when its mean error stays below this and nothing folds."""
SEEDS = (0, 1, 2)
SETTINGS = FfdSettings(levels=3, voxel_mm=3.0)
_RADII = np.array([52.0, 62.0, 84.0])


@dataclass(frozen=True)
class Scene:
    """One pair. noise_hu: white, in the fixed image; view_mm: radius of what it shows about S; off_mm: error of the
    start along a random direction; move_mm: greatest slide along the wall; collapsed_mm: radius of a ball of lung that
    is dense in the fixed image alone."""

    noise_hu: float = 30.0
    view_mm: float = 75.0
    off_mm: float = 0.0
    move_mm: float = 12.0
    collapsed_mm: float = 0.0


AXES: dict[str, tuple[float, ...]] = {
    "noise_hu": (0, 100, 200, 400),
    "view_mm": (75, 50, 35, 20),
    "off_mm": (0, 10, 20, 30),
    "move_mm": (5, 15, 25, 40),
    "collapsed_mm": (0, 15, 25, 40),
}


@dataclass(frozen=True)
class Pair:
    """Images, the start, and the truth at probes (n, 3) in the fixed image's lung and view."""

    fixed: LungImage
    moving: LungImage
    start: PointMap
    probes: Array
    truth: Array


def make_pair(scene: Scene, seed: int) -> Pair:
    """The pair of a scene; every seed has its own lung, slide and start."""
    rng = np.random.default_rng(seed)
    balls, sizes = rng.uniform(-1, 1, (500, 3)) * _RADII, rng.uniform(2.0, 6.0, 500)
    heights = rng.uniform(300, 800, 500)
    phase = rng.uniform(0, 2 * np.pi, 3)

    def mapped(points: Array) -> Array:
        """Fixed to moving: a slide along S that fades with height, and a sway across it a fifth as large."""
        t = points / _RADII
        shift = np.stack([0.2 * np.sin(t[:, 2] + phase[0]), 0.2 * np.sin(t[:, 0] + phase[1]), 0.5 + 0.5 * -t[:, 2]], 1)
        return np.asarray(points + scene.move_mm * shift)

    grid = _grid(3.0, (44, 50, 64))
    moving = _picture(grid.points().reshape(-1, 3), None, balls, sizes, heights)
    points = grid.points().reshape(-1, 3)
    fixed = _picture(points, mapped, balls, sizes, heights)
    inside = _depth(mapped(points)) > 0
    if scene.collapsed_mm > 0:
        core = np.linalg.norm(points - [0.0, -20.0, -20.0], axis=1) < scene.collapsed_mm
        fixed[core & inside] = 20.0
    fixed += rng.normal(0, scene.noise_hu, len(fixed))
    seen = np.hypot(points[:, 0], points[:, 1]) < scene.view_mm
    fixed[~seen] = -1000.0
    off = rng.normal(size=3)
    off *= scene.off_mm / np.linalg.norm(off)
    probes = points[seen & (_depth(mapped(points)) > 3.0)]
    probes = probes[rng.permutation(len(probes))[:1000]]
    return Pair(
        LungImage(_volume(fixed, grid), _mask(inside, grid), _mask(seen, grid)),
        LungImage(_volume(moving, grid), _mask(_depth(points) > 0, grid)),
        RigidTransform.about(np.zeros(3), np.zeros(3), off),
        probes,
        mapped(probes),
    )


def plain(pair: Pair) -> FfdFit:
    """Free-form deformation of all that is seen."""
    return _registered(chart_variants.plain, pair)


def masked_only(pair: Pair) -> FfdFit:
    """The paper's: both images masked outside their lungs, compared 5 mm beyond."""
    return _registered(chart_variants.masked_only, pair)


def ours(pair: Pair) -> FfdFit:
    """`register_sliding`, which a run uses."""
    return _registered(register_sliding, pair)


def _registered(register: Register, pair: Pair) -> FfdFit:
    return register(pair.fixed, pair.moving, SETTINGS, pair.start)


METHODS: dict[str, Callable[[Pair], FfdFit]] = {"plain": plain, "masked": masked_only, "ours": ours}


def sweep(axis: str, values: tuple[float, ...], seeds: tuple[int, ...] = SEEDS) -> list[Row]:
    """One row per value of `axis` and method, the other circumstances as in `Scene`."""
    rows = []
    for value in values:
        pairs = [make_pair(replace(Scene(), **{axis: value}), seed) for seed in seeds]
        start = [float(_errors(p.start, p).mean()) for p in pairs]
        for name, method in METHODS.items():
            fits = [method(p) for p in pairs]
            errors = [_errors(f.moving_from_fixed, p) for f, p in zip(fits, pairs, strict=True)]
            good = [e.mean() <= SUCCESS_MM and f.folded_share == 0 for e, f in zip(errors, fits, strict=True)]
            rows.append(
                {
                    axis: value,
                    "method": name,
                    "start_mm": float(np.mean(start)),
                    "tre_mean": float(np.mean([e.mean() for e in errors])),
                    "tre_p95": float(np.mean([np.percentile(e, 95) for e in errors])),
                    "tre_max": float(np.max([e.max() for e in errors])),
                    "success": float(np.mean(good)),
                }
            )
    return rows


def spine_sweep(seeds: tuple[int, ...] = SEEDS) -> list[Row]:
    """The spine's pose from ever further off, with all vertebrae, one missing in the view, or all alike."""
    rows = []
    for kind in ("whole", "one missing", "alike"):
        for off_mm, turn in ((0, 0), (25, 6), (50, 12), (75, 18), (100, 25)):
            outcomes, errors = [], []
            for seed in seeds:
                error, status = spine_error(kind, off_mm, turn, seed)
                errors.append(error)
                outcomes.append((error < 2.0, status == "FOUND"))
            rows.append(
                {
                    "spine": kind,
                    "off_mm": off_mm,
                    "turn_degrees": turn,
                    "error_mm_median": float(np.median(errors)),
                    "error_mm_max": float(np.max(errors)),
                    "right": sum(right for right, _ in outcomes),
                    "right_and_believed": sum(right and believed for right, believed in outcomes),
                    "wrong_and_believed": sum(believed and not right for right, believed in outcomes),
                    "tries": len(seeds),
                }
            )
    return rows


def spine_error(kind: str, off_mm: float, turn_degrees: float, seed: int) -> tuple[float, str]:
    """Greatest error in mm over the vertebrae that are seen, and the status reported, of one search."""
    rng = np.random.default_rng(seed)
    axis, shift = rng.normal(size=(2, 3))
    turn = np.radians(turn_degrees) * axis / np.linalg.norm(axis)
    true = RigidTransform.about(np.zeros(3), turn, off_mm * shift / np.linalg.norm(shift))
    wide = _grid(3.0, (64, 64, 110))
    near = Grid((46, 46, 48), _centred((46, 46, 48), 3.0, true.inverse()(np.zeros((1, 3)))[0]))
    points = near.points().reshape(-1, 3)
    marked = 0.0 if kind == "alike" else 1.0
    hu = _spine(true(points), marked, missing=kind == "one missing") + rng.normal(0, 40, len(points))
    moving = _spine(wide.points().reshape(-1, 3), marked, missing=False)
    column = np.hypot(true(points)[:, 0], true(points)[:, 1] + 5) < 25
    fit = register_spine(_volume(hu, near), _volume(moving, wide), Mask(column.reshape(near.shape), near.ras_from_ijk))
    probes = points[column][::50]
    error = float(np.linalg.norm(fit.moving_from_fixed(probes) - true(probes), axis=1).max())
    return error, fit.status.name


def stability_registration(out: Path, say: Callable[[str], None]) -> dict[str, list[Row]]:
    """Run every sweep, write a CSV of each, one plot and tables.md into `out`; returns the rows.

    A sweep whose CSV lies in `out` already is read and not run again.
    """
    out.mkdir(parents=True, exist_ok=True)
    studies: dict[str, Callable[[], list[Row]]] = {axis: partial(sweep, axis, values) for axis, values in AXES.items()}
    studies["spine"] = spine_sweep
    result = {}
    for name, study in studies.items():
        file = out / f"{name}.csv"
        if not file.exists():
            say(f"{name} ...")
            _write(file, study())
        result[name] = _read(file)
    (out / "tables.md").write_text("\n".join(f"## {name}\n\n{markdown(rows)}\n" for name, rows in result.items()))
    plot(result, out / "stability-registration.png")
    return result


def plot(result: dict[str, list[Row]], file: Path) -> None:
    """Mean error on a logarithmic scale over every axis, whatever its size; needs matplotlib, the extra `report`."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(2, len(AXES), figsize=(3.2 * len(AXES), 6), sharey="row", squeeze=False)
    for column, axis in enumerate(AXES):
        for method in METHODS:
            rows = [row for row in result[axis] if row["method"] == method]
            x = [row[axis] for row in rows]
            panels[0, column].plot(x, [row["tre_mean"] for row in rows], "o-", label=method)
            panels[1, column].plot(x, [row["success"] for row in rows], "o-", label=method)
        panels[0, column].plot(x, [row["start_mm"] for row in rows], "k:", label="start")
        panels[0, column].axhline(SUCCESS_MM, color="grey", lw=0.5)
        panels[0, column].set_yscale("log")
        panels[1, column].set(xlabel=axis, ylim=(-0.05, 1.05))
    panels[0, 0].set_ylabel("mean TRE, mm")
    panels[1, 0].set_ylabel("success rate")
    panels[0, 0].legend()
    figure.tight_layout()
    figure.savefig(file, dpi=90)
    pyplot.close(figure)


def _errors(found: PointMap, pair: Pair) -> Array:
    return np.asarray(np.linalg.norm(found(pair.probes) - pair.truth, axis=1))


def _depth(points: Array) -> Array:
    """Depth in mm below the wall of the moving lung, an ellipsoid; negative outside."""
    return np.asarray((1 - np.linalg.norm(points / _RADII, axis=1)) * _RADII.min())


def _picture(points: Array, mapped: PointMap | None, balls: Array, sizes: Array, heights: Array) -> Array:
    """HU (n,) at points of an image whose lung lies where `mapped` takes it into the moving image."""
    lung = points if mapped is None else mapped(points)
    hu = np.where(_depth(lung) > 0, -850.0, 40 + 80 * np.sin(points[:, 2] / 8) * np.sin(points[:, 0] / 11))
    inside = np.flatnonzero(_depth(lung) > 4)
    order = cKDTree(lung[inside])
    for centre, size, height in zip(balls, sizes, heights, strict=True):
        near = inside[order.query_ball_point(centre, 3 * size)]
        hu[near] += height * np.exp(-np.sum((lung[near] - centre) ** 2, axis=1) / (2 * size**2))
    return np.minimum(hu, 150.0)


def _spine(points: Array, marked: float, missing: bool) -> Array:
    """HU (n,) of equal vertebrae every 24 mm along S whose ribs lengthen downwards, times `marked`; `missing` leaves
    out the body of the one in the middle."""
    x, y, z = points.T
    level = np.floor(z / 24.0 + 0.5)
    phase = z - 24.0 * level
    hu = np.where(np.hypot(x, y) > 70, -800.0, 40.0)
    body = (np.hypot(x, y) < 16) & (np.abs(phase) < 9)
    process = (np.abs(x) < 4) & (y < -14) & (y > -40) & (np.abs(phase + 3) < 6)
    rib = (np.abs(phase) < 4) & (np.abs(y + 14) < 4) & (np.abs(x) < 36 + marked * 7 * level) & (np.abs(x) > 18)
    hu[body & ~(missing & (level == 0))] = 350.0
    hu[process | rib] = 600.0
    return hu


def _centred(shape: tuple[int, int, int], voxel_mm: float, centre: Array) -> Array:
    affine = np.diag([voxel_mm, voxel_mm, voxel_mm, 1.0])
    affine[:3, 3] = centre - voxel_mm * (np.array(shape) - 1) / 2
    return affine


def _grid(voxel_mm: float, shape: tuple[int, int, int]) -> Grid:
    return Grid(shape, _centred(shape, voxel_mm, np.zeros(3)))


def _mask(inside: Array, grid: Grid) -> Mask:
    return Mask(inside.reshape(grid.shape), grid.ras_from_ijk)


def _volume(hu: Array, grid: Grid) -> Volume:
    return Volume(hu.reshape(grid.shape).astype(np.float32), grid.ras_from_ijk)


def _write(file: Path, rows: list[Row]) -> None:
    with file.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _read(file: Path) -> list[Row]:
    """Rows of a CSV, numbers as numbers."""
    with file.open(newline="") as stream:
        return [{key: _number(value) for key, value in row.items()} for row in csv.DictReader(stream)]


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text
