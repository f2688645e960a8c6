"""A received Segmentation over the scan it was made for, as a picture to look at."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydicom.dataset import Dataset

WINDOW_HU = (-1050.0, 250.0)
COLOURS = ("yellow", "red", "dodgerblue")


def in_hu(source: Sequence[Dataset]) -> np.ndarray:
    """Slices of a series, (slices, rows, columns), in the order they are given."""
    return np.stack([ds.pixel_array * float(ds.RescaleSlope) + float(ds.RescaleIntercept) for ds in source])


def draw_overlay(hu: np.ndarray, segments: np.ndarray, voxel_mm: Sequence[float], path: Path) -> Path:
    """Axial and coronal plane through the first segment, all segments outlined.

    hu: (slices, rows, columns); segments: the same with one more axis for nodule, ellipsoid and lung; voxel_mm: between
    slices, rows and columns. Slices are stored from the feet, rows from the front.
    """
    from matplotlib.figure import Figure

    k, j, _ = np.rint(np.argwhere(segments[..., 0]).mean(axis=0)).astype(int)
    planes = ((hu[k], segments[k], voxel_mm[1] / voxel_mm[2]), (hu[:, j], segments[:, j], voxel_mm[0] / voxel_mm[2]))
    figure = Figure(figsize=(10, 5), layout="tight", facecolor="black")
    for axes, (grey, shown, aspect), name in zip(figure.subplots(1, 2), planes, ("axial", "coronal"), strict=True):
        origin = "upper" if name == "axial" else "lower"
        axes.imshow(grey, cmap="gray", vmin=WINDOW_HU[0], vmax=WINDOW_HU[1], aspect=aspect, origin=origin)
        for n, colour in enumerate(COLOURS):
            if shown[..., n].any():
                axes.contour(shown[..., n], levels=[0.5], colors=colour, linewidths=1.0)
        axes.set_title(name, color="white", fontsize=9)
        axes.set_axis_off()
    figure.savefig(path, dpi=130)
    return path
