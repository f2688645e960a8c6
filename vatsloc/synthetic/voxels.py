"""The border to the phantoms, which have containers of voxels of their own; no voxel is copied."""

from __future__ import annotations

from phantoms.voxels import Image, Region
from registration.volume import Mask, Volume


def to_volume(image: Image) -> Volume:
    """A phantom's image as every other program part knows it."""
    return Volume(image.hu, image.ras_from_ijk)


def to_mask(region: Region) -> Mask:
    """A phantom's region as every other program part knows it."""
    return Mask(region.inside, region.ras_from_ijk)


def to_image(volume: Volume) -> Image:
    """A scan as the phantoms know it."""
    return Image(volume.hu, volume.ras_from_ijk)


def to_region(mask: Mask) -> Region:
    """A mask as the phantoms know it."""
    return Region(mask.inside, mask.ras_from_ijk)
