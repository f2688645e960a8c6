"""Shape of a thorax drawn from a seed: body, cage, mediastinum, diaphragm and the two lungs as signed distances.

Frame: RAS mm with x to the patient's right, y forward, z up, z = 0 a little below the carina.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phantoms.fields import Lattice, as_distance, lattice_over, near_distance, smoothstep, soft_max

Array = NDArray[Any]
SPINE_MM = 42.0
"""How far the middle of a vertebral body lies before the back of the cage: lungs reach back beside it."""
TABLE_MM = 16.0
"""Room for the scanner's table below the back."""


@dataclass(frozen=True)
class Build:
    """Measures of one person in mm. width, depth: half axes of the inner cage; apex: top of the lungs; dome: top of the
    diaphragm, (right, left); fat: thickness under the skin, (front, side); heart: centre and half axes, (2, 3);
    spine_bow: depth of the kyphosis; mediastinum: half width of the middle of the chest; breast: how far the breasts
    stand out."""

    width: float
    depth: float
    apex: float
    dome: tuple[float, float]
    fat: tuple[float, float]
    heart: Array
    spine_bow: float
    mediastinum: float
    breast: float = 0.0


@dataclass(frozen=True)
class Shapes:
    """Signed distances (mm, negative inside) of the large organs on one lattice."""

    build: Build
    body: Lattice
    cage: Lattice
    right_lung: Lattice
    left_lung: Lattice
    heart: Lattice
    below_diaphragm: Lattice

    def lung(self, side: str) -> Lattice:
        """The lung on `side`, "right" or "left"."""
        return self.right_lung if side == "right" else self.left_lung


def draw_build(rng: np.random.Generator, habitus: str = "average") -> Build:
    """Measures of a person, drawn within adult variation. habitus: "average", or "obese" with a high diaphragm."""
    obese = habitus == "obese"
    size = rng.uniform(0.94, 1.05)
    dome = -102 * size + rng.uniform(-6, 6) + 16 * obese
    centre = np.array([-20, 31, -68]) * size + rng.uniform(-4, 4, 3)
    radii = np.array([50, 43, 54]) * size * rng.uniform(0.94, 1.06, 3)
    return Build(
        width=124 * size * rng.uniform(0.96, 1.04),
        depth=88 * size * rng.uniform(0.96, 1.06),
        apex=120 * size,
        dome=(dome, dome - rng.uniform(6, 16)),
        fat=(rng.uniform(8, 22) + 16 * obese, rng.uniform(10, 20) + 22 * obese),
        heart=np.stack([centre, radii]),
        spine_bow=rng.uniform(8, 16),
        mediastinum=rng.uniform(24, 30) + 4 * obese,
        breast=float(rng.choice([3.0, 3.0, 26.0, 34.0])),
    )


def spine_y(build: Build, z: Array) -> Array:
    """Front-back position of the centre of the vertebral bodies at height z: a kyphosis."""
    return -build.depth + SPINE_MM + build.spine_bow * (1 - ((z + 20) / 120) ** 2) * -0.6


def cage_axes(build: Build, z: Array) -> tuple[Array, Array, Array]:
    """Half width, half depth and front-back centre of the inner cage at height z."""
    t = np.clip((z + 70) / (build.apex + 70), 0, 0.9999)
    half_x = build.width * (1 - t**2.7) ** 0.45
    half_y = build.depth * (1 - t**2.6) ** 0.42
    return half_x, half_y, -0.13 * np.maximum(z + 70, 0) * smoothstep(z, -70, 0)


def make_shapes(build: Build, spacing: float = 3.0) -> Shapes:
    """Organs of a person on a lattice of `spacing` mm, from below the recesses to above the apices."""
    x_max = build.width + 26 + build.fat[1] + 14
    lower = np.array([-x_max, -build.depth - 58 - TABLE_MM, build.dome[1] - 92])
    upper = np.array([x_max, build.depth + 34 + build.fat[0] + build.breast, build.apex + 16])
    lattice = lattice_over(lower, upper, spacing)
    x, y, z = (a.astype(np.float32) for a in lattice.axes)
    cage = _cage(build, x, y, z)
    heart = _heart(build, x, y, z)
    diaphragm = _diaphragm(build, x, y, z)
    centre = _mediastinum(build, x, y, z)
    # Fat in the angles between heart and diaphragm.
    pad = 1.5 + 9 * smoothstep(-z, 78, 112) * smoothstep(y, 0, 40)
    lungs = []
    for sign in (1, -1):
        phi = soft_max(cage, diaphragm, 5)
        phi = soft_max(phi, -centre, 8)
        phi = soft_max(phi, pad - heart, 6)
        lungs.append(as_distance(lattice, soft_max(phi, np.broadcast_to(1.5 - sign * x, phi.shape), 3)))
    return Shapes(
        build=build,
        body=near_distance(lattice, _body(build, x, y, z)),
        cage=near_distance(lattice, cage),
        right_lung=lungs[0],
        left_lung=lungs[1],
        heart=near_distance(lattice, heart),
        below_diaphragm=near_distance(lattice, -diaphragm),
    )


def _superellipse(x: Array, y: Array, half_x: Array, half_y: Array, power: float) -> Array:
    rho = ((np.abs(x) / half_x) ** power + (np.abs(y) / half_y) ** power) ** (1 / power)
    return (rho - 1) * np.minimum(half_x, half_y)


def _cage(build: Build, x: Array, y: Array, z: Array) -> Array:
    half_x, half_y, centre = cage_axes(build, z)
    side = _superellipse(x, y - centre, half_x, half_y, 2.35)
    top = (z - build.apex) * 0.6 + 0.012 * (np.abs(x) - 42) ** 2 * 0.6
    return soft_max(side, np.broadcast_to(top, side.shape), 12)


def _body(build: Build, x: Array, y: Array, z: Array) -> Array:
    """Skin: flat behind with a furrow over the spine, widest at the shoulder blades, hollow at the armpits, narrower
    and rounder in front, with breasts."""
    _, half_y, centre = cage_axes(build, np.minimum(z, 0.6 * build.apex))
    armpit, shoulder = smoothstep(z, -70, 60), smoothstep(z, 45, 95)
    front_y = centre + half_y + 14 + build.fat[0] + 14 * shoulder
    front_y = front_y + build.breast * np.exp(-(((np.abs(x) - 74) / 36) ** 2) - ((z + 14) / 40) ** 2)
    back_y = np.maximum(spine_y(build, z) - 70 - 0.15 * build.fat[0], -build.depth - 54)
    middle = 0.35 * (centre + half_y + 14 + build.fat[0]) + 0.65 * back_y
    ahead = y > middle
    tapering = (10 + 24 * armpit) * (1 - shoulder) * smoothstep(y, -30, 0.7 * build.depth)
    blades = 7 * smoothstep(z, -90, 10) * np.exp(-(((y + 0.55 * build.depth) / 34) ** 2))
    half_x = build.width + 18 + build.fat[1] + 11 * armpit - tapering + blades
    half_y = np.where(ahead, front_y - middle, middle - back_y)
    power = np.where(ahead, 2.3 + 1.1 * shoulder, 2.6)
    rho = ((np.abs(x) / half_x) ** power + (np.abs(y - middle) / half_y) ** power) ** (1 / power)
    furrow = 4 * np.exp(-((x / 14) ** 2)) * smoothstep(middle - y, 0, 40)
    return (rho - 1) * build.depth + furrow


def _heart(build: Build, x: Array, y: Array, z: Array) -> Array:
    """Ventricles with the apex to the left, forward and down, the right atrium beside and the left one behind them."""
    c, r = build.heart
    dx, dy, dz = x - c[0], y - c[1], z - c[2]
    u = 0.80 * dx - 0.40 * dy + 0.45 * dz
    v = 0.45 * dx + 0.89 * dy
    w = -0.40 * dx + 0.20 * dy + 0.89 * dz
    # Blunt at the valves, pointed at the apex.
    taper = 1 + 0.28 * np.clip(u / r[0], -1.4, 1)
    ventricles = np.sqrt(((u + 8) / (1.18 * r[0])) ** 2 + (v / (0.86 * r[1] * taper)) ** 2 + (w / (0.8 * r[2])) ** 2)
    right = np.sqrt(((dx - 34) / 27) ** 2 + ((dy - 2) / 31) ** 2 + ((dz - 8) / 38) ** 2)
    left = np.sqrt(((dx - 12) / 36) ** 2 + ((dy + 30) / 21) ** 2 + ((dz - 20) / 26) ** 2)
    parts = (1 - ventricles) * 0.8 * r.min(), (1 - right) * 27, (1 - left) * 21
    return -soft_max(soft_max(parts[0], parts[1], 9), parts[2], 9)


def _diaphragm(build: Build, x: Array, y: Array, z: Array) -> Array:
    """Positive below the diaphragm."""
    to_right = smoothstep(x, -35, 30)
    top = build.dome[1] + (build.dome[0] - build.dome[1]) * to_right
    across = np.sqrt(((np.abs(x) - 56) / (build.width - 52)) ** 2 + ((y - 8) / (build.depth + 2)) ** 2)
    outer = (np.abs(x) > 56) | (np.abs(y - 8) > 40)
    drop = np.where(outer, 62, 46) * np.clip(across, 0, 1.15) ** 2.6
    behind = 16 * smoothstep(-y, -10, build.depth)
    surface = top - drop - behind
    return (surface - z) * 0.75


def _mediastinum(build: Build, x: Array, y: Array, z: Array) -> Array:
    """Negative inside the middle of the chest: great vessels and fat, spine, descending aorta, oesophagus."""
    m = build.mediastinum
    half_x = m + 9 * np.exp(-(((z + 6) / 26) ** 2)) - 5 * smoothstep(z, 35, 80)
    # A wedge towards the sternum, and waisted between heart and spine.
    half_x = half_x * (1 - 0.62 * smoothstep(y, -4, 52)) * (1 - 0.35 * smoothstep(-y, 2, 34) * smoothstep(-z, 5, 40))
    half_y = 58 - 22 * smoothstep(z, 20, 90)
    knob = 5 * np.exp(-(((z - 22) / 16) ** 2))
    middle = _superellipse(x + 3 + knob, y - 4 + 14 * smoothstep(z, 0, 100), half_x, half_y, 2.2)
    septum = np.abs(x + 3) - 2.0
    back = spine_y(build, z)
    spine = np.sqrt(x**2 + (y - back) ** 2) - 20
    behind = np.maximum(np.abs(x) - 21, y - back)
    aorta = np.sqrt((x + 21) ** 2 + (y - back - 17) ** 2) - 13 + 20 * smoothstep(z, 25, 45)
    gullet = np.sqrt((x + 3) ** 2 + (y - back - 25) ** 2) - 10
    phi = np.minimum(np.minimum(middle, septum), np.minimum(spine, aorta))
    return np.minimum(np.minimum(phi, behind), gullet)
