"""Depth below the pleura is the same whether the run cut the lung or not."""

from __future__ import annotations

import numpy as np

from poro.mesh import stuff
from poro.mesh.pieces import stuff_pieces
from registration.volume import Array
from vatsloc.evaluation.inputs import depth_below_pleura
from vatsloc.evaluation.whole_lung import whole_lung

RAS_FROM_IJK = np.array([[3.0, 0, 0, -60.0], [0, 3.0, 0, -60.0], [0, 0, 3.0, -60.0], [0, 0, 0, 1.0]])
INSIDE = np.linalg.norm(np.stack(np.meshgrid(*3 * [np.arange(-60.0, 61.0, 3.0)], indexing="ij")), axis=0) < 50


def side(points: Array) -> Array:
    return points[:, 2] + 0.3 * points[:, 0]


def test_tissue_beside_a_cut_lies_as_deep_as_in_the_whole_lung() -> None:
    whole = stuff(INSIDE, RAS_FROM_IJK, 8.0)
    cut = stuff_pieces(INSIDE, RAS_FROM_IJK, 8.0, side, lambda points: points[:, 0] < -35).mesh
    points = np.random.default_rng(3).uniform(-28, 28, (400, 3))
    expected = depth_below_pleura(whole, points)
    off = np.abs(depth_below_pleura(cut, points) - expected)
    assert (off > 5).mean() > 0.3  # the cut would count as pleura
    off = np.abs(depth_below_pleura(whole_lung(cut), points) - expected)
    assert np.median(off) < 0.5
    assert off.max() < 3  # where the cut meets the pleura a dent is left


def test_a_lung_in_one_piece_stays_as_it_is() -> None:
    lung = stuff(INSIDE, RAS_FROM_IJK, 8.0)
    assert whole_lung(lung) is lung
