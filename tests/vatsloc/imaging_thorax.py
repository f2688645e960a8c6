"""A thorax of ellipsoids and tubes, small and exactly known, as CT and as CBCT; shared by the imaging tests."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import ndimage

from registration.volume import Grid, Mask, Volume

SHAPE = (120, 88, 100)
SPACING = 2.5
CENTRES = {"right": np.array([70.0, 10.0, -10.0]), "left": np.array([-70.0, 10.0, -10.0])}
HALF_AXES = np.array([46.0, 66.0, 95.0])
CARINA = np.array([0.0, 5.0, 20.0])


@dataclass(frozen=True)
class Thorax:
    """Known image: volume and the masks that made it."""

    volume: Volume
    lungs: dict[str, Mask]
    airways: Mask
    vertebrae: Mask


def grid(shape: tuple[int, int, int] = SHAPE, spacing: float = SPACING, centre: tuple[float, ...] = (0, 0, 0)) -> Grid:
    """RAS grid centred on a point."""
    affine = np.diag([spacing, spacing, spacing, 1.0])
    affine[:3, 3] = np.array(centre) - spacing * (np.array(shape) - 1) / 2
    return Grid(shape, affine)


def _ellipsoid(x: np.ndarray, centre: np.ndarray, half_axes: np.ndarray) -> np.ndarray:
    return (((x - centre) / half_axes) ** 2).sum(axis=-1) < 1


def _tube(x: np.ndarray, a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    along = b - a
    t = np.clip(((x - a) @ along) / (along @ along), 0, 1)
    return np.linalg.norm(x - a - t[..., None] * along, axis=-1) < radius


def vertebra_parts(x: np.ndarray) -> np.ndarray:
    """Bodies 20 mm high every 24 mm, spinous processes, and rib heads on every second one."""
    level = np.mod(x[..., 2] + 12.0, 24.0)
    high = (level > 2.0) & (level < 22.0)
    body = np.hypot(x[..., 0], x[..., 1] + 55.0) < 16.0
    process = (np.abs(x[..., 0]) < 5.0) & (x[..., 1] < -70.0) & (x[..., 1] > -90.0) & (level > 6.0) & (level < 18.0)
    ribs = (np.abs(x[..., 0]) < 32.0) & (np.abs(x[..., 1] + 62.0) < 5.0) & (np.abs(level - 12.0) < 4.0)
    return (body & high) | process | ribs


@lru_cache(maxsize=8)
def thorax(touching: bool = False, scale_right: float = 1.0, seed: int = 0, one_lung: bool = False) -> Thorax:
    """CT in RAS; lungs -850, airways -1000, soft 40, bone 400 HU, noise 10 HU.

    touching: the lungs meet at the front; scale_right: the right lung shrunk inside its space, air -1000 HU around it.
    """
    g = grid()
    x = g.points()
    hu = np.full(SHAPE, -1000.0)
    body = (x[..., 0] / 140.0) ** 2 + (x[..., 1] / 100.0) ** 2 < 1
    hu[body] = 40.0
    lungs = {name: _ellipsoid(x, CENTRES[name], HALF_AXES) for name in ("right", "left")}
    if touching:
        for name in lungs:
            bridge = (np.abs(x[..., 0]) < 30) & (np.abs(x[..., 1] - 60) < 6) & (np.abs(x[..., 2]) < 30)
            lungs[name] |= bridge & ((x[..., 0] > 0) == (name == "right"))
    if one_lung:
        lungs["left"] = np.zeros(SHAPE, dtype=bool)
    for inside in lungs.values():
        hu[inside] = -850.0
    if scale_right < 1.0:
        hu[lungs["right"]] = -1000.0
        lungs["right"] = _ellipsoid(
            x, CENTRES["right"] - np.array([HALF_AXES[0] * (1 - scale_right), 0, 0]), HALF_AXES * scale_right
        )
        hu[lungs["right"]] = -700.0
    vertebrae = vertebra_parts(x) & body
    hu[vertebrae] = 400.0
    wall = _tube(x, CARINA, np.array([0.0, 5.0, 150.0]), 12.0)
    lumen = _tube(x, CARINA, np.array([0.0, 5.0, 150.0]), 8.5)
    for name in ("right", "left"):
        root = CARINA + np.array([np.sign(CENTRES[name][0]) * 45.0, 0.0, -25.0])
        wall |= _tube(x, CARINA, root, 9.0)
        lumen |= _tube(x, CARINA, root, 6.5)
    hu[wall & ~lumen & body] = 40.0
    hu[lumen & body] = -1000.0
    hu = ndimage.gaussian_filter(hu, 0.5) + np.random.default_rng(seed).normal(0, 10, SHAPE)
    masks = {name: Mask(m, g.ras_from_ijk) for name, m in lungs.items()}
    return Thorax(
        Volume(hu.astype(np.float32), g.ras_from_ijk),
        masks,
        Mask(lumen & body, g.ras_from_ijk),
        Mask(vertebrae, g.ras_from_ijk),
    )


def dice(a: Mask, b: Mask) -> float:
    """Overlap of two masks on one grid."""
    return float(2 * (a.inside & b.inside).sum() / max(a.inside.sum() + b.inside.sum(), 1))


def cone_beam(
    source: Volume, centre: tuple[float, float], radius: float, cupping: tuple[float, float] = (-80.0, 0.0)
) -> Volume:
    """The CT as a CBCT would show it: a cylinder along S, `cupping` HU on the axis and at the rim added."""
    x = source.grid.points()
    r = np.hypot(x[..., 0] - centre[0], x[..., 1] - centre[1])
    hu = source.hu + np.interp(r, [0.0, radius], cupping)
    return Volume(np.where(r <= radius, hu, -1000.0).astype(np.float32), source.ras_from_ijk)
