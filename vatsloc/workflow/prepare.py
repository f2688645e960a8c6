"""What is read off each image before anything is registered: lungs, airways, spines and fields of view."""

from __future__ import annotations

from dataclasses import dataclass, replace

from registration.volume import Mask
from vatsloc.case import Case
from vatsloc.imaging.cbct import PreparedCbct, prepare_cbct
from vatsloc.imaging.lung_hint import operated_lung
from vatsloc.imaging.lungs import Lungs, segment_lungs
from vatsloc.imaging.side import PleuralGas, pleural_gas
from vatsloc.imaging.spine import Spine, segment_spine
from vatsloc.workflow.stages import CT, DEFLATED, INFLATED, Stages


@dataclass(frozen=True)
class Prepared:
    """Images fit for registration. lung_ct: the operated lung on the CT's grid; gas: beside the lungs in the CBCTs."""

    lungs: Lungs
    lung_ct: Mask
    inflated: PreparedCbct
    deflated: PreparedCbct
    spine_ct: Spine
    spine_inflated: Spine
    spine_deflated: Spine
    gas: PleuralGas


def prepare(case: Case, stages: Stages) -> Prepared:
    """Segment the CT and clean the cone-beam images. Raises InputRefused when one does not show what it should."""
    with stages.stage("CT lungs", CT):
        lungs = segment_lungs(case.ct, case.side, case.nodule.mask, case.nodule.centre_ras)
    hinted = case.hints.lung_mask_ct
    if hinted is not None:
        hinted, said = operated_lung(hinted, lungs, case.side, case.nodule.centre_ras, case.nodule.mask)
        for sentence in said:
            stages.warn(sentence)
        lungs = replace(lungs, left=hinted) if case.side == "left" else replace(lungs, right=hinted)
    with stages.stage("CBCT preparation"):
        stages.on(INFLATED)
        inflated = prepare_cbct(case.cbct_inflated)
        stages.on(DEFLATED)
        deflated = prepare_cbct(case.cbct_deflated)
    with stages.stage("spines"):
        stages.on(CT)
        spine_ct = segment_spine(case.ct)
        stages.on(INFLATED)
        spine_inflated = segment_spine(inflated.volume, inflated.field.usable)
        stages.on(DEFLATED)
        spine_deflated = segment_spine(deflated.volume, deflated.field.usable)
        gas = pleural_gas(inflated, deflated, spine_inflated, spine_deflated)
        gas.require(case.side, case.side_told_by)
    return Prepared(lungs, lungs.of(case.side), inflated, deflated, spine_ct, spine_inflated, spine_deflated, gas)
