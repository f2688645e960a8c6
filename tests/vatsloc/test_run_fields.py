"""Displacement fields on every n-th voxel: which voxels these are, and how far off the fields are between them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from registration.volume import Grid
from tests.vatsloc import run_scene as known
from tests.vatsloc.test_run_result import both_scans, localization
from vatsloc.maps import covered
from vatsloc.workflow.fields import fields_entry, thinned


@pytest.mark.parametrize(("mm", "every"), [(0.0, (1, 1, 1)), (2.9, (2, 1, 1)), (3.0, (3, 2, 1)), (9.0, (9, 6, 3))])
def test_every_nth_voxel_of_the_grid_stays_where_it_was(mm: float, every: tuple[int, int, int]) -> None:
    affine = np.diag([-1.0, -1.5, 2.7, 1.0])
    affine[:3, 3] = [5.0, 6.0, 7.0]
    grid = Grid((10, 9, 8), affine)
    thin = thinned(grid, mm)
    assert_allclose(thin.points(), grid.points()[:: every[0], :: every[1], :: every[2]])


def test_thin_fields_are_exact_at_their_voxels_and_near_between_them_inside_the_lung() -> None:
    found, case = localization(known.scene()), known.scene().case
    whole, thin = (both_scans(case, found, mm) for mm in (0.0, 7.0))
    field = thin[1].to_ct
    assert field.grid.shape == (16, 22, 21)
    there = field.grid.points()
    inside = covered(found.collapse.mesh_after, field.grid).inside
    assert_allclose(field.vectors[inside], whole[1].to_ct.vectors[::3, ::2, ::2][inside], atol=1e-4)
    assert_allclose(there[inside] + field.vectors[inside], known.DEF_FROM_CT.inverse()(there[inside]), atol=0.01)
    told = fields_entry(*thin, found)
    assert set(told) == {"inflated_from_ct", "deflated_from_ct", "ct_from_inflated", "ct_from_deflated"}
    assert_allclose(told["ct_from_deflated"]["spacing_mm"], [6.9, 5.0, 4.8])
    # The scene's maps are affine, so all that is off is the border, which goes on as its nearest voxel inside does.
    assert all(entry["off_mm_median"] < 3 for entry in told.values())
    assert fields_entry(*whole, found)["deflated_from_ct"]["off_mm_p95"] <= told["deflated_from_ct"]["off_mm_p95"]
