"""Children and large persons: an adult's chest in a unit of length of its own, seen by a scanner that is as it is."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from numpy.typing import NDArray

from phantoms.cbct import Scanner
from phantoms.spec import PhantomSpec
from phantoms.voxels import Image, Region

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


def scaled_region(region: Region, factor: float) -> Region:
    """The same part of space that is `factor` times as large."""
    return Region(region.inside, _larger(region.ras_from_ijk, factor))


def _larger(affine: Array, factor: float) -> Array:
    out = affine.copy()
    out[:3] *= factor
    return out
