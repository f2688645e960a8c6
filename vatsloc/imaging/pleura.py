"""The collapsed lung in a deflated CBCT: pleural air, what is left of the lung, and how sure each is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from skimage.segmentation import watershed

from registration.images.filters import gaussian
from registration.images.morphology import bounding_box, close, dilate, erode
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
    """HU half-way between pleural air and lung, and their distance: Otsu's two classes, then their peaks."""
    counts, edges = np.histogram(hu, bins=np.arange(-1030.0, AERATED_HU, 5.0))
    level = (edges[:-1] + edges[1:]) / 2
    share = counts / max(int(counts.sum()), 1)
    below = np.cumsum(share)
    moment = np.cumsum(share * level)
    with np.errstate(divide="ignore", invalid="ignore"):
        between = (moment[-1] * below - moment) ** 2 / (below * (1 - below))
    cut = int(np.nan_to_num(between, posinf=0.0).argmax())
    smooth = ndimage.gaussian_filter1d(counts.astype(float), 2.0)
    dark, bright = level[: cut + 1], level[cut + 1 :]
    if not counts[: cut + 1].any() or not counts[cut + 1 :].any():
        return float(level[0]), 0.0
    air, lung = float(dark[smooth[: cut + 1].argmax()]), float(bright[smooth[cut + 1 :].argmax()])
    trough = smooth[(level > air) & (level < lung)]
    if trough.size == 0 or trough.min() > 0.9 * min(smooth[level == air][0], smooth[level == lung][0]):
        return _beside_one_peak(level, smooth)
    if lung - air < LEAST_CONTRAST_HU and level[smooth.argmax()] == air:
        return _beside_one_peak(level, smooth)
    return (air + lung) / 2, lung - air


def _beside_one_peak(level: Array, counts: Array) -> tuple[float, float]:
    """The same where air alone has a peak, since a diseased lung has every density: the peak's dark flank tells how
    wide air is. A lung that is all there has little beside its peak.
    """
    at = int(counts.argmax())
    air, dark = float(level[at]), counts[: at + 1]
    width = float(np.sqrt(np.average((level[: at + 1] - air) ** 2, weights=dark)))
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
    step = source.ijk_from_ras @ target.ras_from_ijk
    return ndimage.affine_transform(values, np.diag(step[:3, :3]), step[:3, 3], target.shape, order=1, mode="nearest")


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
