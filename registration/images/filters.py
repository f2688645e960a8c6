"""Gaussian filters in half the processor time of scipy's, shared by all threads."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from registration.kernels.banded import Banded, along_axis
from registration.volume import Array


def gaussian(
    voxels: Array, sigma: ArrayLike, order: ArrayLike = 0, mode: str = "reflect", truncate: float = 4.0
) -> Array:
    """What scipy.ndimage.gaussian_filter makes of voxels (ni, nj, nk), in single precision.

    sigma: standard deviation in voxels, or (3,) one for each axis; order: of the derivative, likewise; mode: how the
    image goes on beyond its border; truncate: where the filter ends, in standard deviations.
    """
    sigmas, orders = np.broadcast_to(sigma, 3), np.broadcast_to(order, 3)
    image = np.asarray(voxels, np.float32)
    for axis, n in enumerate(image.shape):
        if sigmas[axis] > 0:
            matrix = _matrix(n, float(sigmas[axis]), int(orders[axis]), mode, truncate)
            image = along_axis(image[None], axis + 1, matrix)[0]
    return image


@lru_cache(maxsize=32)
def _matrix(n: int, sigma: float, order: int, mode: str, truncate: float) -> Banded:
    """The filter along an axis of n voxels."""
    return Banded(ndimage.gaussian_filter1d(np.eye(n), sigma, 0, order, mode=mode, truncate=truncate))
