"""Places where an image has a bright or a dark blob: branchings and bends of vessels and airways.

Ref: Lindeberg 1998 (blobs by the Hessian of a smoothed image).
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from registration.volume import Array

LEAST_CURVATURE = 1.0
"""HU per voxel squared; weaker blobs are noise."""


def blobs(hu: Array, inside: Array, sigma: float, cell: int) -> Array:
    """Voxels (n, 3) inside a region that are the strongest blob of their cell.

    hu: (ni, nj, nk), cubic voxels; inside: of that shape, bool; sigma: of the smoothing, cell: width of a cell, both in
    voxels. How strong a blob is tells the weakest of its three curvatures, so that a straight vessel, along which a
    block could slide, is none.
    """
    at = np.argwhere(inside)
    if not len(at):
        return at
    weakest = np.zeros(hu.shape, np.float32)
    curvature = np.linalg.eigvalsh(_hessian(np.asarray(hu, np.float32), sigma)[inside])
    weakest[inside] = np.maximum(np.maximum(-curvature[:, 2], curvature[:, 0]), 0)
    peaks = np.argwhere((weakest > LEAST_CURVATURE) & (weakest == ndimage.maximum_filter(weakest, 3)))
    number = peaks // cell @ np.array([1, 1 << 20, 1 << 40])
    order = np.argsort(-weakest[tuple(peaks.T)], kind="stable")
    first = np.unique(number[order], return_index=True)[1]
    return peaks[np.sort(order[first])]


def _hessian(hu: Array, sigma: float) -> Array:
    """Second derivatives (ni, nj, nk, 3, 3) of an image smoothed by `sigma` voxels, per voxel squared."""
    hessian = np.empty((*hu.shape, 3, 3), np.float32)
    for a in range(3):
        for b in range(a, 3):
            order = [0, 0, 0]
            order[a] += 1
            order[b] += 1
            hessian[..., a, b] = hessian[..., b, a] = ndimage.gaussian_filter(hu, sigma, order=order)
    return hessian
