"""Images seen through maps: exact on linear scenes, the same in every orientation, known shifts by value and sign."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from registration.images.interpolate import interpolate
from registration.images.resample import coarsen, resample, resample_mask
from registration.maps.field import DisplacementField, sample_map
from registration.maps.rigid import RigidTransform
from registration.volume import Array, Grid, Mask, Volume
from tests.registration.scenes import image_of, make_pattern, oriented, tilted

CENTRE = np.array([20.0, -40.0, 90.0])
TILT = Rotation.from_rotvec([0.2, -0.35, 0.5]).as_matrix()


def linear(points: Array) -> Array:
    return 3.0 * points[:, 0] - 2.0 * points[:, 1] + 0.5 * points[:, 2] - 400.0


@pytest.mark.parametrize("codes", ["RAS", "LAS", "LPS", "SAR", "PIR"])
@pytest.mark.parametrize("tilt", [np.eye(3), TILT])
def test_a_linear_scene_survives_any_orientation_and_rigid_map(codes: str, tilt: Array) -> None:
    moving = image_of(linear, tilted(oriented(codes, (60, 60, 60), 2.0, CENTRE), tilt))
    target = oriented("RAS", (12, 10, 8), 3.0, CENTRE)
    move = RigidTransform.about(CENTRE, np.array([0.1, 0.2, -0.1]), np.array([4.0, -3.0, 5.0]))
    got = resample(moving, target, move)
    assert_allclose(got.hu.ravel(), linear(move(target.points().reshape(-1, 3))), atol=2e-3)


@pytest.mark.parametrize("fill", [-1000.0, 0.0])
def test_parallel_and_turned_grids_give_what_scattered_points_give(fill: float) -> None:
    """Both have ways of their own; parts of the targets lie outside the image, some voxels exactly on its edge."""
    moving = image_of(make_pattern(2), oriented("LAS", (30, 26, 28), 2.0, CENTRE))
    parallel = oriented("RPS", (70, 33, 40), 1.0, CENTRE + np.array([0.5, 14.0, -9.0]))
    for target in (parallel, tilted(parallel, TILT), moving.grid.with_spacing(np.array([1.0, 2.0, 0.5]))):
        points = target.points().reshape(-1, 3)
        want = interpolate(moving.hu, moving.grid, points, fill)
        assert_allclose(resample(moving, target, fill=fill).hu.ravel(), want, atol=2e-3)
        move = RigidTransform.about(CENTRE, np.array([0.0, 0.0, 0.3]), np.array([4.0, -3.0, 5.0]))
        want = interpolate(moving.hu, moving.grid, move(points), fill)
        assert_allclose(resample(moving, target, move, fill).hu.ravel(), want, atol=2e-3)
    assert (want == fill).sum() > 100


def test_a_grid_without_voxels_is_resampled_to_nothing() -> None:
    moving = image_of(make_pattern(2), oriented("LAS", (8, 8, 8), 2.0, CENTRE))
    assert resample(moving, Grid((0, 4, 4), np.diag([3.0, 3.0, 3.0, 1.0]))).hu.shape == (0, 4, 4)


def test_oblique_round_trip_returns_the_scene() -> None:
    pattern = make_pattern(3, shortest_mm=30.0)
    straight = oriented("LPS", (50, 50, 50), 1.5, CENTRE)
    volume = image_of(pattern, straight)
    oblique = tilted(oriented("RAS", (90, 90, 90), 1.0, CENTRE), TILT)
    back = resample(resample(volume, oblique), straight)
    core = (slice(12, -12),) * 3
    assert np.abs(back.hu[core] - volume.hu[core]).max() < 5.0


@pytest.mark.parametrize("shift", [(6.0, -4.0, 3.0), (0.0, 0.0, -5.0)])
def test_a_shift_moves_a_blob_against_the_map(shift: tuple[float, float, float]) -> None:
    grid = oriented("LPS", (40, 40, 40), 1.0, CENTRE)
    blob = image_of(lambda p: 1000 * np.exp(-np.sum((p - CENTRE) ** 2, axis=1) / 18) - 1000, grid)
    seen = resample(blob, grid, lambda p: p + np.array(shift))
    mass = (seen.hu + 1000).ravel()
    assert_allclose(mass @ grid.points().reshape(-1, 3) / mass.sum(), CENTRE - shift, atol=0.02)


def test_a_field_on_the_same_grid_and_the_map_it_samples_agree() -> None:
    pattern = make_pattern(1)
    grid = oriented("LPS", (30, 28, 26), 2.0, CENTRE)
    move = RigidTransform.about(CENTRE, np.array([0.0, 0.1, 0.05]), np.array([1.0, 2.0, 3.0]))
    volume = image_of(pattern, grid)
    assert_allclose(resample(volume, grid, sample_map(move, grid)).hu, resample(volume, grid, move).hu, atol=0.05)


def test_outside_takes_the_fill_value() -> None:
    grid = Grid((4, 4, 4), np.eye(4))
    seen = resample(
        Volume(np.zeros((4, 4, 4), np.float32), np.eye(4)), grid, lambda p: p + np.array([2.5, 0, 0]), fill=-77
    )
    assert_allclose(seen.hu[0], 0)
    assert_allclose(seen.hu[1:], -77)


def test_a_mask_keeps_its_volume_on_a_finer_tilted_grid() -> None:
    grid = oriented("RAS", (40, 40, 40), 2.0, CENTRE)
    ball = Mask(np.linalg.norm(grid.points() - CENTRE, axis=3) < 25, grid.ras_from_ijk)
    fine = tilted(oriented("RAS", (90, 90, 90), 1.0, CENTRE), TILT)
    assert_allclose(resample_mask(ball, fine).inside.sum(), 4 / 3 * np.pi * 25**3, rtol=0.01)


def test_coarsening_keeps_linear_scenes_and_damps_waves_as_a_gaussian() -> None:
    grid = oriented("LPS", (60, 60, 60), 1.0, CENTRE)
    coarse = coarsen(image_of(linear, grid), 3.0)
    core = (slice(3, -3),) * 3
    expected = linear(coarse.grid.points().reshape(-1, 3)).reshape(coarse.grid.shape)
    assert_allclose(coarse.hu[core], expected[core], atol=1e-2)
    wave = image_of(lambda p: 100 * np.cos(2 * np.pi * p[:, 2] / 12), grid)
    damped = coarsen(wave, 3.0)
    variance, wave_number = (3.0**2 - 1.0**2) / 6, 2 * np.pi / 12
    expected = 100 * np.cos(wave_number * damped.grid.points()[..., 2]) * np.exp(-variance * wave_number**2 / 2)
    assert_allclose(damped.hu[:, :, 3:-3], expected[:, :, 3:-3], atol=0.5)


def test_a_displacement_field_of_one_slice_is_linear_along_the_others() -> None:
    vectors = np.zeros((2, 3, 1, 3))
    vectors[1, :, 0, 1] = 4.0
    field = DisplacementField(vectors, np.diag([2.0, 2.0, 5.0, 1.0]))
    points = np.array([[0.5, 1.0, 0.0], [1.5, 3.0, 2.0], [9.0, 0.0, -7.0]])
    assert_allclose(field.displacement(points), [[0, 1, 0], [0, 3, 0], [0, 4, 0]], atol=1e-12)


@pytest.mark.parametrize("slices", [1, 7])
def test_an_image_through_a_field_is_what_it_is_at_the_moved_points_one_by_one(slices: int) -> None:
    """A field on a turned grid of its own that ends inside the target, and an image that does."""
    moving = image_of(make_pattern(3), oriented("LAS", (24, 22, 20), 2.0, CENTRE))
    lattice = tilted(oriented("RAS", (8, 9, slices), 5.0, CENTRE), TILT)
    vectors = np.random.default_rng(2).normal(0, 4, (*lattice.shape, 3)).astype(np.float32)
    field = DisplacementField(vectors, lattice.ras_from_ijk)
    for target in (oriented("RPS", (28, 40, 33), 2.0, CENTRE), lattice):
        one_by_one = interpolate(moving.hu, moving.grid, field(target.points().reshape(-1, 3)), -1000.0)
        got = resample(moving, target, field).hu.ravel()
        assert_allclose(got, one_by_one, atol=1e-3)
        assert 0.02 < (got == -1000).mean() < 0.9
        assert np.ptp(got[got > -1000]) > 20


def test_a_displacement_field_refuses_scalars() -> None:
    with pytest.raises(ValueError, match=r"\(ni, nj, nk, 3\), got \(2, 2, 2\)"):
        DisplacementField(np.zeros((2, 2, 2)), np.eye(4))


def test_distance_to_a_mask_is_that_to_its_nearest_voxel() -> None:
    inside = np.zeros((6, 5, 5), bool)
    inside[1:4, 2, 2] = True
    mask = Mask(inside, np.diag([2.0, 2.0, 2.0, 1.0]))
    assert mask.distance(np.array([4.5, 4.0, 4.0])) == 0
    assert mask.distance(np.array([9.0, 8.0, 4.0])) == pytest.approx(5.0)
    assert mask.distance(np.array([-100.0, 4.0, 4.0])) == pytest.approx(102.0)
    assert Mask(inside & False, np.eye(4)).distance(np.zeros(3)) == np.inf


def test_a_mask_holds_points_in_its_voxels_and_none_beyond_the_grid() -> None:
    inside = np.zeros((4, 3, 2), dtype=bool)
    inside[1, 2, 1] = True
    mask = Mask(inside, np.array([[-2.0, 0, 0, 10], [0, 3, 0, 0], [0, 0, 1, -5], [0, 0, 0, 1]]))
    points = np.array([[8.0, 6, -4], [8.9, 7.4, -4.4], [9.1, 6, -4], [8, 6, -5], [8, 9.5, -4], [1000, 0, 0]])
    assert mask.holds(points).tolist() == [True, True, False, False, False, False]


@pytest.mark.parametrize("rounding", [0.0, 1e-7, -1e-7, 5e-5])
def test_a_part_of_an_image_keeps_its_faces_wherever_rounding_puts_its_corner(rounding: float) -> None:
    whole = Volume(np.arange(1.0, 217.0, dtype=np.float32).reshape(6, 6, 6), np.diag([0.7, 0.7, 1.25, 1.0]))
    part = whole.part((slice(1, 4),) * 3)
    affine = part.ras_from_ijk.copy()
    affine[:3, 3] += rounding
    target = Grid((6, 6, 6), whole.ras_from_ijk)
    back = resample(Volume(part.hu, affine), target, fill=-1000.0)
    assert_allclose(back.hu[1:4, 1:4, 1:4], part.hu, atol=5e-3)
    assert (np.delete(back.hu, slice(1, 4), axis=0) == -1000).all()


def test_a_padded_mask_is_the_same_region_with_room_around_it() -> None:
    mask = Mask(np.ones((2, 3, 4), dtype=bool), np.array([[-2.0, 0, 0, 10], [0, 3, 0, 0], [0, 0, 1, -5], [0, 0, 0, 1]]))
    padded = mask.padded()
    assert padded.inside.shape == (4, 5, 6)
    assert_allclose(padded.grid.to_ras(np.argwhere(padded.inside)), mask.grid.to_ras(np.argwhere(mask.inside)))


@pytest.mark.parametrize("codes", ["RAS", "LPS", "SAR"])
def test_a_coarser_grid_covers_the_same_box_from_corner_to_corner(codes: str) -> None:
    fine = tilted(oriented(codes, (20, 20, 20), 1.5, CENTRE), TILT)
    coarse = fine.with_spacing(fine.spacing * [2, 4, 5])
    assert coarse.shape == (10, 5, 4)
    for corner in (np.zeros(3), np.ones(3), np.array([1, 0, 0.5])):
        assert_allclose(coarse.to_ras(corner * coarse.shape - 0.5), fine.to_ras(corner * fine.shape - 0.5), atol=1e-9)
