"""A lung mask given by hand, judged beside the lungs that the CT itself shows: its side, its size, the nodule in it."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from registration.volume import Array, Mask
from vatsloc.errors import InputRefused
from vatsloc.imaging.lungs import LEAST_LUNG_ML, Lungs, Side

BOTH_SHARE = 0.2
"""A mask that covers more of the other lung than this holds both lungs."""
LEAST_BALANCE = 0.25
"""A mask of both lungs covers both about alike; one that holds less of the operated lung is of the other one."""
MAX_NODULE_OUTSIDE_MM = 15.0
_COARSE_MM = 4.0


def operated_lung(
    given: Mask, lungs: Lungs, side: Side, nodule_ras: Array, nodule: Mask | None
) -> tuple[Mask, list[str]]:
    """The lung on `side` of a mask given by hand, on the CT's grid as `lungs` is, and sentences on what was changed.

    Of both lungs the operated one is kept; a nodule that the mask leaves out is added. nodule_ras: (3,) mm. Raises
    InputRefused for a mask smaller than a lung, of the other side, or far from the nodule.
    """
    own, other = lungs.of(side), lungs.of("left" if side == "right" else "right")
    warnings: list[str] = []
    ml, held = (
        _ml(given),
        {name: int((given.inside & lung.inside).sum()) for name, lung in (("own", own), ("other", other))},
    )
    if ml < LEAST_LUNG_ML:
        raise InputRefused(
            f"[hints] lung_mask_ct marks {ml:.0f} ml, {LEAST_LUNG_ML:.0f} ml needed of a lung; "
            f"give a mask of the whole {side} lung, or leave it out."
        )
    if held["own"] <= held["other"] * LEAST_BALANCE:
        raise InputRefused(
            f"[hints] lung_mask_ct marks {held['own']} voxels of the {side} lung, which is operated, and "
            f"{held['other']} of the other; give a mask of the {side} lung, or correct side."
        )
    lung = given
    if held["other"] > BOTH_SHARE * other.inside.sum():
        lung = Mask(given.inside & _nearer(own, other), given.ras_from_ijk)
        warnings.append(f"The lung mask given by hand holds both lungs; its part nearer to the {side} one was kept.")
    outside = lung.distance(nodule_ras)
    if outside > MAX_NODULE_OUTSIDE_MM:
        raise InputRefused(
            f"[hints] lung_mask_ct leaves the nodule {outside:.0f} mm outside, {MAX_NODULE_OUTSIDE_MM:.0f} mm allowed; "
            "give a mask of the lung that holds it."
        )
    missing = 0 if nodule is None else int((nodule.inside & ~lung.inside).sum())
    if nodule is not None and missing:
        warnings.append(f"The lung mask given by hand leaves out {missing} voxels of the nodule; they were added.")
        lung = Mask(lung.inside | nodule.inside, lung.ras_from_ijk)
    elif nodule is None and outside > 0:
        warnings.append(f"The nodule lies {outside:.0f} mm outside the lung mask given by hand.")
    return lung, warnings


def _ml(mask: Mask) -> float:
    return float(mask.inside.sum() * mask.grid.spacing.prod()) / 1000


def _nearer(own: Mask, other: Mask) -> Array:
    """Voxels nearer to one lung than to the other, decided in blocks of about 4 mm, inside the lungs voxel by voxel."""
    step = np.maximum(np.rint(_COARSE_MM / own.grid.spacing), 1).astype(int)
    thin = tuple(slice(None, None, s) for s in step)
    to_own, to_other = (
        ndimage.distance_transform_edt(~lung.inside[thin], sampling=own.grid.spacing * step) for lung in (own, other)
    )
    blocks = [np.arange(n) // s for n, s in zip(own.inside.shape, step, strict=True)]
    nearer: Array = (to_own <= to_other)[np.ix_(*blocks)]
    return (nearer | own.inside) & ~other.inside
