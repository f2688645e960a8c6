"""Synthetic cases with known truth, written as case folders: phantoms, digital twins of a scan, and a breath of one.

`write_phantom` makes a thorax from a seed, `write_twin` collapses a lung of a given scan, `write_series` lets it
breathe. Names are imported on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vatsloc.lazy import on_first_use

if TYPE_CHECKING:
    from vatsloc.synthetic.case import read_info, read_scan, twin_spec, write_phantom, write_twin
    from vatsloc.synthetic.series import write_series

__all__ = ["read_info", "read_scan", "twin_spec", "write_phantom", "write_series", "write_twin"]

__getattr__ = on_first_use(
    {
        "vatsloc.synthetic.case": ("read_info", "read_scan", "twin_spec", "write_phantom", "write_twin"),
        "vatsloc.synthetic.series": ("write_series",),
    }
)
