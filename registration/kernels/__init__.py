"""Compiled loops over arrays, which know nothing of images in space.

`along_axes` multiplies the axes of an array by banded matrices (splines, their adjoints, Gaussian filters); `box_sums`
adds up cubic windows. `registration.kernels.trilinear` and `registration.kernels.correlation` are formulas for other
compiled code: the blend of a cell's eight voxels, and the correlation coefficient from its sums.
"""

from registration.kernels.banded import Banded, along_axes, along_axis
from registration.kernels.box_sums import box_sums

__all__ = ["Banded", "along_axes", "along_axis", "box_sums"]
