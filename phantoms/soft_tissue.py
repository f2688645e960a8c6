"""Everything of a thorax but bone, lung and vessels: skin, fat, muscles in their layers, mediastinum, heart, belly."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from phantoms.anatomy import Build, Shapes, spine_y
from phantoms.fields import coverage, smooth_noise, smoothstep
from phantoms.voxels import Grid

Array = NDArray[Any]
MUSCLE_HU, FAT_HU = 52.0, -102.0
RIBS_MM = 11.5
"""Depth of the layer of ribs and the muscles between them, outside the inner surface of the cage."""


def image_soft_tissue(shapes: Shapes, grid: Grid, width: float, rng: np.random.Generator) -> Array:
    """HU on `grid` of a person without bones, lungs and vessels; the lungs' place is filled."""
    s, b = shapes, shapes.build
    x, y, z = s.body.axes
    fibres, patches = smooth_noise(s.body, 5.0, rng), smooth_noise(s.body, 9.0, rng)
    muscle = smoothstep(_muscles(shapes, patches), -1.5, 1.5)
    streaks = smoothstep(fibres, 1.3, 1.9)
    wall = MUSCLE_HU + 6 * patches - 130 * streaks
    fat = FAT_HU + 5 * patches
    outside = fat + muscle * (wall - fat)
    middle = FAT_HU + 12 + 110 * smoothstep(patches - 0.012 * y + 0.3 * fibres, 0.9, 1.5)
    middle = middle + (1 - smoothstep(y - spine_y(b, z), -14, -6)) * (MUSCLE_HU - middle)
    below = smoothstep(-s.below_diaphragm.values, -1.5, 1.5)
    inside = middle + below * (_belly(b, x, y, z, patches) - middle)
    inside = inside + smoothstep(-s.heart.values, -1.5, 1.5) * (_heart(shapes, patches) - inside)
    hu = s.body.like(inside + smoothstep(s.cage.values, -1.5, 1.5) * (outside - inside)).on(grid)
    skin = s.body.on(grid)
    hu += coverage(-skin - 2.0, width) * (15 - hu)
    hu += (1 - coverage(skin, width)) * (-1000 - hu)
    return hu


def _muscles(shapes: Shapes, patches: Array) -> Array:
    """How deep (mm) points of the lattice lie inside a muscle of the wall, negative in fat."""
    s, b = shapes, shapes.build
    x, y, z = s.body.axes
    aside, depth, under = np.abs(x), s.cage.values, -s.body.values
    spine = spine_y(b, z)
    between_ribs = RIBS_MM - depth
    level = smoothstep(z, -150, -40)
    # Latissimus and serratus at the side, thicker towards the armpit and there joined by the muscles of the scapula.
    side = smoothstep(aside, 40, 80) * (1 - smoothstep(y, 5, 55))
    flank = (7 + 9 * level + 22 * smoothstep(z, -10, 70)) * side
    # Pectorals in front, from the second rib to the sixth.
    front = smoothstep(aside, 14, 34) * (1 - smoothstep(aside, 0.72 * b.width, 0.98 * b.width)) * smoothstep(y, 15, 50)
    chest = 17 * smoothstep(z, -62, -8) * front
    outer = np.maximum(flank, chest) + 1.5 * patches
    layer = np.minimum(depth - RIBS_MM - 2.5, RIBS_MM + 2.5 + outer - depth)
    layer = np.where(outer > 2.5, layer, -5.0)
    # The long muscles of the back beside the spine, and trapezius over them.
    back = np.minimum(np.minimum(58 + 3 * patches - aside, aside - 3), spine - 12 - y)
    cover = b.fat[1] + (b.fat[0] - b.fat[1]) * smoothstep(y, -20, 60)
    cover = np.where(y < spine, 0.45 * cover + 3, cover)
    return np.minimum(np.maximum(np.maximum(between_ribs, layer), back), under - 0.6 * cover)


def _heart(shapes: Shapes, patches: Array) -> Array:
    """HU of the heart: muscle and blood with fat on it, most in the furrow between atria and ventricles."""
    b = shapes.build
    x, y, z = shapes.body.axes
    depth = -shapes.heart.values
    rind = (1 - smoothstep(depth, 2, 6)) * smoothstep(patches, -0.6, 0.8)
    along = -0.80 * (x - b.heart[0, 0]) + 0.40 * (y - b.heart[0, 1]) - 0.45 * (z - b.heart[0, 2])
    furrow = np.exp(-(((along + 8 + 5 * patches) / 5) ** 2)) * (1 - smoothstep(depth, 8, 18))
    return 38 + 3 * patches - 118 * np.maximum(rind, furrow)


def _belly(build: Build, x: Array, y: Array, z: Array, patches: Array) -> Array:
    fat = -98 + 4 * patches
    top = build.dome[1]
    liver = smoothstep(x + 0.35 * (y - 20) - 0.25 * (z - top), -38, -30)
    spleen = 1 - np.sqrt(((x + 88) / 36) ** 2 + ((y + 42) / 45) ** 2 + ((z - top + 42) / 46) ** 2)
    stomach = 1 - np.sqrt(((x + 58) / 40) ** 2 + ((y - 28) / 38) ** 2 + ((z - top + 44) / 38) ** 2)
    gas = smoothstep(stomach, 0.08, 0.14) * smoothstep(y, 38, 41)
    hu = fat + liver * (58 + 4 * patches - fat)
    hu = hu + smoothstep(spleen, 0, 0.05) * (50 - hu)
    hu = hu + smoothstep(stomach, 0, 0.05) * (28 - hu)
    return hu + gas * (-985 - hu)
