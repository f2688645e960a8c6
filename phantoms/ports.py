"""Steel trocars in the wall of a collapsed side, as an operation leaves them while the patient is scanned."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from phantoms.imaging import State
from phantoms.trees import draw_tubes
from phantoms.voxels import Image

Array = NDArray[Any]
RADIUS_MM, WALL_MM, INSIDE_MM, OUTSIDE_MM = 5.5, 1.2, 12.0, 70.0
STEEL_HU = 20000.0


def draw_ports(scene: Image, state: State, count: int, up: Array, rng: np.random.Generator) -> None:
    """Paint `count` tubes into a scene (HU), through the wall towards the middle of the room of the collapsed lung.

    up: (3,) unit vector in the frame of the CT; the scene's axes are parallel to RAS.
    """
    cavity = state.cavity
    inside = cavity.points()[cavity.values.ravel() < 0]
    middle = inside.mean(axis=0)
    steel, bore = np.zeros(scene.hu.shape, dtype=np.float32), np.zeros(scene.hu.shape, dtype=np.float32)
    width = float(scene.grid.spacing.mean())
    for _ in range(count):
        way = up + rng.uniform(-0.55, 0.55, 3)
        way /= np.linalg.norm(way)
        line = middle + np.arange(0.0, 200.0)[:, None] * way
        wall = line[np.flatnonzero(cavity.at(line) < 0)[-1]]
        ends = state.posed(np.stack([wall - INSIDE_MM * way, wall + OUTSIDE_MM * way]))[None]
        draw_tubes(steel, scene.grid, ends, np.full((1, 2), RADIUS_MM), width)
        draw_tubes(bore, scene.grid, ends, np.full((1, 2), RADIUS_MM - WALL_MM), width)
    scene.hu[:] = scene.hu + steel * (STEEL_HU * (1 - bore) - 1000 * bore - scene.hu)
