"""What a user marks in the images: the nodule, a lung, the collapsed lung's surface; files in, regions on grids out.

`read_nodule` is the one way from any source of a nodule, whatever its format, to a `Nodule`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from registration.images.morphology import bounding_box
from registration.images.resample import resample_mask
from registration.volume import Array, Grid, Mask
from vatsloc.errors import InputRefused
from vatsloc.formats.images import read_region
from vatsloc.formats.markups import read_points
from vatsloc.formats.meshes import Surface, read_surface
from vatsloc.formats.segments import Label
from vatsloc.frames import reorient
from vatsloc.overlap import inside_of

AXES = "LPS"
MAX_POINT_TO_MASK_MM = 10.0
MAX_SPECK_SHARE = 0.1
MAX_NODULE_ML = 250.0
"""A ball 78 mm wide: a mask larger than this is a lung or a tumour of which no point stands for the whole."""
ENOUGH_VOXELS = 100_000
"""To tell where a region lies."""
LEAST_METRES_MM = 0.5
"""A chest in metres lies within half a unit of its frame's origin, where a nodule in millimetres hardly ever does."""
MIN_SURFACE_INSIDE = 0.9
SURFACE_MM = (20.0, 800.0)
"""Between these lies the diagonal of a lung, collapsed or not, or of a part of it worth giving."""


@dataclass(frozen=True)
class Nodule:
    """The target in the CT. centre_ras: (3,) mm; mask: on the CT's grid, or None when only a point is known."""

    centre_ras: Array
    mask: Mask | None


@dataclass(frozen=True)
class NoduleSource:
    """Files that say where the nodule is: a mask, of which `label` chooses a region where it holds several, a point, or
    both. frame: of reference of the CT, "" where none is stated, for regions drawn in DICOM."""

    mask: Path | None = None
    label: Label | Sequence[Label] | None = None
    point: Path | None = None
    frame: str = ""


def read_nodule(source: NoduleSource, ct: Grid, warnings: list[str]) -> Nodule:
    """The nodule of a source on the CT's grid; a point, where there is one, is its centre.

    Appends to `warnings` what was left out. Raises InputRefused for a source without a nodule, several regions without
    a label, a place outside the CT, and a size that is no nodule's.
    """
    mask = centre = None
    if source.mask is not None:
        on_ct = mask_on(source.mask, ct, source.label, "[nodule] label = ... in case.toml", warnings, source.frame)
        mask = _largest_part(on_ct, source.mask, warnings)
        centre = ct.to_ras(np.argwhere(mask.inside).mean(axis=0))
        _check_nodule_size(mask, source.mask)
    if source.point is not None:
        centre = _nodule_point(source, source.point, ct, mask, warnings)
    if centre is None:
        raise ValueError("a nodule needs a mask or a point")
    return Nodule(centre, mask)


def mask_on(
    path: Path, grid: Grid, label: Label | Sequence[Label] | None, ask: str, warnings: list[str], frame: str = ""
) -> Mask:
    """A region of a file on a grid, which it may reach beyond. Raises InputRefused when it lies outside or vanishes."""
    mask = read_region(path, label, ask, grid, frame)
    inside, ras_from_ijk = reorient(mask.inside, mask.ras_from_ijk, AXES)
    mask = Mask(np.ascontiguousarray(inside), ras_from_ijk)
    points = _some_voxels(mask)
    if not inside_of(grid, points.mean(axis=0)):
        raise InputRefused(f"{path} lies outside the CT; draw the mask in the CT's frame.")
    if mask.grid.same_as(grid):
        return mask
    lost = 1 - float(inside_of(grid, points).mean())
    if lost > 0.01:
        warnings.append(f"{path.name}: {100 * lost:.0f} % of the region lies outside the CT and was cut off.")
    # A file cropped to its region ends at the region's own outer voxels: the ramp of membership lies beyond them.
    mask = resample_mask(mask.padded(), grid)
    if not mask.inside.any():
        raise InputRefused(f"{path} is finer than the CT's voxels and falls between them; draw it on the CT's grid.")
    return mask


def read_hint_surface(path: Path, deflated: Grid, warnings: list[str]) -> Surface:
    """Surface of the collapsed lung. Raises InputRefused when its size or place cannot be a lung's in the image."""
    surface = read_surface(path)
    low, high = surface.points_ras.min(axis=0), surface.points_ras.max(axis=0)
    measured = " x ".join(f"{mm:.3g}" for mm in high - low)
    if not SURFACE_MM[0] <= float(np.linalg.norm(high - low)) <= SURFACE_MM[1]:
        raise InputRefused(
            f"{path} measures {measured} mm, which no lung does; save it in millimetres, not metres or centimetres."
        )
    share = float(inside_of(deflated, surface.points_ras).mean())
    if share < MIN_SURFACE_INSIDE:
        centre, image = ((low + high) / 2, deflated.to_ras((np.array(deflated.shape) - 1) / 2))
        raise InputRefused(
            f"{path} has {100 * share:.0f} % of its points inside the deflated CBCT, "
            f"{100 * MIN_SURFACE_INSIDE:.0f} % needed; save it in LPS millimetres of that image "
            f"(it measures {measured} mm, {np.linalg.norm(centre - image):.0f} mm off the image's centre)."
        )
    if not surface.frame_stated:
        warnings.append(f"{path.name} states no frame; LPS was taken.")
    return surface


def one_point(path: Path, warnings: list[str] | None = None) -> Array:
    """The only point of a list, (3,) RAS mm. Raises InputRefused when there are more, or when it reads like metres."""
    points = read_points(path)
    if len(points) != 1:
        raise InputRefused(f"{path} holds {len(points)} points, one needed; keep the nodule's centre.")
    if np.abs(points.ras[0]).max() < LEAST_METRES_MM:
        raise InputRefused(
            f"{path} holds a point at {', '.join(f'{c:g}' for c in points.ras[0])} (RAS), which reads like metres; "
            "save it in millimetres."
        )
    if points.unplaced and warnings is not None:
        warnings.append(f"{path.name}: {', '.join(points.unplaced)} was never placed and was left out.")
    return points.ras[0]


def _some_voxels(mask: Mask) -> Array:
    """Centres (n, 3) RAS mm of a region's voxels, evenly thinned where there are very many: a lung has millions."""
    flat = np.flatnonzero(mask.inside)
    flat = flat[:: len(flat) // ENOUGH_VOXELS + 1]
    return mask.grid.to_ras(np.stack(np.unravel_index(flat, mask.inside.shape), axis=-1).astype(float))


def _nodule_point(source: NoduleSource, path: Path, ct: Grid, mask: Mask | None, warnings: list[str]) -> Array:
    point = one_point(path, warnings)
    if not inside_of(ct, point):
        raise InputRefused(f"{path} lies outside the CT; save the point in the CT's frame.")
    if mask is not None and source.mask is not None:
        apart = np.linalg.norm(ct.to_ras(np.argwhere(mask.inside)) - point, axis=1).min()
        if apart > MAX_POINT_TO_MASK_MM:
            raise InputRefused(
                f"{path} lies {apart:.0f} mm off the nodule mask {source.mask.name}; keep the right one of the two."
            )
    return point


def _largest_part(mask: Mask, path: Path, warnings: list[str]) -> Mask:
    """The connected part that is the nodule; specks are dropped with a warning, a second nodule is refused."""
    about = bounding_box(mask.inside, np.zeros(3))
    labels, n = ndimage.label(mask.inside[about], structure=np.ones((3, 3, 3)))
    if n == 1:
        return mask
    sizes = np.bincount(labels.ravel())[1:]
    largest = int(np.argmax(sizes))
    others = int(sizes.sum() - sizes[largest])
    if others > MAX_SPECK_SHARE * sizes[largest]:
        raise InputRefused(
            f"{path} shows {n} separate regions, the largest of {sizes[largest]} voxels and {others} in others; "
            "keep one nodule per case."
        )
    warnings.append(f"{path.name}: {others} voxels apart from the nodule were left out.")
    inside = np.zeros_like(mask.inside)
    inside[about] = labels == largest + 1
    return Mask(inside, mask.ras_from_ijk)


def _check_nodule_size(mask: Mask, path: Path) -> None:
    ml = float(mask.inside.sum() * mask.grid.spacing.prod()) / 1000
    if ml > MAX_NODULE_ML:
        ijk = np.argwhere(mask.inside)
        extent = (ijk.max(axis=0) - ijk.min(axis=0) + 1) * mask.grid.spacing
        raise InputRefused(
            f"{path} marks {ml:.0f} ml, {' x '.join(f'{mm:.0f}' for mm in extent)} mm, up to {MAX_NODULE_ML:.0f} ml "
            "expected of a nodule; draw the nodule alone, or choose its region by [nodule] label."
        )
