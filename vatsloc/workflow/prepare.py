"""What is read off each image before anything is registered: lungs, airways, spines and fields of view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial

from registration.spine import RigidFit, register_spine
from registration.volume import Mask, Volume
from vatsloc.case import Case, CaseBefore
from vatsloc.imaging.cbct import PreparedCbct, prepare_cbct
from vatsloc.imaging.lung_hint import operated_lung
from vatsloc.imaging.lungs import Lungs, segment_lungs
from vatsloc.imaging.side import PleuralGas, Seen, SeenScans, pleural_gas
from vatsloc.imaging.spine import Spine, segment_spine
from vatsloc.workflow.stages import CT, DEFLATED, INFLATED, Stages

CBCT, SPINES, SPINE_INFLATED_TO_DEFLATED = "CBCT preparation", "spines", "spine inflated to deflated"


@dataclass(frozen=True)
class PreparedCt:
    """The CT fit for registration. lung_ct: the operated lung on the CT's grid."""

    lungs: Lungs
    lung_ct: Mask
    spine_ct: Spine


@dataclass(frozen=True)
class PreparedBefore(PreparedCt):
    """The images from before the collapse."""

    inflated: PreparedCbct
    spine_inflated: Spine


@dataclass(frozen=True)
class Prepared(PreparedBefore):
    """All images fit for registration. gas: beside the lungs in the cone-beam CTs."""

    deflated: PreparedCbct
    spine_deflated: Spine
    gas: PleuralGas


def prepare(case: Case, stages: Stages, known: PreparedBefore | None = None) -> Prepared:
    """Segment the CT and clean the cone-beam images, but for what is known.

    Raises InputRefused when one does not show what it should, ValueError for a case without an inflated scan, or what
    stands in for it.
    """
    if known is None:
        if case.cbct_inflated is None:
            raise ValueError("the case has no inflated scan; give what stands in for it")
        known = prepare_before(case, case.cbct_inflated, stages)
    seen = _cbct(case.cbct_deflated, DEFLATED, stages, None if case.seen is None else case.seen.deflated)
    with stages.stage(SPINES, DEFLATED):
        inflated = None if case.cbct_inflated is None else Seen(known.inflated, known.spine_inflated)
        gas = pleural_gas(SeenScans(inflated, seen))
        gas.require(case.side, case.side_told_by)
    own = {f.name: getattr(known, f.name) for f in fields(PreparedBefore)}
    return Prepared(**own, deflated=seen.cbct, spine_deflated=seen.spine, gas=gas)


def begin_scans(case: Case, cbct_inflated: Volume, stages: Stages) -> None:
    """Begin what the cone-beam CTs alone are needed for, up to the pose between them, beside the CT's stages."""
    known = case.seen
    inflated = _begin(cbct_inflated, INFLATED, stages, None if known is None else known.inflated)
    deflated = _begin(case.cbct_deflated, DEFLATED, stages, None if known is None else known.deflated)
    stages.begin(SPINE_INFLATED_TO_DEFLATED, "", lambda: pose_between(inflated(), deflated()))


def _begin(image: Volume, name: str, stages: Stages, seen: Seen | None) -> Callable[[], Seen]:
    """What waits for a cone-beam CT made fit for registration."""
    if seen is not None:
        return lambda: seen
    cbct = stages.begin(CBCT, name, partial(prepare_cbct, image))
    spine = stages.begin(SPINES, name, lambda: segment_spine(cbct().volume, cbct().field.usable))
    return lambda: Seen(cbct(), spine())


def pose_between(inflated: Seen, deflated: Seen) -> RigidFit:
    """The spine of the inflated cone-beam CT, moving, registered to that of the deflated one."""
    return register_spine(
        deflated.cbct.volume,
        inflated.cbct.volume,
        deflated.spine.mask,
        inflated.spine.mask,
        fixed_seen=deflated.cbct.field.usable,
        moving_seen=inflated.cbct.field.usable,
    )


def prepare_before(
    case: CaseBefore, cbct_inflated: Volume, stages: Stages, known: PreparedCt | None = None
) -> PreparedBefore:
    """The part of `prepare` that needs no deflated scan."""
    ct = known or prepare_ct(case, stages)
    seen = _cbct(cbct_inflated, INFLATED, stages, None if case.seen is None else case.seen.inflated)
    return PreparedBefore(ct.lungs, ct.lung_ct, ct.spine_ct, seen.cbct, seen.spine)


def prepare_ct(case: CaseBefore, stages: Stages) -> PreparedCt:
    """The part of `prepare` that needs the CT alone."""
    lungs = prepare_lungs(case, stages)
    with stages.stage(SPINES, CT):
        spine = segment_spine(case.ct)
    return PreparedCt(lungs, lungs.of(case.side), spine)


def prepare_lungs(case: CaseBefore, stages: Stages) -> Lungs:
    """The CT's lungs, the operated one as it was given by hand where it was."""
    with stages.stage("CT lungs", CT):
        lungs = segment_lungs(case.ct, case.side, case.nodule.mask, case.nodule.centre_ras)
    hinted = case.hints.lung_mask_ct
    if hinted is not None:
        hinted, said = operated_lung(hinted, lungs, case.side, case.nodule.centre_ras, case.nodule.mask)
        for sentence in said:
            stages.warn(sentence)
        lungs = replace(lungs, left=hinted) if case.side == "left" else replace(lungs, right=hinted)
    return lungs


def _cbct(image: Volume, name: str, stages: Stages, seen: Seen | None) -> Seen:
    """A cone-beam CT made fit for registration, once."""
    if seen is not None:
        stages.skip(CBCT, "done while the scans were read, for pleural gas had to tell the side")
        return seen
    with stages.stage(CBCT, name):
        cbct = stages.done(partial(prepare_cbct, image))
    with stages.stage(SPINES, name):
        return Seen(cbct, stages.done(lambda: segment_spine(cbct.volume, cbct.field.usable)))
