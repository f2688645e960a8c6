"""The quick Gaussian filter: scipy's says the same."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import ndimage

from registration.images.filters import gaussian

VOXELS = np.random.default_rng(0).normal(0, 300, size=(31, 70, 23)).astype(np.float32)


@pytest.mark.parametrize(
    "how",
    [
        {"sigma": 0.5},
        {"sigma": (1.0, 2.0, 6.0)},
        {"sigma": (3.0, 0.0, 1.0), "mode": "nearest"},
        {"sigma": 2.0, "order": (0, 1, 2), "truncate": 3.0},
    ],
)
def test_it_is_the_filter_of_scipy(how: dict[str, Any]) -> None:
    found = gaussian(VOXELS, **how)
    assert found.dtype == np.float32
    assert_allclose(found, ndimage.gaussian_filter(VOXELS.astype(float), **how), atol=3e-4)


def test_the_image_stays_as_it_was() -> None:
    before = VOXELS.copy()
    assert not np.shares_memory(gaussian(VOXELS, 1.0), VOXELS)
    assert np.array_equal(VOXELS, before)
