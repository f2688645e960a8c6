"""What a run leaves out: a value against a limit, and, on phantoms, that it was needless there and not elsewhere."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan

import numpy as np
import pytest

from phantoms.cbct import Scanner
from phantoms.recipes import SPECS
from phantoms.spec import Collapse, Lesion, PhantomSpec
from registration.correspondences import Correspondences
from registration.sliding import moved_mm
from tests.vatsloc.ball_scene import sliding_fit
from vatsloc.study.stability.choices import LIMITS, Tried, table, try_choices
from vatsloc.synthetic.case import write_phantom
from vatsloc.workflow.choices import Choice, weigh
from vatsloc.workflow.pneumothorax import RESIDUAL
from vatsloc.workflow.pose import FIRST, moved_far
from vatsloc.workflow.stages import Stages

SMALL = PhantomSpec("small", "right", ct_spacing=(2.0, 2.0, 2.0), cbct_spacing=(2.0, 2.0, 2.0), element=22.0)
SCENES = {
    "calm": replace(
        SMALL,
        name="calm",
        scanner=Scanner(fov=330.0, length=330.0),
        collapse=Collapse(inflated=1.0, deflated=0.85, patchiness=0.2, shift=5.0, dome_rise=0.0),
    ),
    "lively": replace(
        SMALL,
        name="lively",
        lesion=Lesion(place="base", depth=12.0),
        view=(0.0, 0.0, 50.0),
        scanner=Scanner(length=150.0),
        collapse=Collapse(inflated=0.80, deflated=0.5, dome_rise=12.0, shift=14.0, patchiness=1.8),
    ),
}
"""A lung that hardly moves, all in view, and one that moves much and unevenly, its base with the nodule out of view."""
FAST = {"registration": {"grid_mm": 20.0, "levels": 3, "voxel_mm": 3.0}, "mesh": {"edge_mm": 10.0}}
NEEDLESS_MM = 0.5


@pytest.mark.parametrize(
    ("value", "limit", "kept"), [(0.9, 1.0, False), (1.0, 1.0, False), (1.1, 1.0, True), (0.0, -1.0, True)]
)
def test_a_part_is_left_out_up_to_its_limit(value: float, limit: float, kept: bool) -> None:
    rule = "kept in every case" if limit < 0 else f"left out up to {limit:g} mm"
    assert weigh("part", value, limit, f"seen {value}") == Choice("part", kept, f"seen {value}; {rule}", value, limit)


def test_what_could_not_be_measured_keeps_its_part() -> None:
    assert weigh("part", nan, 1.0, "").kept
    assert weigh("part", inf, 1.0, "").kept


def test_a_log_lists_choices_and_calls_what_was_left_out_skipped() -> None:
    stages = Stages()
    assert stages.choose(weigh("a", 2.0, 1.0, "two"))
    assert not stages.choose(weigh("b", 0.5, 1.0, "half"))
    assert [choice.part for choice in stages.choices] == ["a", "b"]
    assert stages.skipped == {"b": "half; left out up to 1 mm"}


def test_places_that_moved_little_against_the_spine_make_the_first_registration_needless() -> None:
    fixed = np.random.default_rng(1).uniform(-50, 50, (100, 3))
    spine = lambda x: x + np.array([100.0, 0, 0])  # noqa: E731
    moved = spine(fixed) + np.array([0.0, 3, 4])
    moved[:3] += 40  # 95 % count
    matched = sliding_fit(100, moved_mm(Correspondences.of(fixed, moved), spine))
    assert not moved_far(matched, 5.1).kept
    assert moved_far(matched, 4.9).kept
    assert moved_far(matched, 5.1).value == pytest.approx(5)
    assert moved_far(matched, 5.1).why.startswith("95 % of 100 keypoints inside the lung moved by at most 5.0 mm")
    none = sliding_fit(0, moved_mm(None, spine))
    assert moved_far(none, 100.0).kept
    assert moved_far(none, 100.0).value == inf


@pytest.fixture(scope="module")
def tried(tmp_path_factory: pytest.TempPathFactory) -> list[Tried]:
    """Every choice of both scenes turned over."""
    with pytest.MonkeyPatch.context() as patch:
        for name, spec in SCENES.items():
            patch.setitem(SPECS, name, spec)
        folders = []
        for name in SCENES:
            folders.append(tmp_path_factory.mktemp("scenes") / name)
            write_phantom(name, folders[-1], 3)
    return [t for folder in folders for t in try_choices(folder, over=FAST)]


@pytest.mark.study
def test_parts_left_out_were_needless_and_parts_kept_were_not(tried: list[Tried]) -> None:
    made = {(t.case, t.choice.part): t for t in tried}
    assert len(made) == 2 * len(LIMITS)
    for part in (FIRST, RESIDUAL):
        calm, lively = made["calm", part], made["lively", part]
        assert not calm.choice.kept, part
        assert calm.moved_mm < NEEDLESS_MM, part
        assert lively.choice.kept, part
        assert lively.moved_mm > NEEDLESS_MM, part
    assert table(tried).count("left out") >= 2
