"""The collapsed lung in a deflated CBCT: pleural air, what is left of the lung, and how sure each is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from skimage.segmentation import watershed

from registration.images.filters import gaussian
from registration.images.morphology import bounding_box, close, dilate, erode
from registration.images.resample import resample
from registration.volume import Array, Grid, Mask, Volume
from vatsloc.imaging.airways import TrackedAirways
from vatsloc.imaging.cbct import PreparedCbct
from vatsloc.imaging.lattice import on_grid, working_copy
from vatsloc.imaging.thorax import AERATED_HU, ThoraxPrior, lung_space, working_scene

FINE_MM = 1.0
SMOOTHING_MM = 0.8
SHADING_MM = 12.0
LEAST_AIR_ML = 20.0
LEAST_CONTRAST_HU = 100.0
AIR_WIDTHS = 2.5
"""Standard deviations of air from its peak to the level half-way to the lung, where the lung has no peak."""
LEAST_BESIDE_AIR = 0.25
"""Share of the voxels that lies as far again beyond that level; 6 to 15 % of an inflated lung lie so far from its peak.
"""
CLIPPED_HU, CLIPPED_SHARE = 30.0, 0.01
"""How wide air is where a peak lies nearer to the darkest level than that; share of the voxels at a level that an image
was clipped at."""
AIR_PIECE_ML = 0.5
LUNG_PIECE_ML = 5.0


@dataclass(frozen=True)
class Pneumothorax:
    """What a deflated CBCT shows on the operated side, on one grid of about 1 mm.

    air: pleural air, fissures included; lung: the collapsed lung; space: both together. limit_hu: level between them.
    contrast_hu: lung minus air. is_collapsed: whether there is enough pleural air to trust a surface.
    """

    air: Mask
    lung: Mask
    space: Mask
    image: Volume
    limit_hu: float
    contrast_hu: float
    air_ml: float
    lung_ml: float
    airways: TrackedAirways

    @property
    def is_collapsed(self) -> bool:
        """At least 20 ml of air that is 100 HU darker than the lung."""
        return self.air_ml >= LEAST_AIR_ML and self.contrast_hu >= LEAST_CONTRAST_HU


def find_pneumothorax(cbct: PreparedCbct, prior: ThoraxPrior) -> Pneumothorax:
    """Pleural air and collapsed lung of the operated side. prior: the inflated lung in this CBCT's frame.

    Without pleural air the result says so (`is_collapsed`) and the whole space is lung.
    Ref: Alvarez 2021, section 7.1.1, where this is done by hand.
    """
    work, seen = working_scene(cbct)
    space, airways = lung_space(work, seen, prior)
    whole = working_copy(cbct.volume, FINE_MM)
    whole = Volume(gaussian(whole.hu, SMOOTHING_MM / whole.grid.spacing), whole.ras_from_ijk)
    near = on_grid(dilate(space, 2.5, work.grid.spacing) & seen, work.grid, whole.grid).inside
    box = bounding_box(near, np.full(3, 3)) if near.any() else (slice(0, 1),) * 3
    part = whole.grid.box(np.array([b.start for b in box]), np.array([b.stop for b in box]))
    fine = Volume(whole.hu[box], part.ras_from_ijk)
    aerated = near[box] & (fine.hu < AERATED_HU)
    limit, contrast = air_limit(fine.hu[aerated][::7])
    air = np.zeros(fine.grid.shape, dtype=bool)
    if contrast >= LEAST_CONTRAST_HU:
        air = _pleural_air(fine, aerated, work, space, airways.inside, (limit, contrast))
    lung = _lung_beside(aerated, air, fine.grid, work.grid)
    voxel_ml = float(fine.grid.spacing.prod()) / 1000
    air_ml, lung_ml = (float(m.sum()) * voxel_ml for m in (air, lung))
    masks = [Mask(_put(m, box, whole.grid), whole.ras_from_ijk) for m in (air, lung, air | lung)]
    return Pneumothorax(masks[0], masks[1], masks[2], whole, limit, contrast, air_ml, lung_ml, airways)


def _put(inside: Array, box: tuple[slice, ...], grid: Grid) -> Array:
    out = np.zeros(grid.shape, dtype=bool)
    out[box] = inside
    return out


def _pleural_air(
    fine: Volume, aerated: Array, work: Volume, space: Array, airways: Array, levels: tuple[float, float]
) -> Array:
    """Air on the fine grid: where an edge parts it from the lung on the working grid, sharpened by a local level.

    levels: HU half-way between air and lung, and their distance.
    """
    limit, contrast = levels
    spacing = work.grid.spacing
    tubes = on_grid(dilate(airways, 4.0, spacing), work.grid, fine.grid).inside
    voxel_ml = float(fine.grid.spacing.prod()) / 1000
    sure = _large_pieces(aerated & (fine.hu < limit - 0.4 * contrast), tubes, voxel_ml)
    coarse = _flooded(work, space, on_grid(sure, fine.grid, work.grid).inside, limit)
    level = _upsampled(_local_limit(work, space, coarse, limit, contrast), work.grid, fine.grid)
    dark = (fine.hu < level) & on_grid(dilate(coarse, 2.5, spacing), work.grid, fine.grid).inside
    dark |= on_grid(erode(coarse, 1.5, spacing), work.grid, fine.grid).inside
    return _large_pieces(ndimage.uniform_filter((aerated & dark).astype(np.float32), 3) > 0.5, tubes, voxel_ml)


def air_limit(hu: Array) -> tuple[float, float]:
    """HU half-way between pleural air and lung, and their distance: Otsu's two classes, then their peaks.

    A lung that is still light has a peak not far from air's, and Otsu's level parts it from its own dense tail; then
    the darker class is parted once more.
    """
    counts, edges = np.histogram(hu, bins=np.arange(-1030.0, AERATED_HU, 5.0))
    level = (edges[:-1] + edges[1:]) / 2
    smooth = ndimage.gaussian_filter1d(counts.astype(float), 2.0)
    cut = _otsu(level, counts)
    if not counts[: cut + 1].any() or not counts[cut + 1 :].any():
        return float(level[0]), 0.0
    air, lung, is_parted = _peaks(level, smooth, cut)
    if is_parted and not (lung - air < LEAST_CONTRAST_HU and level[smooth.argmax()] == air):
        return (air + lung) / 2, lung - air
    dark = slice(0, cut + 1)
    air, lung, is_parted = _peaks(level[dark], smooth[dark], _otsu(level[dark], counts[dark]))
    if is_parted and lung - air >= LEAST_CONTRAST_HU:
        return (air + lung) / 2, lung - air
    return _beside_one_peak(level, counts)


def _otsu(level: Array, counts: Array) -> int:
    """Last of the darker of two classes of levels (n,), by their counts (n,). Ref: Otsu 1979."""
    share = counts / max(int(counts.sum()), 1)
    below, moment = np.cumsum(share), np.cumsum(share * level)
    with np.errstate(divide="ignore", invalid="ignore"):
        between = (moment[-1] * below - moment) ** 2 / (below * (1 - below))
    return int(np.nan_to_num(between, posinf=0.0).argmax())


def _peaks(level: Array, smooth: Array, cut: int) -> tuple[float, float, bool]:
    """Level of the highest count (n,) of either class, and whether a trough lies between them."""
    if len(level) < cut + 2:
        return float(level[0]), float(level[-1]), False
    air, lung = int(smooth[: cut + 1].argmax()), cut + 1 + int(smooth[cut + 1 :].argmax())
    trough = smooth[air + 1 : lung]
    is_parted = trough.size > 0 and trough.min() <= 0.9 * min(smooth[air], smooth[lung])
    return float(level[air]), float(level[lung]), bool(is_parted)


def _beside_one_peak(level: Array, counts: Array) -> tuple[float, float]:
    """The same where air alone has a peak, since a diseased lung has every density: the peak's dark flank tells how
    wide air is. A lung that is all there has little beside its peak.

    What was clipped at the darkest level is no peak, and a peak beside it lacks its flank.
    """
    first, counts = int((counts > 0).argmax()), counts.astype(float)
    if counts[first] > CLIPPED_SHARE * counts.sum():
        counts[first] = min(counts[first], counts[min(first + 1, len(counts) - 1)])
    counts = ndimage.gaussian_filter1d(counts, 2.0)
    at = int(counts.argmax())
    air, dark = float(level[at]), counts[: at + 1]
    width = float(np.sqrt(np.average((level[: at + 1] - air) ** 2, weights=dark)))
    if air - level[first] < CLIPPED_HU:
        width = max(width, CLIPPED_HU)
    contrast = 2 * AIR_WIDTHS * width
    beyond = float(counts[level > air + contrast].sum() / counts.sum())
    return air + contrast / 2, contrast if beyond > LEAST_BESIDE_AIR else 0.0


def _flooded(work: Volume, space: Array, sure: Array, limit: float) -> Array:
    """Air on the working grid: what lies between sure air and sure lung goes to either along the steepest edge.

    Shading shifts HU slowly, so that an edge tells better than a level. Ref: Vincent & Soille 1991.
    """
    box = bounding_box(space, np.full(3, 2))
    hu = gaussian(np.clip(work.hu[box], -1024, AERATED_HU), 0.4)
    edge = ndimage.gaussian_gradient_magnitude(hu, 0.6)
    markers = np.where(sure[box], 1, np.where(space[box] & (hu > limit), 2, 0)).astype(np.int32)
    out = np.zeros_like(space)
    out[box] = watershed(edge, markers, mask=space[box]) == 1
    return out


def _local_limit(work: Volume, space: Array, air: Array, limit: float, contrast: float) -> Array:
    """Level between air and lung that follows the shading: half-way between both means, each within about 25 mm."""
    spacing = work.grid.spacing
    lung = space & ~dilate(air, 3.0, spacing) & (work.hu < limit + 0.8 * contrast)
    core = erode(air, 2.0, spacing)
    sums = []
    for part, far in ((core, limit - contrast / 2), (lung, limit + contrast / 2)):
        weight = gaussian(part.astype(np.float32), SHADING_MM / spacing) + 0.01
        total = gaussian(np.where(part, work.hu, 0).astype(np.float32), SHADING_MM / spacing) + 0.01 * far
        sums.append(total / weight)
    return (sums[0] + sums[1]) / 2


def _upsampled(values: Array, source: Grid, target: Grid) -> Array:
    around = source.ras_from_ijk.copy()
    around[:3, 3] = source.to_ras(-np.ones(3))
    return resample(Volume(np.pad(values, 1, mode="edge"), around), target).hu


def _large_pieces(dark: Array, tubes: Array, voxel_ml: float) -> Array:
    """Dark pieces of at least 0.5 ml that are not airways."""
    labels, count = ndimage.label(dark)
    ml = np.bincount(labels.ravel(), minlength=count + 1) * voxel_ml
    in_tubes = np.bincount(labels[tubes], minlength=count + 1) * voxel_ml
    keep = (ml >= AIR_PIECE_ML) & (in_tubes < 0.5 * ml)
    keep[0] = False
    return keep[labels]


def _lung_beside(aerated: Array, air: Array, fine: Grid, coarse: Grid) -> Array:
    """Tissue of the space that is not air, without the thin blurred skin between air and wall.

    Vessels and dense lung between air and aerated lung are closed by a 10 mm ball.
    """
    spacing = coarse.spacing
    tissue = on_grid(aerated & ~air, fine, coarse).inside
    gas = on_grid(air, fine, coarse).inside
    core = erode(tissue, 2.5, spacing)
    labels, count = ndimage.label(core)
    ml = np.bincount(labels.ravel(), minlength=count + 1) * spacing.prod() / 1000
    keep = ml >= LUNG_PIECE_ML / 4
    keep[0] = False
    lung = dilate(keep[labels], 4.5, spacing) & tissue
    closed = ndimage.binary_fill_holes(close(lung | gas, 10.0, spacing)) & ~gas
    body = closed & dilate(lung, 10.0, spacing)
    body = body & dilate(erode(body, 2.5, spacing), 4.5, spacing)
    return on_grid(body | lung, coarse, fine, smooth_mm=1.0).inside & ~air
