"""The slice viewer's pictures: every plane of the fixed and the warped image, rendered beforehand."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from registration.volume import Array
from vatsloc.report.data import Comparison
from vatsloc.report.paint import grey, jpeg
from vatsloc.report.planes import AXES, EDGE_LETTERS, Plane, box_of, plane_through, sample

SLICES = 40
LARGEST_PIXELS = 256


@dataclass(frozen=True)
class Stack:
    """One plane's slices from first to last. images: data URIs of the fixed and moving image."""

    plane: Plane
    positions_mm: Array
    start: int
    fixed: list[str]
    moving: list[str]

    def as_json(self) -> dict[str, Any]:
        """What the viewer's script needs; lengths in mm, RAS."""
        return {
            "name": self.plane.name,
            "axis": AXES[self.plane.name],
            "origin": self.plane.origin.tolist(),
            "right": self.plane.right.tolist(),
            "down": self.plane.down.tolist(),
            "rows": self.plane.shape[0],
            "columns": self.plane.shape[1],
            "positions": [round(float(p), 2) for p in self.positions_mm],
            "start": self.start,
            "edges": EDGE_LETTERS[self.plane.name],
            "fixed": self.fixed,
            "moving": self.moving,
        }


def stacks(comparison: Comparison, window_hu: tuple[float, float]) -> list[Stack]:
    """Axial, coronal and sagittal slices of a phase's fixed and warped image, the nodule's slice among them."""
    box = box_of(comparison.fixed.grid)
    spacing = max(1.0, float((box[1] - box[0]).max()) / LARGEST_PIXELS)
    with ThreadPoolExecutor(max_workers=2) as pool:  # sampling and encoding release the interpreter lock
        return list(pool.map(lambda name: _stack(name, comparison, box, spacing, window_hu), AXES))


def slice_positions(at_mm: float, low_mm: float, high_mm: float, n: int = SLICES) -> tuple[Array, int]:
    """About n evenly spaced positions in [low, high], one of them `at_mm` (clipped to the range), and its index."""
    at = float(np.clip(at_mm, low_mm, high_mm))
    step = max((high_mm - low_mm) / n, 1.0)
    below, above = int((at - low_mm) / step), int((high_mm - at) / step)
    return at + step * np.arange(-below, above + 1), below


def _stack(
    name: str,
    comparison: Comparison,
    box: tuple[Array, Array],
    spacing: float,
    window_hu: tuple[float, float],
) -> Stack:
    axis, centre = AXES[name], comparison.nodule.centre_ras
    positions, start = slice_positions(centre[axis], box[0][axis], box[1][axis])
    planes = [_at(name, centre, p, box, spacing) for p in positions]
    fixed, moving = (
        [jpeg(grey(sample(v, plane), window_hu), 75) for plane in planes] for v in (comparison.fixed, comparison.after)
    )
    return Stack(planes[start], positions, start, fixed, moving)


def _at(name: str, centre: Array, position: float, box: tuple[Array, Array], spacing: float) -> Plane:
    at = np.array(centre, dtype=float)
    at[AXES[name]] = position
    return plane_through(name, at, box, spacing)
