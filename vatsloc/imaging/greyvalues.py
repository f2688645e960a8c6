"""Grey values of a chest image made Hounsfield units where they clearly are not: air and soft tissue are its two fixed
points.

C-arm volumes come as 0 to 4095, HU + 1000, attenuation or [0, 1]. What is in HU already is left as it is, bit for bit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from registration.volume import Array, Volume
from vatsloc.errors import InputRefused
from vatsloc.imaging.lattice import working_copy

AIR_HU, TISSUE_HU = -1000.0, 40.0
MAX_AIR_HU, MIN_PADDING_HU = -500.0, -3100.0
"""Between these lies the lowest percent of the voxels of a chest image in HU, fill value left out."""
LEAST_TISSUE_SHARE = 0.05
"""Share of the voxels within 300 HU of water that every chest image in HU has."""
LEAST_FILL_SHARE = 0.02
SPACING_MM = 2.0
FLAT = 0.15
"""Range of a voxel's neighbours, as a share of the distance between dark and bright, up to which it counts as flat."""
LEAST_PEAK = 2e-3
LEAN_BESIDE_FAT = 0.25
"""Height of the lean tissue's peak beside that of fat, at least."""
LEAST_LUNG_ABOVE_AIR = 0.06
LEAST_BONE = 0.1
"""How far bone lies above soft tissue, at least, as a share of what soft tissue lies above air."""


@dataclass(frozen=True)
class Calibration:
    """hu = slope value + intercept. air, tissue: grey values taken for -1000 and 40 HU, None where it was stated."""

    slope: float
    intercept: float
    air: float | None = None
    tissue: float | None = None

    def of(self, grey: Array) -> Array:
        """HU of grey values, float32."""
        return np.asarray(grey * np.float32(self.slope) + np.float32(self.intercept), dtype=np.float32)

    def entry(self) -> dict[str, float | None]:
        """For run.json."""
        return {"slope": self.slope, "intercept": self.intercept, "air": self.air, "tissue": self.tissue}


def in_hu(image: Volume) -> bool:
    """Whether the values are HU: the darkest is air, and there is tissue about water; what fills the corners does not
    count.
    """
    lowest, _, tissue = _range(image.hu, fill_value(image.hu))
    return MIN_PADDING_HU <= lowest <= MAX_AIR_HU and tissue >= LEAST_TISSUE_SHARE


def may_be_hu(image: Volume) -> bool:
    """Whether an image that shows no air but that of its corners can be HU: that reads -1000, all else as tissue."""
    fill = fill_value(image.hu)
    if fill is None or abs(fill - AIR_HU) > 100:
        return False
    _, highest, tissue = _range(image.hu, fill)
    return tissue >= LEAST_TISSUE_SHARE and highest < 700 and not 0 < highest <= 5


def _range(values: Array, fill: float | None) -> tuple[float, float, float]:
    """Lowest and highest percent of what was not filled, and the share of it within 300 of 0."""
    thin = values[::4, ::4, ::4]
    content = thin if fill is None else thin[thin != fill]
    if content.size == 0:
        return 0.0, 0.0, 0.0
    lowest, highest = np.percentile(content, (1, 99))
    return float(lowest), float(highest), float(np.mean(np.abs(content) < 300))


def fill_value(values: Array) -> float | None:
    """The value that a scanner wrote where it saw nothing: at half of the corners and in 2 % of the voxels, exactly."""
    corners = values[:: values.shape[0] - 1 or 1, :: values.shape[1] - 1 or 1, :: values.shape[2] - 1 or 1].ravel()
    found, count = np.unique(corners, return_counts=True)
    fill = float(found[count.argmax()])
    if 2 * count.max() < corners.size or np.mean(values[::3, ::3, ::3] == fill) < LEAST_FILL_SHARE:
        return None
    return fill


def calibrate(image: Volume) -> Calibration:
    """The linear map that takes the peak of air to -1000 HU and that of lean soft tissue to 40 HU.

    Raises InputRefused with the reason where the two are not seen.
    """
    air, tissue = peaks(image)
    if not -0.15 * (tissue - air) <= air <= 0.75 * tissue:
        raise InputRefused("the darker of its two tissues is too bright for air")
    slope = (TISSUE_HU - AIR_HU) / (tissue - air)
    return Calibration(slope, AIR_HU - slope * air, air, tissue)


def peaks(image: Volume) -> tuple[float, float]:
    """Grey values of air and of lean soft tissue, where the image is homogeneous. Raises InputRefused as `calibrate`.

    Air is the darkest of at least two kinds of dark tissue, soft tissue the brighter of lean and fat; bone is brighter.
    """
    content, flat = _content(image)
    level = _parting(content)
    dark, bright = float(content[content < level].mean()), float(content[content >= level].mean())
    homogeneous = content[flat < FLAT * (bright - dark)]
    tissue = _uppermost(homogeneous[homogeneous >= level], bright - dark)
    below = homogeneous[homogeneous < level]
    air = _lowest(below, bright - dark)
    span = tissue - air
    lung = content[content < level]
    if np.mean(lung > air + LEAST_LUNG_ABOVE_AIR * span) < 0.05:
        raise InputRefused("it shows air or lung, but not both")
    if np.mean(below < air - 2 * LEAST_LUNG_ABOVE_AIR * span) > 1e-3:
        raise InputRefused("air cannot be told from lung")
    if (float(np.percentile(content, 99.9)) - tissue) / span < LEAST_BONE:
        raise InputRefused("nothing is brighter than soft tissue as bone is")
    return air, tissue


def calibrated(image: Volume, by: Calibration) -> Volume:
    """`image` in HU, what fills its corners set to air."""
    fill = fill_value(image.hu)
    hu = by.of(image.hu)
    if fill is not None:
        hu[image.hu == fill] = AIR_HU
    return Volume(hu, image.ras_from_ijk)


def _content(image: Volume) -> tuple[Array, Array]:
    """Values (n,) on 2 mm voxels that lie off what was filled, and the range of the 27 about each.

    Single voxels of the fill value are none: clipped air holds many.
    """
    work = working_copy(image, SPACING_MM)
    fill = fill_value(image.hu)
    keep = np.ones(work.hu.shape, dtype=bool)
    if fill is not None:
        filled = Volume((image.hu == fill).astype(np.float32), image.ras_from_ijk)
        core = ndimage.minimum_filter(working_copy(filled, SPACING_MM).hu, 3) == 1
        keep = ~ndimage.maximum_filter(core, 7)
    spread = ndimage.maximum_filter(work.hu, 3) - ndimage.minimum_filter(work.hu, 3)
    values = work.hu[keep]
    if values.size < 1000 or float(values.max()) <= float(values.min()):
        raise InputRefused("it is constant but for what fills its corners")
    return values.astype(float), spread[keep].astype(float)


def _parting(values: Array) -> float:
    """Level between what is dark and what is bright. Ref: Otsu 1979."""
    low, high = np.percentile(values, (0.2, 99.5))
    counts, edges = np.histogram(values, bins=256, range=(low, high if high > low else low + 1.0))
    middle = (edges[:-1] + edges[1:]) / 2
    below = np.cumsum(counts) / max(int(counts.sum()), 1)
    moment = np.cumsum(counts * middle) / max(int(counts.sum()), 1)
    inner = slice(0, -1)
    between = (moment[-1] * below[inner] - moment[inner]) ** 2 / np.maximum(below[inner] * (1 - below[inner]), 1e-9)
    level = float(edges[1:][inner][int(between.argmax())])
    if not (values < level).any() or not (values >= level).any():
        raise InputRefused("it has one peak of grey values")
    return level


def _modes(values: Array, contrast: float) -> tuple[Array, Array]:
    """Places and heights of the peaks of a histogram with bins of 1 % of the contrast, smoothed."""
    step = contrast / 100
    edges = np.arange(values.min() - 5.5 * step, values.max() + 5.5 * step, step)
    counts = np.histogram(values, bins=edges)[0].astype(float)
    smooth = ndimage.gaussian_filter1d(counts, 1.5)
    at = np.flatnonzero((smooth[1:-1] > smooth[:-2]) & (smooth[1:-1] >= smooth[2:])) + 1
    centres = []
    for n in at:
        near = values[np.abs(values - (edges[n] + step / 2)) < 2 * step]
        centres.append(float(near.mean()) if near.size else float(edges[n] + step / 2))
    return np.array(centres), smooth[at]


def _uppermost(values: Array, contrast: float) -> float:
    """Lean soft tissue: the brightest peak not much lower than the highest, which may be that of fat."""
    if values.size < 100:
        raise InputRefused("it shows no soft tissue")
    place, height = _modes(values, contrast)
    return float(place[height >= LEAN_BESIDE_FAT * height.max()][-1])


def _lowest(values: Array, contrast: float) -> float:
    """Air: the darkest peak that is no mere ripple."""
    if values.size < 100:
        raise InputRefused("it shows no air")
    place, height = _modes(values, contrast)
    return float(place[height >= max(LEAST_PEAK * height.max(), 3.0)][0])
