"""Truth of a whole case: the map, the mass, the wall, and that the images show what the points say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import ndimage

from phantoms import SPECS, PhantomCase, PhantomSpec, make_case
from phantoms.cbct import scanner_grid
from phantoms.imaging import State, image_state
from phantoms.lobes import Fissures
from phantoms.measures import fissure_jump, lobe_overlap
from phantoms.thorax import ct_grid, draw_thorax, image_body
from phantoms.voxels import Image
from registration.volume import axis_codes

COARSE = PhantomSpec("coarse", "left", ct_spacing=(4.0, 4.0, 4.0), cbct_spacing=(4.0, 4.0, 4.0), element=28.0)


def _states(case: PhantomCase) -> list[tuple[str, State, Image]]:
    return [
        ("inflated", case.inflated, case.cbct_inflated),
        ("deflated", case.deflated, case.cbct_deflated),
    ]


def test_map_and_inverse_agree_at_two_thousand_points(case: PhantomCase) -> None:
    for n, (_, state, _) in enumerate(_states(case)):
        moved = case.dense_truth[:, 3 * n + 3 : 3 * n + 6]
        back, left = state.to_ct(moved)
        off = np.linalg.norm(back - case.dense_truth[:, :3], axis=1)
        # Lobes press a little into each other: there, and only there, two sources claim a place.
        beside = case.patient.lobes.fissures.distance(case.dense_truth[:, :3]) < 1.0
        assert off[~beside | (len(state.lung_map.pieces) == 1)].max() < 0.01
        assert left.max() < 0.01


def test_no_tissue_is_folded(case: PhantomCase) -> None:
    lung = case.inflated.lung
    points = lung.points()[lung.values.ravel() < 0]
    for _, state, _ in _states(case):
        assert state.lung_map.determinant(points).min() > 0.1


def test_volumes_are_those_asked_for(case: PhantomCase) -> None:
    inflated, deflated = case.info["volume_ratio"]
    # The held pleura hangs a tenth of a millimetre off the wall, which costs the inflated lung some volume.
    assert inflated == pytest.approx(case.spec.collapse.inflated, abs=0.03)
    assert deflated == pytest.approx(case.spec.collapse.deflated, abs=0.015)


def test_mass_of_the_lung_is_kept(case: PhantomCase) -> None:
    far = replace(case.patient.nodule, centre=np.array([1e4, 0.0, 0.0]))
    lobes = case.patient.lobes
    away = replace(lobes.fissures.oblique, hilum=np.array([0.0, 0.0, 1e4]))
    lobes = replace(lobes, fissures=Fissures(away, None))
    patient = replace(case.patient, trees=None, nodule=far, lobes=lobes)
    lung = case.inflated.lung
    inside = lung.values.ravel() < 0
    before = (patient.parenchyma.at(lung.points()[inside]) + 1000).sum() * lung.spacing**3
    for _, state, _ in _states(case):
        middle = state.posed(state.lung_map(state.samples)).mean(axis=0)
        grid = scanner_grid(middle, (3.0, 3.0, 3.0), 340.0, 260.0)
        body = Image(np.full((4, 4, 4), -1000, dtype=np.float32), np.diag([1.0, 1, 1, 1]))
        hu = image_state(patient, body, state, grid).clean.hu
        after = (hu[hu > -990] + 1000).sum() * 3.0**3
        assert after == pytest.approx(before, rel=0.01)


def test_lung_slides_along_the_wall_and_stays_on_it(case: PhantomCase) -> None:
    lung, state = case.inflated.lung, case.inflated
    points = lung.points()
    skin = points[(np.abs(lung.values.ravel()) < 1.0) & (points[:, 0] > 85) & (points[:, 2] > -60)]
    _, normal = lung.with_gradient(skin)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    jump = state.lung_map(skin) - state.motion(skin)
    along = np.linalg.norm(jump - (jump * normal).sum(axis=1, keepdims=True) * normal, axis=1)
    assert along.mean() > 3.0
    assert np.abs(state.cavity.at(state.lung_map(skin)) - lung.at(skin)).mean() < 0.6


def test_lobes_slide_along_the_fissures_and_part_only_when_collapsed(lobed: PhantomCase) -> None:
    (slid_held, parted_held), (slid, parted) = (fissure_jump(s) for s in (lobed.inflated, lobed.deflated))
    assert np.linalg.norm(slid_held, axis=1).mean() > 2.0
    assert np.abs(parted_held).mean() < 0.5
    assert np.linalg.norm(slid, axis=1).max() > 10.0
    assert np.percentile(parted, 95) > 2.0
    assert max(np.percentile(lobe_overlap(s), 99) for s in (lobed.inflated, lobed.deflated)) < 0.4
    assert lobed.info["fissure_slip_mm"][1][2] == pytest.approx(np.linalg.norm(slid, axis=1).max())


def test_landmarks_and_nodule_lie_inside_one_lobe(lobed: PhantomCase) -> None:
    lobes = lobed.patient.lobes
    depth = np.sort([r.at(lobed.landmarks_ct) for r in lobes.regions], axis=0)
    assert depth[0].max() < -1.0
    assert depth[1].min() > 0.5
    assert len(set(lobes.at(lobed.landmarks_ct))) == 3
    nodule = np.argwhere(lobed.nodule.inside)
    assert len(set(lobes.at(lobed.nodule.grid.to_ras(nodule)))) == 1


def test_vessels_feed_their_own_lobe(lobed: PhantomCase) -> None:
    lobes = lobed.patient.lobes
    trees = lobed.patient.trees
    assert trees is not None
    for tree in (trees.airway, trees.artery, trees.vein):
        fine = tree.generation > 2
        assert np.array_equal(lobes.at(tree.nodes[fine]), tree.cloud[fine])


def test_collapsed_lung_sinks_inside_its_room(demo: PhantomCase) -> None:
    lung = demo.deflated.lung
    skin = lung.points()[np.abs(lung.values.ravel()) < 1.0]
    depth = demo.deflated.cavity.at(demo.deflated.lung_map(skin))
    assert np.percentile(depth, 99.5) < 2.0
    # More than a quarter of the pleura faces gas.
    assert (depth < -4).mean() > 0.25


def test_initial_errors_are_those_of_the_clinic(demo: PhantomCase) -> None:
    assert 7 < demo.info["pose_mm"][0] < 15
    assert 12 < demo.info["pneumothorax_mm"][0] < 25
    assert 30 <= len(demo.landmarks_ct) <= 60


def test_best_affine_map_leaves_as_much_as_in_real_lungs(demo: PhantomCase) -> None:
    source, moved = demo.dense_truth[:, 3:6], demo.dense_truth[:, 6:]
    back = demo.deflated.unposed(moved), demo.inflated.unposed(source)
    motion = np.linalg.norm(back[0] - back[1], axis=1).mean()
    rows = np.c_[back[1], np.ones(len(source))]
    fit = rows @ np.linalg.lstsq(rows, back[0], rcond=None)[0]
    assert 0.12 < np.linalg.norm(fit - back[0], axis=1).mean() / motion < 0.4


@pytest.mark.parametrize("name", ["inflated", "deflated"])
def test_nodule_is_seen_where_the_truth_says(demo: PhantomCase, name: str) -> None:
    image, truth = (
        (demo.cbct_inflated, demo.nodule_inflated) if name == "inflated" else (demo.cbct_deflated, demo.nodule_deflated)
    )
    mask = demo.masks[f"nodule_{name}"]
    assert_allclose(mask.grid.to_ras(np.argwhere(mask.inside).mean(axis=0)), truth, atol=0.3)
    near = np.argwhere(np.linalg.norm(image.grid.points() - truth, axis=-1) < 1.15 * demo.spec.lesion.radius)
    bright = near[image.hu[tuple(near.T)] > -350]
    assert_allclose(image.grid.to_ras(bright.mean(axis=0)), truth, atol=1.0)


def test_landmarks_lie_on_structures_in_every_image(demo: PhantomCase) -> None:
    for image, marks in (
        (demo.ct, demo.landmarks_ct),
        (demo.cbct_inflated, demo.landmarks_inflated),
        (demo.cbct_deflated, demo.landmarks_deflated),
    ):
        smooth = ndimage.gaussian_filter(image.hu, 1.0 / image.grid.spacing)
        wide = ndimage.gaussian_filter(image.hu, 6.0 / image.grid.spacing)
        contrast = np.abs(ndimage.map_coordinates(smooth - wide, image.grid.to_ijk(marks).T, order=1))
        shifted = marks + np.array([7.0, -6.0, 6.0])
        beside = np.abs(ndimage.map_coordinates(smooth - wide, image.grid.to_ijk(shifted).T, order=1))
        assert np.median(contrast) > 2 * np.median(beside)


def test_tissues_have_their_densities(demo: PhantomCase) -> None:
    ct = demo.ct
    lung = ndimage.binary_erosion(demo.masks["lung_ct"].inside, iterations=3)
    # Real scans (see test_densities): -888 to -876.
    assert -900 < np.median(ct.hu[lung]) < -850
    assert 30 < np.median(ct.hu[(ct.hu > 0) & (ct.hu < 150)]) < 60
    assert np.percentile(ct.hu, 99.5) > 300
    deflated = ndimage.binary_erosion(demo.masks["lung_deflated"].inside, iterations=3)
    room = demo.deflated.cavity.at(demo.deflated.unposed(demo.cbct_deflated.grid.points().reshape(-1, 3)))
    gas = (room.reshape(deflated.shape) < -4) & ~ndimage.binary_dilation(
        demo.masks["lung_deflated"].inside, iterations=4
    )
    inside = np.ones_like(gas)
    i, j = (np.indices(gas.shape[:2]) - (gas.shape[0] - 1) / 2) * demo.cbct_deflated.grid.spacing[0]
    inside[np.hypot(i, j) > 110] = False
    assert np.median(demo.cbct_deflated.hu[gas & inside]) < -960
    assert np.percentile(demo.cbct_deflated.hu[deflated], 5) > -900


@pytest.mark.parametrize("habitus", ["average", "obese"])
def test_bones_lie_under_the_skin_and_the_skin_inside_the_image(habitus: str) -> None:
    person = draw_thorax("right", habitus, SPECS["demo"].lesion, 0)
    grid = ct_grid(person, (4.0, 4.0, 4.0))
    skin = person.shapes.body
    bone = image_body(person, grid, ("right", "left")) > 250
    assert bone.sum() > 5_000
    assert skin.on(grid)[bone].max() < 1.0
    assert min(skin.values[[0, -1]].min(), skin.values[:, [0, -1]].min()) > 2.0


def test_headers_agree_within_what_a_case_may_ask(demo: PhantomCase) -> None:
    for _, state, image in _states(demo):
        turn = np.degrees(np.arccos((np.trace(state.pose[:3, :3]) - 1) / 2))
        assert 4 < turn < 25
        centre = image.grid.to_ras((np.array(image.grid.shape) - 1) / 2)
        assert np.linalg.norm(state.unposed(centre[None])[0] - centre) < 100
        assert axis_codes(image.ras_from_ijk) == "LPS"
        assert_allclose(state.unposed(state.posed(demo.landmarks_ct)), demo.landmarks_ct, atol=1e-9)


def test_operated_lung_is_in_view(demo: PhantomCase) -> None:
    for _, state, image in _states(demo):
        ijk = image.grid.to_ijk(state.from_ct(state.samples))
        off = (ijk - (np.array(image.grid.shape) - 1) / 2) * image.grid.spacing
        half = image.grid.shape[2] * image.grid.spacing[2] / 2
        assert ((np.hypot(off[:, 0], off[:, 1]) < 120) & (np.abs(off[:, 2]) < half)).mean() > 0.4


@pytest.fixture(scope="module")
def left() -> PhantomCase:
    return make_case(COARSE, 5)


def test_equal_seeds_give_equal_cases_and_others_do_not(demo: PhantomCase, left: PhantomCase) -> None:
    same = make_case(COARSE, 5)
    assert np.array_equal(left.ct.hu, same.ct.hu)
    assert np.array_equal(left.cbct_deflated.hu, same.cbct_deflated.hu)
    assert np.array_equal(left.dense_truth, same.dense_truth)
    assert left.patient.build.width != demo.patient.build.width


def test_left_case_collapses_on_the_left(left: PhantomCase) -> None:
    assert left.side == "left"
    assert left.nodule_ct[0] < 0
    assert left.gravity_cbct[0] > 0.8
    assert left.dense_truth[:, 0].max() < 10
    gas = left.deflated.cavity.at(left.deflated.lung_map(left.deflated.samples))
    assert gas.min() < -20


def test_unknown_names_and_sides_are_refused() -> None:
    with pytest.raises(ValueError, match="no phantom is called 'nobody', choose one of demo"):
        make_case("nobody")
    with pytest.raises(ValueError, match="side must be 'right' or 'left'"):
        make_case(replace(SPECS["demo"], side="up"))
