"""What the images show: lungs, airways, spine, the scanner's field of view, and the air around a collapsed lung.

`segment_lungs`, `segment_spine` and `find_hilum` read a CT; `prepare_cbct` cleans a cone-beam CT and finds its field of
view; `inflated_lung` and `find_pneumothorax` segment the lung in the two states, `deflated_surface` places points on
its border. Names are imported on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vatsloc.lazy import on_first_use

if TYPE_CHECKING:
    from vatsloc.imaging.cbct import PreparedCbct, prepare_cbct
    from vatsloc.imaging.hilum import find_hilum
    from vatsloc.imaging.lungs import Lungs, segment_lungs
    from vatsloc.imaging.pleura import find_pneumothorax
    from vatsloc.imaging.spine import segment_spine
    from vatsloc.imaging.surface import SurfacePoints, deflated_surface
    from vatsloc.imaging.thorax import inflated_lung

__all__ = [
    "Lungs",
    "PreparedCbct",
    "SurfacePoints",
    "deflated_surface",
    "find_hilum",
    "find_pneumothorax",
    "inflated_lung",
    "prepare_cbct",
    "segment_lungs",
    "segment_spine",
]

__getattr__ = on_first_use(
    {
        "vatsloc.imaging.cbct": ("PreparedCbct", "prepare_cbct"),
        "vatsloc.imaging.hilum": ("find_hilum",),
        "vatsloc.imaging.lungs": ("Lungs", "segment_lungs"),
        "vatsloc.imaging.pleura": ("find_pneumothorax",),
        "vatsloc.imaging.spine": ("segment_spine",),
        "vatsloc.imaging.surface": ("SurfacePoints", "deflated_surface"),
        "vatsloc.imaging.thorax": ("inflated_lung",),
    }
)
