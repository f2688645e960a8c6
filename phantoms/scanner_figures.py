"""How an image of a scanner differs from what it shows: densities by radius, noise and its grain, end slices."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phantoms.voxels import Image

Array = NDArray[Any]
TISSUES = {"gas": (-1001.0, -985.0), "lung": (-960.0, -500.0), "soft tissue": (0.0, 90.0)}
"""What counts as which tissue in the noise-free image, HU."""
RINGS = ((0.0, 0.5), (0.5, 0.8), (0.8, 0.95))
"""Distances from the axis over the radius of the field of view."""


def scanner_figures(clean: Image, shots: tuple[Image, Image], fov: float, end_mm: float = 12.0) -> dict[str, float]:
    """Errors of two exposures of one scene, by name. clean: the scene, HU; fov: mm; end_mm: what end slices are.

    Errors in HU are medians, 2 mm and more inside a tissue; noise is that of the exposures' difference; grain: mm at
    which its correlation falls to one half, in a slice and across slices.
    """
    h = clean.grid.spacing
    i, j, k = ((np.arange(n) - (n - 1) / 2) * s for n, s in zip(clean.hu.shape, h, strict=True))
    share = np.hypot(i[:, None], j[None, :])[:, :, None] / (fov / 2)
    level = (k[-1] - np.abs(k))[None, None, :]
    error = (shots[0].hu + shots[1].hu) / 2 - clean.hu
    noise = (shots[0].hu - shots[1].hu) / np.sqrt(2)
    ball = ndimage.distance_transform_edt
    deep = {
        name: ball((clean.hu >= low) & (clean.hu <= high), sampling=h) > 2.0 for name, (low, high) in TISSUES.items()
    }
    middle, ends = level > end_mm, level < end_mm / 2
    out = {}
    for name, inside in deep.items():
        for low, high in RINGS:
            ring = inside & middle & (share >= low) & (share < high)
            out[f"{name}, {low:g} to {high:g} of the radius"] = _median(error[ring])
    seen = share < RINGS[-1][1]
    for name in ("lung", "soft tissue"):
        out[f"noise in {name}"] = float(noise[deep[name] & middle & seen].std())
    out["noise in soft tissue of the end slices"] = float(noise[deep["soft tissue"] & ends & seen].std())
    out["error in soft tissue of the end slices"] = _median(error[deep["soft tissue"] & ends & seen])
    inside = (deep["soft tissue"] | deep["lung"]) & middle & seen
    out["grain in a slice"] = _half_width(noise, inside, 0, h[0])
    out["grain across slices"] = _half_width(noise, inside, 2, h[2])
    return out


def _median(values: Array) -> float:
    return float(np.median(values)) if values.size > 50 else float("nan")


def _half_width(noise: Array, inside: Array, axis: int, step_mm: float) -> float:
    """Distance in mm along an axis at which the correlation of the noise falls to one half."""
    values, known = np.moveaxis(noise, axis, 0), np.moveaxis(inside, axis, 0)
    correlation = [1.0]
    variance = float((values[known] ** 2).mean())
    while correlation[-1] > 0.5 and len(correlation) < 12:
        lag = len(correlation)
        both = known[lag:] & known[:-lag]
        correlation.append(float((values[lag:] * values[:-lag])[both].mean()) / variance)
    above, below = correlation[-2], correlation[-1]
    return step_mm * (len(correlation) - 2 + (above - 0.5) / max(above - below, 1e-9))
