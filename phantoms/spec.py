"""What phantoms there are: named choices of person, side, nodule, collapse, voxels and scanner."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from phantoms.cbct import Scanner


@dataclass(frozen=True)
class Lesion:
    """The nodule. kind: "solid", "part-solid" or "ground-glass"; place: "middle", "apex" or "base" of the lung; depth
    below the pleura and radius: mm."""

    kind: str = "solid"
    place: str = "middle"
    depth: float = 15.0
    radius: float = 8.0


@dataclass(frozen=True)
class Collapse:
    """What happens to the lung between the images. inflated, deflated: volume over that in the CT; dome_rise: mm the
    diaphragm rises further when the lung collapses, negative where insufflated gas pushes it down; shift: mm the
    mediastinum falls; gas: "air" or "co2"; patchiness: factor on how uneven the tissue is; atelectasis: share of the
    lung, behind and below, that has lost its gas before the first cone-beam CT; lobes_apart: deviation of the logarithm
    of the lobes' rest volumes, where one traps gas and another empties; stiffness: factor on the shear modulus; root:
    factor on how firmly the lung's root is held to the mediastinum and on how much stiffer it is than the rest;
    adhesion: radius (mm) of a patch of the lung, out and up, that has grown to the chest wall, as after pleurisy."""

    inflated: float = 0.87
    deflated: float = 0.52
    dome_rise: float = 8.0
    shift: float = 11.0
    gas: str = "air"
    patchiness: float = 1.0
    atelectasis: float = 0.0
    lobes_apart: float = 0.0
    stiffness: float = 1.0
    root: float = 1.0
    adhesion: float = 0.0


@dataclass(frozen=True)
class PhantomSpec:
    """What to make. side: operated; habitus: "average" or "obese"; ct_spacing, cbct_spacing: mm; view: (3,) mm the
    cone-beam CTs' field of view is off its usual place; element: mm between nodes of the lung's map; refused: whether
    the images show too little for an answer; fused: share of the fissures' area where lobes have grown together, 1 for
    a lung in one piece."""

    name: str
    side: str
    habitus: str = "average"
    ct_spacing: tuple[float, float, float] = (1.2, 1.2, 1.5)
    cbct_spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)
    view: tuple[float, float, float] = (0.0, 0.0, 0.0)
    element: float = 15.0
    refused: bool = False
    fused: float = 1.0
    lesion: Lesion = field(default_factory=Lesion)
    collapse: Collapse = field(default_factory=Collapse)
    scanner: Scanner = field(default_factory=Scanner)


_SMALL = PhantomSpec("small", "right", ct_spacing=(1.5, 1.5, 2.0), cbct_spacing=(1.5, 1.5, 1.5), element=18.0)
_CO2 = Collapse(dome_rise=-14.0, shift=18.0, gas="co2")
SPECS = {
    s.name: s
    for s in (
        replace(_SMALL, name="demo", collapse=Collapse(inflated=0.89, deflated=0.55, patchiness=0.6)),
        replace(_SMALL, name="small-right"),
        replace(_SMALL, name="small-left", side="left"),
        PhantomSpec("right", "right", fused=0.5, collapse=Collapse(shift=24.0, lobes_apart=0.1)),
        PhantomSpec(
            "left",
            "left",
            lesion=Lesion(depth=25.0),
            collapse=Collapse(inflated=0.85, deflated=0.46, shift=32.0, patchiness=0.3),
        ),
        PhantomSpec(
            "small-collapse",
            "right",
            fused=0.8,
            collapse=Collapse(deflated=0.64, dome_rise=3.0, shift=24.0, patchiness=0.6),
        ),
        PhantomSpec(
            "near-total-collapse",
            "left",
            fused=0.2,
            collapse=Collapse(deflated=0.40, dome_rise=12.0, shift=30.0, patchiness=0.5, lobes_apart=0.1),
        ),
        PhantomSpec("co2-right", "right", fused=0.3, lesion=Lesion(depth=20.0, radius=6.0), collapse=_CO2),
        PhantomSpec("co2-left", "left", lesion=Lesion(radius=10.0), collapse=replace(_CO2, deflated=0.46, shift=30.0)),
        PhantomSpec(
            "high-diaphragm",
            "right",
            "obese",
            lesion=Lesion(depth=10.0),
            collapse=Collapse(dome_rise=14.0, shift=22.0),
        ),
        PhantomSpec(
            "apex",
            "left",
            view=(0.0, 0.0, 45.0),
            fused=0.4,
            lesion=Lesion(place="apex", depth=12.0, radius=7.0),
            collapse=Collapse(deflated=0.48, shift=29.0),
        ),
        PhantomSpec(
            "base",
            "right",
            fused=0.0,
            lesion=Lesion(place="base", depth=10.0),
            collapse=Collapse(shift=19.0, lobes_apart=0.1),
        ),
        PhantomSpec(
            "ground-glass",
            "right",
            lesion=Lesion("ground-glass", depth=18.0, radius=9.0),
            collapse=Collapse(deflated=0.48, shift=32.0, patchiness=0.4),
        ),
        PhantomSpec(
            "part-solid", "left", fused=0.4, lesion=Lesion("part-solid", radius=11.0), collapse=Collapse(shift=25.0)
        ),
        PhantomSpec(
            "tight-view",
            "left",
            view=(0.0, 0.0, 38.0),
            lesion=Lesion(radius=7.0),
            collapse=Collapse(inflated=0.89, deflated=0.42, dome_rise=14.0, shift=38.0),
            scanner=Scanner(fov=190.0, length=130.0),
        ),
        PhantomSpec(
            "poor-dose",
            "left",
            fused=0.6,
            lesion=Lesion(radius=6.0),
            collapse=Collapse(deflated=0.49, shift=26.0),
            scanner=Scanner(noise=60.0),
        ),
        PhantomSpec("atelectasis", "right", fused=0.5, collapse=Collapse(shift=16.0, atelectasis=0.10)),
        PhantomSpec(
            "too-little-seen",
            "right",
            view=(36.0, 0.0, -44.0),
            refused=True,
            collapse=Collapse(shift=7.0),
            scanner=Scanner(fov=120.0, length=80.0),
        ),
        PhantomSpec(
            "stiff-lung",
            "right",
            collapse=Collapse(
                inflated=0.91, deflated=0.58, dome_rise=14.0, shift=21.0, patchiness=0.3, stiffness=4.0, root=0.01
            ),
        ),
        PhantomSpec(
            "adhesion",
            "left",
            view=(0.0, 0.0, 24.0),
            fused=0.1,
            collapse=Collapse(deflated=0.42, shift=32.0, lobes_apart=0.1, adhesion=28.0),
        ),
    )
}
SUITE = {name: 100 + n for n, name in enumerate(list(SPECS)[3:])}
"""Cases that cover the clinic, by name, and the seed of each one's person."""
