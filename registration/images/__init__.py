"""Images and masks on grids: interpolated, seen through maps, coarsened, dilated.

`interpolate` reads an image at points; `resample` and `resample_mask` show it through a map on another grid; `coarsen`
smooths as much as the new voxels ask for, and `Pyramid` does so for a pair of images; `dilate` and `erode` measure in
millimetres.
"""

from registration.images.interpolate import interpolate
from registration.images.morphology import bounding_box, dilate, erode
from registration.images.pyramid import Pyramid, Samples
from registration.images.resample import coarsen, resample, resample_mask

__all__ = [
    "Pyramid",
    "Samples",
    "bounding_box",
    "coarsen",
    "dilate",
    "erode",
    "interpolate",
    "resample",
    "resample_mask",
]
