"""The CT in the place of an inflated scan: where its lung is expected, and how dense."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from registration.volume import Mask, Volume
from tests.vatsloc import run_scene as known
from vatsloc.workflow.forecast import calibrated_motions, mean_motion
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import Stages
from vatsloc.workflow.stand_in import as_scan, expected_pose, moved_ct, stand_in


def test_the_moved_ct_shows_tissue_where_it_went_and_denser_by_its_loss_of_volume() -> None:
    scene = known.scene()
    pose = expected_pose(
        scene.pose.mesh_ct, known.CENTRE + 0.8 * (scene.pose.mesh_ct.points - known.CENTRE), known.CT_GRID
    )
    flat = Volume(np.full(known.CT_GRID.shape, -800.0, np.float32), known.CT_GRID.ras_from_ijk)
    moved = moved_ct(flat, pose.inf_from_ct, pose.lung_inf.grid)
    assert_allclose(moved.hu[pose.lung_inf.inside], 200 / 0.8**3 - 1000, rtol=1e-4)
    far = np.linalg.norm(moved.grid.points() - known.CENTRE, axis=-1) < 0.7 * known.RADIUS_MM
    shown = moved_ct(scene.case.ct, pose.inf_from_ct, pose.lung_inf.grid)
    there = known.CENTRE + (shown.grid.points()[far] - known.CENTRE) / 0.8
    assert_allclose(shown.hu[far], (known.ct_hu(there) + 1000) / 0.8**3 - 1000, atol=8)
    assert as_scan(flat).field.radius_mm == np.inf


def test_the_moved_ct_keeps_the_lung_s_mass_however_the_lung_turns_and_swells() -> None:
    mesh = known.scene().pose.mesh_ct
    about = known.as_affine(known.DEF_FROM_INF_RIGID)
    for scale in (0.8, 1.15):
        points = about(known.CENTRE + scale * (mesh.points - known.CENTRE))
        pose = expected_pose(mesh, points, known.CT_GRID)
        ct = Volume(np.full(known.CT_GRID.shape, -700.0, np.float32), known.CT_GRID.ras_from_ijk)
        moved = moved_ct(ct, pose.inf_from_ct, pose.lung_inf.grid)
        inside, voxel = pose.lung_inf.inside, pose.lung_inf.grid.spacing.prod()
        mass = (moved.hu[inside] + 1000).sum() * voxel
        assert mass == pytest.approx(300 * mesh.volumes.sum(), rel=0.03)
        assert moved.hu[~inside].max() == pytest.approx(-700)  # what lies beside the lung gains nothing


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_lung_is_expected_to_move_about_its_own_middle(side: Any) -> None:
    grid, half = known.CT_GRID, np.array([22.0, 18.0, 26.0])
    inside = np.linalg.norm((grid.points() - known.CENTRE) / half, axis=-1) < 1
    ct: Any = SimpleNamespace(lungs=None, lung_ct=Mask(inside, grid.ras_from_ijk), spine_ct=None)
    case: Any = SimpleNamespace(side=side, ct=Volume(np.full(grid.shape, -800.0, np.float32), grid.ras_from_ijk))
    before, pose = stand_in(case, ct, Settings(), Stages())
    points = pose.mesh_ct.points
    about = mean_motion(points, known.CENTRE, side, calibrated_motions("inflated"))
    assert_allclose(pose.points_inf - points, about, atol=0.1)
    assert before.inflated.volume.grid.same_as(pose.lung_inf.grid)
