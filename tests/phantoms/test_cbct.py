"""Cone-beam artefacts by sign and size."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from phantoms.cbct import Scanner, expose, scanner_grid
from phantoms.voxels import Image


@pytest.fixture(scope="module")
def water() -> Image:
    grid = scanner_grid(np.array([10.0, -20.0, 5.0]), (2.0, 2.0, 2.0), 100.0)
    return Image(np.zeros(grid.shape, dtype=np.float32), grid.ras_from_ijk)


def test_grid_is_centred_and_runs_to_the_left_and_back(water: Image) -> None:
    assert water.grid.shape == (120, 120, 50)
    assert_allclose(water.grid.to_ras((np.array(water.grid.shape) - 1) / 2), [10, -20, 5])
    assert_allclose(np.diag(water.ras_from_ijk), [-2, -2, 2, 1])


def test_outside_the_field_of_view_is_constant_air(water: Image) -> None:
    image = expose(water, Scanner(), np.random.default_rng(0))
    i, j = (np.indices((120, 120)) - 59.5) * 2
    outside = np.hypot(i, j) > 120
    assert np.all(image.hu[outside] == -1000)
    assert image.hu[~outside].mean() > -100


def test_middle_is_darker_and_rim_brighter_than_water(water: Image) -> None:
    image = expose(water, Scanner(noise=0.0, cupping=0.06, rim=0.1), np.random.default_rng(0))
    assert image.hu[60, 60, 25] == pytest.approx(-60, abs=1)
    assert image.hu[1:4, 60, 25].mean() > 40


def test_noise_has_the_size_asked_for_and_grows_at_both_ends(water: Image) -> None:
    image = expose(water, Scanner(noise=30.0, cupping=0.0, rim=0.0), np.random.default_rng(0))
    middle = image.hu[50:70, 50:70].std(axis=(0, 1))
    assert middle[15:35].mean() == pytest.approx(30 * 1.15, rel=0.15)
    assert min(middle[0], middle[-1]) > 1.5 * middle[15:35].mean()
