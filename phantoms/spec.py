"""What phantoms there are: named choices of side, collapse, nodule, voxels and scanner."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from phantoms.cbct import Scanner


@dataclass(frozen=True)
class PhantomSpec:
    """What to make. side: operated; ct_spacing, cbct_spacing: mm; inflated, deflated: lung volume over that in the CT;
    dome_rise: mm the diaphragm rises further when the lung collapses; element: mm between nodes of the
    lung's map; patchiness: factor on how uneven the tissue is; nodule_depth, nodule_radius: mm."""

    name: str
    side: str
    ct_spacing: tuple[float, float, float] = (1.2, 1.2, 1.5)
    cbct_spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)
    cbct_length: float = 170.0
    inflated: float = 0.87
    deflated: float = 0.52
    dome_rise: float = 8.0
    element: float = 15.0
    patchiness: float = 1.0
    nodule_depth: float = 15.0
    nodule_radius: float = 8.0
    scanner: Scanner = field(default_factory=Scanner)


_SMALL = PhantomSpec("small", "right", (1.5, 1.5, 2.0), (1.5, 1.5, 1.5), element=18.0)
SPECS = {
    s.name: s
    for s in (
        replace(_SMALL, name="demo", inflated=0.89, deflated=0.55, patchiness=0.6),
        replace(_SMALL, name="small-right"),
        replace(_SMALL, name="small-left", side="left"),
        PhantomSpec("right", "right"),
        PhantomSpec("left", "left", inflated=0.83, nodule_depth=25.0),
        PhantomSpec("small-collapse", "right", deflated=0.64, dome_rise=0.0),
        PhantomSpec("near-total-collapse", "left", deflated=0.42, dome_rise=12.0),
        PhantomSpec("high-diaphragm", "right", dome_rise=20.0, nodule_depth=10.0),
        PhantomSpec("poor-dose", "left", scanner=Scanner(noise=60.0, blur=0.9), nodule_radius=6.0),
    )
}
