"""A breathing lung: what its weight, its bronchi and its ribs do, one at a time, by sign and by size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from poro.arrays import Array
from poro.breathing.elastic import (
    WALL_ALONE,
    Breathing,
    Lung,
    acting_at,
    breathe_out,
    bronchi,
    caudal,
    depth_of,
    hilum,
    spread_map,
)
from poro.fem import Tissue
from poro.fem.tissue import GRAVITY_KPA_PER_MM
from poro.mesh import TetMesh, stuff

HALF = np.array([35.0, 55.0, 75.0])


def pear(stretch: Array) -> TetMesh:
    """Ellipsoid of half axes `HALF`, thicker towards +z, stretched along the axes."""
    step = 5.0
    n = np.ceil(HALF / step).astype(int) + 3
    x = step * np.stack(np.meshgrid(*(np.arange(-k, k + 1) for k in n), indexing="ij"), -1)
    width = 1 + 0.3 * x[..., 2:] / HALF[2]
    inside = np.linalg.norm(x / HALF / np.concatenate([width, width, np.ones_like(width)], -1), axis=-1) < 1
    affine = np.diag([step, step, step, 1.0])
    affine[:3, 3] = -step * n
    mesh = stuff(inside, affine, 14.0)
    return TetMesh(mesh.points * stretch, mesh.tets)


@pytest.fixture(scope="module")
def still() -> Lung:
    mesh = pear(np.ones(3))
    return Lung("right", mesh, mesh)


@pytest.fixture(scope="module")
def flattened(still: Lung) -> Lung:
    return Lung("right", still.inspired, pear(np.array([1.0, 0.8, 1.0])))


def depth(mesh: TetMesh) -> Array:
    return 1 - np.linalg.norm(mesh.points / HALF, axis=1)


def test_a_lung_whose_wall_rests_does_not_move(still: Lung) -> None:
    assert_allclose(breathe_out(still, WALL_ALONE), still.inspired.points, atol=1e-6)


def test_a_stretched_lung_is_found(flattened: Lung) -> None:
    start = spread_map(flattened.inspired, flattened.expired)
    assert_allclose(np.diag(start.matrix), [1.0, 0.8, 1.0], atol=1e-12)
    moved = breathe_out(flattened, WALL_ALONE)
    assert_allclose(moved, flattened.inspired.points * [1.0, 0.8, 1.0], atol=1e-6)


def test_weight_moves_the_inside_to_the_back_and_hardly_the_wall(still: Lung) -> None:
    weight = replace(WALL_ALONE, mass_kg=0.1)
    u = breathe_out(still, weight) - still.inspired.points
    inside = depth(still.inspired) > 0.5
    wall = still.inspired.boundary
    density = 0.1e9 / still.expired.volumes.sum()
    column = density * GRAVITY_KPA_PER_MM * (2 * HALF[1]) ** 2 / (8 * (Tissue().lame_kpa + 2 * Tissue().shear_kpa))
    # The sides of the wall hold the middle too, so it sinks less than a column between front and back alone.
    assert 0.6 * column < -u[depth(still.inspired) > 0.8, 1].mean() < column
    assert u[inside, 1].max() < 0
    assert np.abs(np.einsum("nd,nd->n", u[wall.nodes], wall.node_normals)).max() < 1.0
    twice = breathe_out(still, replace(weight, mass_kg=0.2)) - still.inspired.points
    assert 1.5 < twice[inside, 1].mean() / u[inside, 1].mean() < 2.5


def test_the_flatter_end_is_the_diaphragm(still: Lung) -> None:
    assert caudal(still.inspired) == 1.0
    assert caudal(TetMesh(still.inspired.points * [-1, 1, -1], still.inspired.tets)) == -1.0


def test_hilum_lies_inward(still: Lung) -> None:
    assert hilum(still.inspired, "right")[0] < -25
    assert hilum(still.inspired, "left")[0] > 25


def test_bronchi_hold_about_the_hilum_and_the_front_falls_with_the_ribs(flattened: Lung) -> None:
    acting = Breathing()
    held, fall = bronchi(flattened, acting)
    points = flattened.inspired.points
    root = hilum(flattened.inspired, "right")
    assert held.sum() == pytest.approx(acting.held_kpa_mm)
    lost = 1 - np.ptp(flattened.expired.points[:, 1]) / np.ptp(points[:, 1])
    assert lost == pytest.approx(0.2, abs=0.02)
    assert_allclose(fall, lost * (points[:, 1] - root[1]))  # +z is towards the feet here
    upside_down = [TetMesh(mesh.points * [-1, 1, -1], mesh.tets) for mesh in (flattened.inspired, flattened.expired)]
    assert_allclose(bronchi(Lung("left", *upside_down), acting)[1], -fall, atol=1e-9)


def test_the_inside_turns_with_the_ribs(flattened: Lung) -> None:
    ribs = replace(WALL_ALONE, held_kpa_mm=300.0, turn=1.0)
    u = breathe_out(flattened, ribs) - breathe_out(flattened, WALL_ALONE)
    points, inside = flattened.inspired.points, depth(flattened.inspired) > 0.3
    slope = np.polyfit(points[inside, 1], u[inside, 2], 1)[0]
    assert 0.02 < slope < 0.2


@pytest.mark.parametrize(("ratio", "depth"), [(0.9, 0.0), (0.7, 0.5), (1 / 0.7, 0.5), (0.5, 1.0)])
def test_a_quiet_breath_follows_its_wall_and_a_deep_one_all_that_acts(ratio: float, depth: float) -> None:
    assert depth_of(ratio) == pytest.approx(depth)
    assert acting_at(0.0) == WALL_ALONE
    assert acting_at(1.0) == Breathing()
    assert acting_at(depth).mass_kg == pytest.approx(depth * Breathing().mass_kg)
