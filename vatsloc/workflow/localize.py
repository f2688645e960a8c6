"""The whole method in one screen. Ref: Alvarez 2021.

`before_collapse` does what needs no deflated scan: it reads lungs, airways and spines off the CT and the inflated
cone-beam CT, and finds the change of pose between them, phase 1. Without an inflated scan `stand_in` expects both from
the CT. `prepare` reads off the deflated scan. Phase 2, from the inflated to the deflated lung: `observe` sees what
there is of it, `collapse` fits the poroelastic model to that and corrects it by the images inside; `in_pieces` cuts a
lung whose lobes came apart; `refined` makes it follow small blocks of the CT up to the pleura; `held_apart` presses
pieces apart that these registrations, each for itself, have let overlap. `locate_nodule` carries the nodule through
both and says how uncertain it is. `checked` compares the result with the scans by keypoints that nothing before it has
used.
"""

from __future__ import annotations

from functools import partial

from vatsloc.case import Case
from vatsloc.workflow.localization import Localization, checked, locate_nodule
from vatsloc.workflow.observe import HILUM, lung_of_model, observe, spine_from_ct
from vatsloc.workflow.parted import in_pieces
from vatsloc.workflow.piece_contact import held_apart
from vatsloc.workflow.pneumothorax import begin_refinement, collapse, refined
from vatsloc.workflow.prepare import begin_scans, prepare
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import Stages
from vatsloc.workflow.stand_in import stand_in
from vatsloc.workflow.state import State, before_collapse, begin_check, with_check


def localize(case: Case, settings: Settings, stages: Stages, state: State | None = None) -> Localization:
    """Find the nodule of a case in its deflated cone-beam CT. state: what was done before that was taken.

    Raises InputRefused for images that do not show what they should, NotConverged when a solver has no answer.
    """
    with stages.beside():
        if state is None and case.cbct_inflated is not None:
            begin_scans(case, case.cbct_inflated, stages)
        return _localized(case, settings, stages, state)


def _localized(case: Case, settings: Settings, stages: Stages, state: State | None) -> Localization:
    known = before_collapse(case, settings, stages, state)
    stages.begin(HILUM, "", partial(lung_of_model, known.prepared, case.side, settings))
    before, pose = known.complete or stand_in(case, known.prepared, settings, stages)
    prepared = prepare(case, stages, before)
    spine = None if known.complete else spine_from_ct(case, prepared, stages)
    observed = observe(case, prepared, pose, settings, stages, spine)
    begin_refinement(case, prepared, observed, settings, stages)
    begin_check(case, known, stages)
    collapsed = collapse(case, prepared, pose, observed, settings, stages)
    pose, collapsed = in_pieces(prepared, pose, collapsed, settings, stages)
    collapsed = refined(case, prepared, pose, collapsed, settings, stages)
    collapsed = held_apart(collapsed, settings, stages)
    found = locate_nodule(case, prepared, pose, collapsed, settings, stages)
    return checked(case, found, settings, stages, with_check(case, known, stages).left_over)
