"""Bones of the thorax: vertebrae that differ, discs, ribs with cartilage, sternum, clavicles, scapulae."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phantoms.anatomy import Build, cage_axes, spine_y
from phantoms.fields import coverage
from phantoms.trees import draw_tubes
from phantoms.voxels import Grid

Array = NDArray[Any]


@dataclass(frozen=True)
class Vertebra:
    """One vertebra. centre: (3,) RAS mm of its body; height, half_width, half_depth: mm; tilt: slope of its axis in the
    sagittal plane; process: (2,) mm the spinous process runs back and down; lean: sideways slope of the process;
    marrow: HU; spur: mm of osteophyte on its upper rim; disc: mm of disc above it."""

    centre: Array
    height: float
    half_width: float
    half_depth: float
    tilt: float
    process: Array
    lean: float
    marrow: float
    spur: float
    disc: float


def draw_spine(build: Build, bottom: float, top: float, rng: np.random.Generator) -> list[Vertebra]:
    """Vertebrae from below `bottom` to above `top` (mm), growing downwards, each its own size, slope and density."""
    spine = []
    z = bottom - rng.uniform(0, 20)
    while z < top + 20:
        down = np.clip((build.apex - z) / 300, 0, 1)
        height = (16.5 + 7 * down) * rng.uniform(0.93, 1.07)
        disc = (3.6 + 2.4 * down) * rng.uniform(0.7, 1.2)
        centre = np.array([rng.normal(0, 0.8), float(spine_y(build, np.array(z + height / 2))), z + height / 2])
        slope = float(spine_y(build, np.array(z + 10.0)) - spine_y(build, np.array(z - 10.0))) / 20
        back, fall = rng.uniform(22, 34), rng.uniform(4, 24)
        spine.append(
            Vertebra(
                centre=centre,
                height=height,
                half_width=(13.5 + 5.5 * down) * rng.uniform(0.94, 1.06),
                half_depth=(11.5 + 3.5 * down) * rng.uniform(0.94, 1.06),
                tilt=slope + rng.normal(0, 0.03),
                process=np.array([back, fall]),
                lean=rng.normal(0, 0.08),
                marrow=rng.uniform(150, 260),
                spur=float(rng.choice([0.0, 0.0, 2.0, 4.0])),
                disc=disc,
            )
        )
        z += height + disc
    return spine


def draw_bones(hu: Array, grid: Grid, build: Build, spine: list[Vertebra], rng: np.random.Generator) -> None:
    """Paint the skeleton into a CT (HU) whose axes are parallel to RAS."""
    width = float(grid.spacing.mean())
    for vertebra in spine:
        _draw_vertebra(hu, grid, vertebra, width)
    bone, marrow, cartilage = (np.zeros(grid.shape, dtype=np.float32) for _ in range(3))
    for path, radius, soft_from in _long_bones(build, spine, rng):
        ends = np.stack([path[:-1], path[1:]], axis=1)
        radii = np.full((len(ends), 2), radius)
        hard = np.arange(len(ends)) < soft_from
        draw_tubes(bone, grid, ends[hard], radii[hard], width)
        if radius > 3:
            draw_tubes(marrow, grid, ends[hard], radii[hard] - 1.7, width)
        draw_tubes(cartilage, grid, ends[~hard], radii[~hard], width)
    hu += cartilage * (110 - hu)
    hu += bone * (780 - hu)
    hu += marrow * (200 - hu)


def cage_point(build: Build, side: int, angle: Array, z: Array, outward_mm: float | Array) -> Array:
    """Point (n, 3) on the cage at `angle` (rad) from the back, `outward_mm` outside its inner surface."""
    half_x, half_y, centre = cage_axes(build, np.minimum(z, build.apex - 14))
    s, c = np.sin(angle), np.cos(angle)
    power = 2 / 2.35
    x = (half_x + outward_mm) * np.abs(s) ** power * np.sign(s)
    y = centre - (half_y + outward_mm) * np.abs(c) ** power * np.sign(c)
    return np.stack([side * x, y, np.broadcast_to(z, x.shape)], axis=1)


def _long_bones(build: Build, spine: list[Vertebra], rng: np.random.Generator) -> list[tuple[Array, float, int]]:
    """Paths (n, 3), radius in mm and the piece at which bone turns into cartilage."""
    bones = []
    t = np.linspace(0, 1, 30)
    for n, vertebra in enumerate(reversed([v for v in spine if v.centre[2] < build.apex + 4])):
        if n > 11:
            break
        for side in (1, -1):
            drop = (48 + 8 * min(n, 5)) * rng.uniform(0.95, 1.05)
            reach = np.deg2rad([150, 158, 164, 167, 167, 165, 158, 145, 130, 115, 95, 80][n])
            angle = np.deg2rad(11) + (reach - np.deg2rad(11)) * t
            rise = (0.25 + 0.2 * min(n, 4)) * np.maximum(t - 0.8, 0)
            z = vertebra.centre[2] + 2 - drop * (0.15 * t + 0.765 * t * t * (3 - 2 * t) - rise)
            path = cage_point(build, side, angle, z, 6.0)
            head = vertebra.centre + np.array(
                [side * (vertebra.half_width + 2), 2 - vertebra.half_depth, 0.4 * vertebra.height]
            )
            bones.append((np.stack([head, path[0]]), 4.0, 2))
            for shift in (-3.0, 0.0, 3.0):
                bones.append((path + np.array([0, 0, shift]), 3.6, 24 if n < 10 else 30))
    bones += _sternum_and_girdle(build)
    return bones


def _sternum_and_girdle(build: Build) -> list[tuple[Array, float, int]]:
    bones = []
    z = np.linspace(0.52 * build.apex, -0.55 * build.apex, 16)
    front = cage_point(build, 1, np.full(16, np.pi), z, 9.0)
    half = np.interp(np.arange(16), [0, 3, 4, 15], [24, 14, 11, 15])
    for offset in np.linspace(-1, 1, 11):
        bones.append((front + np.stack([offset * half, 0 * half, 0 * half], axis=1), 4.2, 16))
    for side in (1, -1):
        t = np.linspace(0, 1, 12)
        collar = np.array([side * 22, front[0, 1] + 4, z[0] + 12]) + np.outer(t, [side * 125, -34, 36])
        collar[:, 1] += 10 * np.sin(2 * np.pi * t)
        bones.append((collar, 5.5, 12))
        shoulder = np.array([side * (build.width + 12), -0.25 * build.depth, build.apex - 14])
        bones.append((shoulder + np.outer(np.linspace(0, 1, 4), [side * 3, 2, 8]), 21.0, 4))
        bones.append((shoulder + np.outer(np.linspace(0, 1, 4), [side * 26, 14, 70]), 11.0, 4))
        for s in np.linspace(0, 1, 26):
            height = 0.82 * build.apex - s * 1.05 * build.apex
            angle = np.deg2rad(np.linspace(26 + 4 * s, 66 - 34 * s, 10))
            plate = cage_point(build, side, angle, np.full(10, height), 17.0 + 3 * np.sin(np.linspace(0, 3, 10)))
            edge = s in (0.0, 1.0)
            bones.append((plate, 4.0 if edge else 2.1, 10))
    return bones


def _draw_vertebra(hu: Array, grid: Grid, v: Vertebra, width: float) -> None:
    step = np.diag(grid.ras_from_ijk[:3, :3])
    reach = np.array([[-48, -75, -44], [48, 26, 30]]) + v.centre
    box = ((reach - grid.ras_from_ijk[:3, 3]) / step).T
    lo = np.clip(np.ceil(box.min(axis=1)), 0, grid.shape).astype(int)
    hi = np.clip(np.floor(box.max(axis=1)) + 1, 0, grid.shape).astype(int)
    if np.any(hi <= lo):
        return
    view = hu[lo[0] : hi[0], lo[1] : hi[1], lo[2] : hi[2]]
    at = [grid.ras_from_ijk[m, 3] + step[m] * np.arange(lo[m], hi[m]) - v.centre[m] for m in range(3)]
    x, z = at[0][:, None, None], at[2][None, None, :]
    y = at[1][None, :, None] - v.tilt * z
    z = z + v.tilt * (y + 0 * x)
    half = v.height / 2
    rim = np.abs(z) / half
    spur = v.spur * np.clip(1 - np.abs(z - half) / 4, 0, 1)
    waist = 1 - 0.10 * np.clip(1 - rim**2, 0, 1)
    rho = np.sqrt((x / (v.half_width * waist + spur)) ** 2 + (y / (v.half_depth * waist + spur)) ** 2)
    flat = (rho - 1) * v.half_depth
    solid = np.maximum(flat, np.abs(z) - half)
    disc = np.maximum(flat + 0.5, np.abs(z - half - v.disc / 2) - v.disc / 2)
    canal_y = -(v.half_depth + 8.5)
    canal = np.sqrt(x**2 + (y - canal_y) ** 2)
    arch = np.maximum(np.maximum(np.abs(canal - 10.8) - 2.6, np.abs(z + 1) - 0.42 * v.height), y + v.half_depth - 3)
    back, fall = v.process
    tip = np.array([v.lean * back, canal_y - 11 - back, -fall])
    arch = np.minimum(arch, _capsule(x, y, z, np.array([0, canal_y - 10, 0]), tip, 3.4))
    for side in (1, -1):
        a, b = np.array([side * 10, canal_y + 2, 2.0]), np.array([side * (v.half_width + 15), canal_y - 10, 5.0])
        arch = np.minimum(arch, _capsule(x, y, z, a, b, 4.6))
    view += coverage(disc, width) * (85 - view)
    view += coverage(np.maximum(canal - 8.2, np.abs(z) - v.height), width) * (25 - view)
    # The plates at the ends of a body are thinner than its walls.
    shell = 560 - 290 * (np.abs(z) - half > flat + 1.0)
    for part, hard, inner in ((solid, shell, v.marrow), (arch, 560, v.marrow + 120)):
        view += coverage(part, width) * (hard - view)
        view += coverage(part + 1.6, width) * (inner - view)


def _capsule(x: Array, y: Array, z: Array, a: Array, b: Array, radius: float) -> Array:
    d = b - a
    t = np.clip(((x - a[0]) * d[0] + (y - a[1]) * d[1] + (z - a[2]) * d[2]) / (d @ d), 0, 1)
    px, py, pz = x - a[0] - t * d[0], y - a[1] - t * d[1], z - a[2] - t * d[2]
    return np.sqrt(px * px + py * py + pz * pz) - radius
