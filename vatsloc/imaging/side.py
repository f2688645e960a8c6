"""Which lung was operated on: the one that holds the nodule in the CT, and the one beside which the deflated cone-beam
CT shows pleural gas.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from registration.images.morphology import dilate, distances_to, erode
from registration.volume import Array, Mask, Volume
from vatsloc.errors import InputRefused
from vatsloc.imaging.cbct import PreparedCbct, prepare_cbct
from vatsloc.imaging.lattice import on_grid, working_copy
from vatsloc.imaging.lungs import Side, lung_halves, nodule_voxels
from vatsloc.imaging.spine import Spine, segment_spine

SPACING_MM = 3.0
GAS_HU = -880.0
THICK_MM = 8.0
"""Gas is what a ball of this diameter fits into; bronchi beyond the first ones are thinner."""
LEAST_GAS_ML = 100.0
TIMES_THE_OTHER = 4.0
TIMES_BEFORE = 2.0
"""How much more gas than on the other side, and than before the collapse, tells the side."""
MOST_OFF_MM = 15.0
LEAST_NEARER_MM = 5.0


class Seen(NamedTuple):
    """A cone-beam CT fit for registration, and its spine."""

    cbct: PreparedCbct
    spine: Spine


@dataclass(frozen=True)
class SeenScans:
    """Both cone-beam CTs. inflated: None where it was not taken."""

    inflated: Seen | None
    deflated: Seen


@dataclass(frozen=True)
class ToldSide:
    """The operated side. by: "case.toml", "nodule" or "pleural gas"; seen: the cone-beam CTs where gas told it."""

    side: Side
    by: str
    seen: SeenScans | None = None


@dataclass(frozen=True)
class PleuralGas:
    """Gas inside the chest on each side in ml, before and after the collapse."""

    inflated_ml: dict[Side, float]
    deflated_ml: dict[Side, float]

    @property
    def side(self) -> Side | None:
        """The side it has gathered on; None where that is not clear."""
        most: Side = "right" if self.deflated_ml["right"] > self.deflated_ml["left"] else "left"
        other: Side = "left" if most == "right" else "right"
        ml = self.deflated_ml[most]
        clear = ml >= LEAST_GAS_ML and ml >= TIMES_THE_OTHER * self.deflated_ml[other]
        return most if clear and ml >= TIMES_BEFORE * self.inflated_ml[most] else None

    def require(self, side: Side, told_by: str) -> None:
        """Raise InputRefused where the gas has clearly gathered on another side than `told_by` tells."""
        if self.side not in (None, side):
            ml = self.deflated_ml
            raise InputRefused(
                f"The deflated CBCT shows {ml[self.side or side]:.0f} ml of pleural gas on the {self.side} side and "
                f"{ml[side]:.0f} ml on the {side} one, the operated one by {told_by}; correct side, nodule or "
                "cbct_deflated in case.toml, or mend the image's orientation."
            )

    def entry(self) -> dict[str, Any]:
        """For run.json."""
        return {
            "pleural_gas": self.side,
            "pleural_gas_ml": {"inflated": dict(self.inflated_ml), "deflated": dict(self.deflated_ml)},
        }


def seen_in(image: Volume) -> Seen:
    """A cone-beam CT as it comes, made fit for registration. Raises InputRefused where no field or spine is seen."""
    cbct = prepare_cbct(image)
    return Seen(cbct, segment_spine(cbct.volume, cbct.field.usable))


def seen_scans(inflated: Volume | None, deflated: Volume) -> SeenScans:
    """Both cone-beam CTs as they come, made fit for registration. Raises as `seen_in`."""
    return SeenScans(None if inflated is None else seen_in(inflated), seen_in(deflated))


def pleural_gas(scans: SeenScans) -> PleuralGas:
    """Gas beside the lungs before and after the collapse, parted by the spine; none before it without a scan."""
    none: dict[Side, float] = {"right": 0.0, "left": 0.0}
    return PleuralGas(none if scans.inflated is None else gas_ml(scans.inflated), gas_ml(scans.deflated))


def nodule_side(ct: Volume, nodule: Mask | None, nodule_ras: Array | None) -> Side | None:
    """The lung that the nodule lies in or is clearly nearer to; None where the CT does not tell.

    Raises InputRefused where the CT shows no lung.
    """
    work, _, halves, _ = lung_halves(ct)
    spots = nodule_voxels(work.grid, nodule, nodule_ras)
    if spots is None or not spots.any():
        return None
    sides: tuple[Side, Side] = ("right", "left")
    off = {
        side: float(distances_to(halves[side], np.argwhere(spots), work.grid.spacing).mean())
        for side in sides
        if halves[side].any()
    }
    nearest = min(off, key=lambda side: off[side])
    others = [mm for side, mm in off.items() if side != nearest]
    clear = off[nearest] <= MOST_OFF_MM and all(mm >= off[nearest] + LEAST_NEARER_MM for mm in others)
    return nearest if clear else None


def told_side(
    ct: Volume, nodule: Mask | None, nodule_ras: Array | None, inflated: Volume | None, deflated: Volume
) -> ToldSide:
    """What the lung that holds the nodule tells, else the pleural gas.

    Raises InputRefused where neither does; `prepare` refuses a nodule and gas that contradict each other.
    """
    side = nodule_side(ct, nodule, nodule_ras)
    if side is not None:
        return ToldSide(side, "nodule")
    seen = seen_scans(inflated, deflated)
    side = pleural_gas(seen).side
    if side is None:
        raise InputRefused(
            "Neither the nodule's place in the CT nor pleural gas in the deflated CBCT tells the operated side; "
            'add side = "right" or side = "left" to case.toml.'
        )
    return ToldSide(side, "pleural gas", seen)


def gas_ml(seen: Seen) -> dict[Side, float]:
    """Thick dark regions that no axial slice joins to the rim of the field of view, on either side of the spine."""
    cbct, spine = seen
    work = working_copy(cbct.volume, SPACING_MM)
    spacing = work.grid.spacing
    usable = on_grid(cbct.field.usable.inside, cbct.volume.grid, work.grid).inside
    dark = (work.hu < GAS_HU) & usable
    dark &= dilate(erode(dark, THICK_MM / 2, spacing), THICK_MM / 2 + 0.5, spacing)
    in_slice = np.zeros((3, 3, 3), dtype=bool)
    in_slice[:, :, 1] = ndimage.generate_binary_structure(2, 1)
    labels, count = ndimage.label(dark, in_slice)
    rim = dark & ~ndimage.binary_erosion(usable, np.ones((3, 3, 1), dtype=bool))
    outside = np.zeros(count + 1, dtype=bool)
    outside[np.unique(labels[rim])] = True
    outside[0] = True
    r = work.grid.to_ras(np.argwhere(~outside[labels]).astype(float))[:, 0] - float(np.median(spine.centres_ras[:, 0]))
    voxel_ml = float(spacing.prod()) / 1000
    return {"right": round(float((r > 0).sum()) * voxel_ml, 1), "left": round(float((r < 0).sum()) * voxel_ml, 1)}
