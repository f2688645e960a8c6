"""Files to arrays in RAS mm and back: images, masks, markups, transforms, displacement fields and meshes.

A reader refuses what cannot be trusted by InputRefused, and a file that is not there by CaseError. Files for other
programs are written in LPS. Names are imported on first use, so that one format does not load the libraries of all.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vatsloc.lazy import on_first_use

if TYPE_CHECKING:
    from vatsloc.formats.fields import read_field, write_field
    from vatsloc.formats.images import read_mask, read_volume
    from vatsloc.formats.markups import PointList, read_points, write_points
    from vatsloc.formats.meshes import read_surface, read_vtu
    from vatsloc.formats.nifti import write_mask, write_volume

__all__ = [
    "PointList",
    "read_field",
    "read_mask",
    "read_points",
    "read_surface",
    "read_volume",
    "read_vtu",
    "write_field",
    "write_mask",
    "write_points",
    "write_volume",
]

__getattr__ = on_first_use(
    {
        "vatsloc.formats.fields": ("read_field", "write_field"),
        "vatsloc.formats.images": ("read_mask", "read_volume"),
        "vatsloc.formats.markups": ("PointList", "read_points", "write_points"),
        "vatsloc.formats.meshes": ("read_surface", "read_vtu"),
        "vatsloc.formats.nifti": ("write_mask", "write_volume"),
    }
)
