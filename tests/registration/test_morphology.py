"""Morphology in millimetres: the Euclidean distance transform of scipy says the same."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from registration.images.morphology import bounding_box, dilate, distances_to, erode


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (1.0, 0.8, 2.5), (3.0, 2.9, 3.1)])
@pytest.mark.parametrize("distance_mm", [0.3, 5.0, 8.0])
def test_dilation_takes_what_is_near_and_erosion_leaves_what_is_deep(
    spacing: tuple[float, float, float], distance_mm: float
) -> None:
    inside = np.random.default_rng(0).uniform(size=(33, 41, 27)) < 3e-3
    distance = ndimage.distance_transform_edt(~inside, sampling=spacing)
    assert np.array_equal(dilate(inside, distance_mm, np.array(spacing)), distance <= distance_mm)
    assert np.array_equal(erode(~inside, distance_mm, np.array(spacing)), distance > distance_mm)


def test_nothing_dilates_to_nothing_and_the_border_of_the_image_does_not_erode() -> None:
    assert not dilate(np.zeros((4, 5, 6), dtype=bool), 50.0, np.ones(3)).any()
    assert erode(np.ones((4, 5, 6), dtype=bool), 50.0, np.ones(3)).all()


def test_the_box_of_an_empty_mask_is_refused() -> None:
    with pytest.raises(ValueError, match="mask is empty"):
        bounding_box(np.zeros((3, 3, 3), dtype=bool), np.zeros(3))


def test_distances_of_some_voxels_are_those_of_the_transform_of_all() -> None:
    rng, spacing = np.random.default_rng(1), np.array([0.7, 1.0, 2.0])
    inside = ndimage.gaussian_filter(rng.normal(size=(40, 30, 35)), 3) > 0.02
    inside[:, :5] = True  # up to the image's border
    voxels = np.argwhere(rng.uniform(size=inside.shape) < 0.01)
    want = ndimage.distance_transform_edt(~inside, sampling=spacing)[tuple(voxels.T)]
    assert (want == 0).any()
    assert np.allclose(distances_to(inside, voxels, spacing), want)
    with pytest.raises(ValueError, match="mask is empty"):
        distances_to(np.zeros((3, 3, 3), dtype=bool), np.zeros((1, 3), int), spacing)
