"""The chain with fewer scans than three, for the chart: without an inflated one, and foreseen from the CT alone."""

from __future__ import annotations

from dataclasses import replace

from registration.maps.rigid import RigidTransform
from registration.volume import Array
from vatsloc.case import Case
from vatsloc.evaluation.tre import RunMaps
from vatsloc.study.cohort.scored import run_maps
from vatsloc.workflow.forecast import calibrated_motions, mean_motion, middle_of
from vatsloc.workflow.localize import localize
from vatsloc.workflow.observe import spine_from_ct
from vatsloc.workflow.prepare import Prepared, prepare_lungs
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import Stages
from vatsloc.workflow.state import before_collapse


def without_inflated(case: Case, settings: Settings, before: Stages, after: Stages) -> RunMaps:
    """A run that has not seen the inflated scan; what it does before the deflated one is there, and after. Raises as
    `localize`.
    """
    bare = replace(case, cbct_inflated=None)
    found = localize(bare, settings, after, before_collapse(bare, settings, before))
    return run_maps(found.pose, found.collapse)


def foreseen(case: Case, prepared: Prepared, stages: Stages) -> RunMaps:
    """Where phantoms' lungs went, carried over to this one. A forecast knows no pose of the body, so the spine's is
    taken from the deflated scan, by which it is only scored. Raises as `localize`.
    """
    lung = prepare_lungs(case, stages).of(case.side)
    middle = middle_of(lung)
    persons = calibrated_motions("deflated")
    motions = persons.only(persons.gas == case.pleural_gas)
    rigid = spine_from_ct(case, prepared, Stages()).moving_from_fixed.inverse()
    still = RigidTransform.identity()

    def def_from_ct(points: Array) -> Array:
        return rigid(points + mean_motion(points, middle, case.side, motions))

    return RunMaps(still, rigid, rigid, still, rigid, def_from_ct)
