"""How a phantom is described: person, side, nodule, disease, collapse, voxels and scanner."""

from __future__ import annotations

from dataclasses import dataclass, field

from phantoms.cbct import Scanner


@dataclass(frozen=True)
class Lesion:
    """The nodule. kind: "solid", "part-solid" or "ground-glass"; place: "middle", "apex" or "base" of the lung; depth
    below the pleura and radius: mm; seen: the images that show it, "all", "ct and inflated" or "ct". Where it is not
    seen, lung as around it is: no denser, no stiffer."""

    kind: str = "solid"
    place: str = "middle"
    depth: float = 15.0
    radius: float = 8.0
    seen: str = "all"


@dataclass(frozen=True)
class Collapse:
    """What happens to the lung between the images. inflated, deflated: volume over that in the CT; dome_rise: mm the
    diaphragm rises further when the lung collapses, negative where insufflated gas pushes it down; shift: mm the
    mediastinum falls; gas: "air" or "co2"; patchiness: factor on how uneven the tissue is; atelectasis: share of the
    lung, behind and below, that has lost its gas before the first cone-beam CT; lobes_apart: deviation of the logarithm
    of the lobes' rest volumes, where one traps gas and another empties; stiffness: factor on the shear modulus; root:
    factor on how firmly the lung's root is held to the mediastinum and on how much stiffer it is than the rest;
    adhesion: radius (mm) of a patch of the lung, out and up, that has grown to the chest wall, as after pleurisy;
    airless: share of the collapsed lung that holds no gas, in patches, more where it hangs; vessels: their radii in the
    collapsed lung over those in the CT; fluid: mm that it stands high in the collapsed side."""

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
    airless: float = 0.0
    vessels: float = 1.0
    fluid: float = 0.0


@dataclass(frozen=True)
class Disease:
    """Of the lung's tissue, in the CT already. emphysema: share of the lung that has lost its walls and traps gas;
    fibrosis: share that is scarred, dense and stiff, most near the pleura, behind and below."""

    emphysema: float = 0.0
    fibrosis: float = 0.0


@dataclass(frozen=True)
class PhantomSpec:
    """What to make. side: operated; habitus: "average" or "obese"; ct_spacing, cbct_spacing: mm; view: (3,) mm the
    cone-beam CTs' field of view is off its usual place; element: mm between nodes of the lung's map; refused: whether
    the images show too little for an answer; fused: share of the fissures' area where lobes have grown together, 1 for
    a lung in one piece; size: of the person over an adult's; what else is in mm is of the person as he is."""

    name: str
    side: str
    habitus: str = "average"
    ct_spacing: tuple[float, float, float] = (1.2, 1.2, 1.5)
    cbct_spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)
    view: tuple[float, float, float] = (0.0, 0.0, 0.0)
    element: float = 15.0
    refused: bool = False
    fused: float = 1.0
    size: float = 1.0
    lesion: Lesion = field(default_factory=Lesion)
    disease: Disease = field(default_factory=Disease)
    collapse: Collapse = field(default_factory=Collapse)
    scanner: Scanner = field(default_factory=Scanner)
