"""Children and large persons: an adult's chest in a unit of length of its own, seen by a scanner that is as it is."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from phantoms.cbct import Scanner
from phantoms.spec import PhantomSpec
from phantoms.voxels import Image, Region

if TYPE_CHECKING:
    from phantoms.case import PhantomCase

Array = NDArray[Any]


def body_units(spec: PhantomSpec) -> PhantomSpec:
    """The phantom with what is in mm of the person divided by his size: voxels, view, nodule, scanner."""
    s = spec.size
    x, y, z = (h / s for h in spec.ct_spacing)
    i, j, k = (h / s for h in spec.cbct_spacing)
    across, back, up = (v / s for v in spec.view)
    lesion = replace(spec.lesion, depth=spec.lesion.depth / s, radius=spec.lesion.radius / s)
    scanner = scanner_of_size(spec.scanner, 1 / s)
    view = (across, back, up)
    return replace(spec, ct_spacing=(x, y, z), cbct_spacing=(i, j, k), view=view, lesion=lesion, scanner=scanner)


def scanner_of_size(scanner: Scanner, factor: float) -> Scanner:
    """The scanner with its lengths times a factor."""
    flaws = replace(scanner.flaws, heart=scanner.flaws.heart * factor)
    return replace(
        scanner,
        fov=scanner.fov * factor,
        length=scanner.length * factor,
        blur=scanner.blur * factor,
        end=scanner.end * factor,
        flaws=flaws,
    )


def scaled(image: Image, factor: float) -> Image:
    """The same voxels in space that is `factor` times as large."""
    return Image(image.hu, _larger(image.ras_from_ijk, factor))


def resized(case: PhantomCase, spec: PhantomSpec) -> PhantomCase:
    """A case in units of the person's size (see `body_units`) in mm, with the spec that it was made from."""
    s = spec.size
    if s == 1:
        return case
    regions = {name: _larger_region(m, s) for name, m in case.masks.items()}
    info = {k: (np.array(v) * s).tolist() if k.endswith("_mm") else v for k, v in case.info.items()}
    info["pose"] = [(np.array(pose) * np.array([1.0, 1.0, 1.0, s])).tolist() for pose in case.info["pose"]]
    for pose in info["pose"]:
        pose[3][3] = 1.0
    return replace(
        case,
        spec=spec,
        ct=scaled(case.ct, s),
        cbct_inflated=scaled(case.cbct_inflated, s),
        cbct_deflated=scaled(case.cbct_deflated, s),
        nodule=_larger_region(case.nodule, s),
        nodule_ct=case.nodule_ct * s,
        nodule_inflated=case.nodule_inflated * s,
        nodule_deflated=case.nodule_deflated * s,
        landmarks_ct=case.landmarks_ct * s,
        landmarks_inflated=case.landmarks_inflated * s,
        landmarks_deflated=case.landmarks_deflated * s,
        dense_truth=case.dense_truth * s,
        masks=regions,
        info=info,
    )


def _larger_region(region: Region, factor: float) -> Region:
    return Region(region.inside, _larger(region.ras_from_ijk, factor))


def _larger(affine: Array, factor: float) -> Array:
    out = affine.copy()
    out[:3] *= factor
    return out
