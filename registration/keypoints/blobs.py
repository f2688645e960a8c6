"""Places where an image has a bright or a dark blob: branchings and bends of vessels and airways.

Ref: Lindeberg 1998 (blobs by the Hessian of a smoothed image).
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from registration.images.filters import gaussian
from registration.images.morphology import bounding_box
from registration.volume import Array

TRUNCATED = 4.0
"""Standard deviations at which the smoothing is cut off."""
LEAST_CURVATURE = 1.0
"""HU per voxel squared; weaker blobs are noise."""


def blobs(hu: Array, inside: Array, sigma: float, cell: int) -> Array:
    """Voxels (n, 3) inside a region that are the strongest blob of their cell.

    hu: (ni, nj, nk), cubic voxels; inside: of that shape, bool; sigma: of the smoothing, cell: width of a cell, both in
    voxels. How strong a blob is tells the weakest of its three curvatures, so that a straight vessel, along which a
    block could slide, is none.
    """
    if not inside.any():
        return np.zeros((0, 3), int)
    box = bounding_box(inside, np.full(3, int(TRUNCATED * sigma + 0.5) + 1))
    inside = inside[box]
    weakest = np.zeros(inside.shape, np.float32)
    curvature = np.linalg.eigvalsh(_hessian(np.asarray(hu[box], np.float32), sigma, inside))
    weakest[inside] = np.maximum(np.maximum(-curvature[:, 2], curvature[:, 0]), 0)
    peaks = np.argwhere((weakest > LEAST_CURVATURE) & (weakest == ndimage.maximum_filter(weakest, 3)))
    strength = weakest[tuple(peaks.T)]
    peaks += [span.start for span in box]
    number = peaks // cell @ np.array([1, 1 << 20, 1 << 40])
    order = np.argsort(-strength, kind="stable")
    first = np.unique(number[order], return_index=True)[1]
    return peaks[np.sort(order[first])]


def _hessian(hu: Array, sigma: float, inside: Array) -> Array:
    """Second derivatives (n, 3, 3), per voxel squared, at the n voxels inside a region of an image smoothed by `sigma`
    voxels.
    """
    hessian = np.empty((int(inside.sum()), 3, 3), np.float32)
    for a in range(3):
        for b in range(a, 3):
            order = [0, 0, 0]
            order[a] += 1
            order[b] += 1
            smooth = gaussian(hu, sigma, order=order, truncate=TRUNCATED)
            hessian[:, a, b] = hessian[:, b, a] = smooth[inside]
    return hessian
