"""Overlapping pieces of a lung are pressed apart in the run, where they overlap by enough, and else left alone."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from poro.contact import level_set
from poro.separation import Separation
from registration.correspondences import Correspondences
from registration.volume import Array
from tests.vatsloc import run_scene as known
from tests.vatsloc.test_parted import cut
from vatsloc.workflow import piece_contact as module
from vatsloc.workflow.piece_contact import CONTACT, held_apart, overlap_mm3
from vatsloc.workflow.pneumothorax import Collapse
from vatsloc.workflow.settings import Settings, settings_of
from vatsloc.workflow.stages import Stages


def overlapping(by_mm: float) -> tuple[Collapse, Array]:
    """A parted lung whose upper piece was pushed into the lower one, less towards the middle, where both are one; and
    its places if that had not been done.
    """
    _, collapse = cut(8.0)
    assert collapse.parted is not None
    pieces, before = collapse.parted.pieces, collapse.mesh_before
    points = before.points
    whole = replace(pieces, mesh=before)
    faces, centre = whole.pairs[:, 0], points.mean(axis=0)
    down = np.linalg.svd(points[faces] - points[faces].mean(axis=0))[2][2]
    if down @ (points[whole.node_piece() == 1].mean(axis=0) - centre) < 0:
        down = -down
    share = np.clip(np.linalg.norm(points - centre, axis=1) / known.RADIUS_MM - 0.6, 0, 1)
    pushed = points + by_mm * ((whole.node_piece() == 0) * share)[:, None] * down
    system: Any = SimpleNamespace(wall=SimpleNamespace(level=level_set(before.boundary, 5.0, 0.0)))
    keypoints = points[np.linalg.norm(points - centre, axis=1) < 15]
    model = replace(collapse.model, system=system, correspondences=Correspondences.of(keypoints, keypoints))
    return replace(collapse, model=model, points_after=pushed), points


def ran(collapse: Collapse, limit_ml: float) -> tuple[Collapse, Stages]:
    """The stage with a limit."""
    stages = Stages()
    return held_apart(collapse, settings_of("balanced", {"leave_out": {"overlap_ml": limit_ml}}), stages), stages


def test_pieces_that_overlap_are_pressed_apart_and_what_is_known_stays() -> None:
    collapse, _ = overlapping(6.0)
    assert collapse.parted is not None
    pieces = collapse.parted.pieces
    before = overlap_mm3(pieces, collapse.points_after)
    assert before > 500
    found, stages = ran(collapse, 0.1)
    assert overlap_mm3(pieces, found.points_after) < 0.05 * before
    assert [choice.part for choice in stages.choices if choice.kept] == [CONTACT]
    assert stages.choices[0].value == pytest.approx(before / 1e3)
    assert f"the pieces overlap by {before / 1e3:.2f} ml; left out up to 0.1 ml" == stages.choices[0].why
    centre = collapse.mesh_before.points.mean(axis=0)
    inner = np.linalg.norm(collapse.mesh_before.points - centre, axis=1) < 10
    assert np.linalg.norm((found.points_after - collapse.points_after)[inner], axis=1).max() < 0.5


def test_contact_that_does_not_settle_is_told_and_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    collapse, _ = overlapping(6.0)
    still = np.zeros_like(collapse.points_after)
    monkeypatch.setattr(module, "pressed_apart", lambda _: Separation(still, 2000.0, 1500.0, np.zeros(0, int), None))
    found, stages = ran(collapse, 0.1)
    assert found is collapse
    assert "1.50 of 2.00 ml left" in stages.warnings[0]


def test_a_small_overlap_is_left_and_said() -> None:
    collapse, _ = overlapping(6.0)
    found, stages = ran(collapse, 1e3)
    assert found is collapse
    assert [choice.kept for choice in stages.choices] == [False]
    assert Settings().leave_out.overlap_ml == 5.0


def test_a_lung_in_one_piece_touches_nothing() -> None:
    collapse = known.scene().collapse
    stages = Stages()
    assert held_apart(collapse, Settings(), stages) is collapse
    assert stages.skipped[CONTACT] == "the lung is in one piece"


def test_pieces_that_lie_as_they_were_cut_do_not_overlap() -> None:
    collapse, points = overlapping(0.0)
    assert collapse.parted is not None
    assert_allclose(collapse.points_after, points)
    assert overlap_mm3(collapse.parted.pieces, points) < 20
