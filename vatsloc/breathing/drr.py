"""Digitally reconstructed radiographs: what a point source and a flat detector see of a CT.

Joseph's method: a ray is sampled once in every layer across its main direction, bilinearly, and weighted by its length.
Ref: Joseph 1982.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from registration.volume import Array, Volume

WATER_PER_MM = 0.02
"""Attenuation of water at the mean energy of the beam."""
VIEWS = {"frontal": 1, "lateral": 0}
"""Axis of RAS along which the beam runs: from back to front, and from the patient's right to the left."""


@dataclass(frozen=True)
class Radiograph:
    """Line integrals (rows, columns), no unit, head up; pixel_mm: on the detector. `place` draws points on it."""

    integrals: Array
    pixel_mm: float
    source: Array
    corner: Array
    across: Array
    up: Array

    def place(self, points: Array) -> Array:
        """Column and row (q, 2) at which points (q, 3) RAS mm appear."""
        beam = np.cross(self.across, self.up)
        ray = points - self.source
        hit = self.source + ray * (((self.corner - self.source) @ beam) / (ray @ beam))[:, None]
        offset = hit - self.corner
        return np.stack([offset @ self.across, -(offset @ self.up)], axis=1) / self.pixel_mm

    def picture(self) -> Array:
        """As a physician sees it: bone light, air dark, (rows, columns) uint8."""
        low, high = np.percentile(self.integrals, [2, 99.5])
        return np.asarray(255 * np.clip((self.integrals - low) / max(high - low, 1e-6), 0, 1) ** 0.8, np.uint8)

    def stored(self) -> Array:
        """Line integrals in thousandths, uint16, as a DICOM secondary capture holds them."""
        return np.asarray(np.clip(np.rint(1000 * self.integrals), 0, 65535), np.uint16)


SOURCE_MM = 1000.0
"""Source to the middle of the image."""
DETECTOR_MM = 400.0
"""Middle of the image to the detector."""


def radiograph(ct: Volume, view: str, pixels: int = 256) -> Radiograph:
    """What a detector `DETECTOR_MM` behind the image's centre sees from a source `SOURCE_MM` before it.

    ct: HU, axes along R, A, S. view: "frontal" or "lateral".
    """
    axis = VIEWS[view]
    grid = ct.grid
    size = np.array(grid.shape) * grid.spacing
    centre = grid.to_ras((np.array(grid.shape) - 1) / 2)
    beam = np.zeros(3)
    beam[axis] = 1.0 if axis == 1 else -1.0
    up = np.array([0.0, 0.0, 1.0])
    # The patient's right on the left of a frontal view; his front on the left of a lateral one.
    across = np.array([-1.0, 0.0, 0.0]) if axis == 1 else np.array([0.0, -1.0, 0.0])
    source = centre - SOURCE_MM * beam
    width = max(size[1 - axis], size[2]) * (SOURCE_MM + DETECTOR_MM) / (SOURCE_MM - size[axis] / 2)
    pixel = float(width / pixels)
    corner = centre + DETECTOR_MM * beam + (pixels - 1) / 2 * pixel * (up - across)
    index = np.arange(pixels)
    targets = corner + pixel * (index[None, :, None] * across - index[:, None, None] * up)
    per_mm = np.ascontiguousarray(WATER_PER_MM * np.maximum(1 + ct.hu / 1000, 0), np.float32)
    start, ends = grid.to_ijk(source), grid.to_ijk(targets)
    integrals = _integrate(per_mm, start, ends.reshape(-1, 3), axis, np.asarray(grid.spacing))
    return Radiograph(integrals.reshape(pixels, pixels), pixel, source, corner, across, up)


@njit(cache=True, parallel=True)
def _integrate(per_mm: Array, source: Array, ends: Array, axis: int, spacing: Array) -> Array:
    out = np.zeros(len(ends), np.float32)
    one, two = (1, 2) if axis == 0 else (0, 2)
    layers = per_mm.shape[axis]
    n1, n2 = per_mm.shape[one], per_mm.shape[two]
    for q in prange(len(ends)):
        ray = ends[q] - source
        length = np.sqrt((ray[0] * spacing[0]) ** 2 + (ray[1] * spacing[1]) ** 2 + (ray[2] * spacing[2]) ** 2)
        step = length / abs(ray[axis])
        total = 0.0
        for layer in range(layers):
            t = (layer - source[axis]) / ray[axis]
            x, y = source[one] + t * ray[one], source[two] + t * ray[two]
            i, j = int(np.floor(x)), int(np.floor(y))
            if i < 0 or j < 0 or i + 1 >= n1 or j + 1 >= n2:
                continue
            a, b = x - i, y - j
            if axis == 0:
                value = (1 - a) * ((1 - b) * per_mm[layer, i, j] + b * per_mm[layer, i, j + 1]) + a * (
                    (1 - b) * per_mm[layer, i + 1, j] + b * per_mm[layer, i + 1, j + 1]
                )
            else:
                value = (1 - a) * ((1 - b) * per_mm[i, layer, j] + b * per_mm[i, layer, j + 1]) + a * (
                    (1 - b) * per_mm[i + 1, layer, j] + b * per_mm[i + 1, layer, j + 1]
                )
            total += value
        out[q] = total * step
    return out
