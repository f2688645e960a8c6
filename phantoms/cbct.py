"""A cone-beam scanner in the image domain: field of view, blur, cupping, truncation rim, noise, bad end slices."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phantoms.fields import refine, smoothstep
from phantoms.voxels import Grid, Image

Array = NDArray[Any]
OUTSIDE_HU = -1000.0


@dataclass(frozen=True)
class Flaws:
    """What is wrong with a C-arm's scan. scatter: share of the photons lost by a ray that its correction leaves, below
    zero where it takes off too many; heart: mm that the heart's wall moves by while it beats; ports: steel trocars in
    the wall when the lung is collapsed; gain, offset: an image of the density d (HU) reads
    gain * (d + 1000) - 1000 + offset."""

    scatter: float = 0.03
    heart: float = 5.0
    ports: int = 0
    gain: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Scanner:
    """Cone-beam scanner. fov: mm diameter; length: mm it shows along the patient; blur: mm standard deviation;
    cupping: share of the signal lost in the middle; rim: share gained at the edge of the field of view; noise: HU;
    end: mm of bad slices at either end; domain: "image" for artefacts of those sizes, "projection" for a C-arm of that
    field of view and dose with its own artefacts; flaws: of the latter."""

    fov: float = 240.0
    length: float = 170.0
    blur: float = 0.9
    cupping: float = 0.06
    rim: float = 0.10
    noise: float = 21.0
    end: float = 12.0
    domain: str = "image"
    flaws: Flaws = field(default_factory=Flaws)


def scanner_grid(centre: Array, spacing: tuple[float, float, float], length_mm: float, fov_mm: float = 240.0) -> Grid:
    """Voxels of a field of view about `centre` (mm), axes to the left, back and top of the patient."""
    n = [max(round(s / h), 2) for s, h in zip((fov_mm, fov_mm, length_mm), spacing, strict=True)]
    step = np.array([-spacing[0], -spacing[1], spacing[2]])
    affine = np.diag([*step, 1.0])
    affine[:3, 3] = centre - step * (np.array(n) - 1) / 2
    return Grid((n[0], n[1], n[2]), affine)


def expose(clean: Image, scanner: Scanner, rng: np.random.Generator) -> Image:
    """Image that the scanner makes of `clean` (HU, on the scanner's own grid)."""
    grid = clean.grid
    h = grid.spacing
    i, j, k = ((np.arange(n) - (n - 1) / 2) * s for n, s in zip(grid.shape, h, strict=True))
    radius = np.sqrt(i[:, None] ** 2 + j[None, :] ** 2).astype(np.float32)[:, :, None]
    share = np.minimum(radius / (scanner.fov / 2), 1)
    signal = ndimage.gaussian_filter(clean.hu.astype(np.float32) + 1000, scanner.blur / h)
    signal *= (
        1 - scanner.cupping * (1 - share**2) + scanner.rim * smoothstep(radius, 0.9 * scanner.fov / 2, scanner.fov / 2)
    )
    bad = smoothstep(np.abs(k), k[-1] - scanner.end, k[-1] + h[2]).astype(np.float32)[None, None, :]
    shade = ndimage.uniform_filter1d(signal, max(int(10 / h[0]), 1), axis=0)
    signal += bad * (0.8 * shade + 20 - signal)
    signal += _grain(grid, rng) * scanner.noise * (1.15 - 0.45 * share**2) * (1 + 1.5 * bad)
    hu = signal - 1000
    hu = np.where(radius <= scanner.fov / 2, np.clip(hu, -1024, 3071), OUTSIDE_HU)
    return Image(np.ascontiguousarray(hu, dtype=np.float32), clean.ras_from_ijk)


def _grain(grid: Grid, rng: np.random.Generator) -> Array:
    """Noise of unit variance, as grainy as filtered back-projection: wider in a slice than along, weakly coarse."""
    white = rng.standard_normal(grid.shape, dtype=np.float32)
    fine = ndimage.gaussian_filter(white, np.array([1.1, 1.1, 0.5]) / grid.spacing, truncate=3)
    small = rng.standard_normal([n // 6 + 2 for n in grid.shape], dtype=np.float32)
    coarse = refine(small, 6, grid.shape)
    return 0.95 * fine / fine.std() + 0.3 * coarse / coarse.std()
