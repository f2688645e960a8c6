"""A phantom's CT taken as a scan: its twin's frame, map, mass and nodule, and the states of its breath."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import ndimage

from phantoms import PhantomCase, PhantomSpec
from phantoms.anatomy import spine_y
from phantoms.breathing import breathe, volume_signal
from phantoms.spec import Lesion
from phantoms.twin import Scan, TwinBase, chest_frame, make_breath, make_twin, twin_base, without_lung
from phantoms.voxels import Grid, Image, Region

FAR = np.array([40.0, -25.0, 310.0])
SPEC = PhantomSpec("twin", "right", cbct_spacing=(3.0, 3.0, 3.0), element=24.0, lesion=Lesion(radius=9.0))


@pytest.fixture(scope="module")
def scan(lobed: PhantomCase) -> Scan:
    """The CT of the phantom, moved far from the frame it was drawn in; its other lung found as the air on that side."""
    move = np.eye(4)
    move[:3, 3] = FAR
    affine = move @ lobed.ct.ras_from_ijk
    x, y, z = np.moveaxis(lobed.ct.grid.points(), -1, 0)
    build = lobed.patient.build
    chest = (np.abs(x) < build.width) & (np.abs(y) < build.depth) & (z > build.dome[1] - 60)
    other = ndimage.binary_opening(chest & (x < -4) & (lobed.ct.hu < -600), iterations=2)
    labels, _ = ndimage.label(other)
    other = labels == np.bincount(labels.ravel())[1:].argmax() + 1
    heights = np.arange(-150.0, 100.0, 5.0)
    # The vertebral column's middle is some 15 mm behind that of the vertebral bodies.
    spine = np.stack([0 * heights, spine_y(build, heights) - 15, heights], axis=1) + FAR
    lungs = {"right": Region(lobed.masks["lung_ct"].inside, affine), "left": Region(other, affine)}
    return Scan(Image(lobed.ct.hu, affine), lungs, spine, lobed.patient.hilum + FAR)


@pytest.fixture(scope="module")
def base(scan: Scan) -> TwinBase:
    return twin_base(scan, SPEC, 0, np.random.default_rng(0))


@pytest.fixture(scope="module")
def twin(scan: Scan) -> PhantomCase:
    return make_twin(scan, SPEC, 3)


def test_frame_of_the_chest_is_found_again(scan: Scan, lobed: PhantomCase) -> None:
    origin, build = chest_frame(scan)
    drawn = lobed.patient.build
    assert_allclose(origin[[0, 1]], FAR[[0, 1]], atol=8)
    assert build.width == pytest.approx(drawn.width, abs=8)
    lung = lobed.patient.lung
    top = lung.points()[lung.values.ravel() < 0][:, 2].max()
    assert build.apex + origin[2] - FAR[2] == pytest.approx(top, abs=6)
    assert_allclose(np.array(build.dome) + origin[2] - FAR[2], drawn.dome, atol=15)
    heights = np.array([-100.0, -50, 0])
    ours = spine_y(build, heights) + origin[1] - FAR[1]
    assert_allclose(ours, spine_y(drawn, heights) - 15, atol=12)


def test_twin_keeps_the_scan_and_gets_a_nodule(twin: PhantomCase, scan: Scan) -> None:
    assert_allclose(twin.ct.ras_from_ijk, scan.ct.ras_from_ijk, atol=1e-9)
    far = np.linalg.norm(twin.ct.grid.points() - twin.nodule_ct, axis=-1) > 14
    assert np.array_equal(twin.ct.hu[far], scan.ct.hu[far])
    inside = twin.nodule.inside & scan.lungs["right"].inside
    assert inside.sum() == twin.nodule.inside.sum()
    assert np.median(twin.ct.hu[twin.nodule.inside]) == pytest.approx(25, abs=15)
    for image, truth in ((twin.cbct_inflated, twin.nodule_inflated), (twin.cbct_deflated, twin.nodule_deflated)):
        near = np.argwhere(np.linalg.norm(image.grid.points() - truth, axis=-1) < 11)
        bright = near[image.hu[tuple(near.T)] > -350]
        assert_allclose(image.grid.to_ras(bright.mean(axis=0)), truth, atol=2.0)


def test_twin_is_mapped_both_ways_and_collapses(twin: PhantomCase, scan: Scan) -> None:
    origin, _ = chest_frame(scan)
    back, left = twin.deflated.to_ct(twin.dense_truth[:, 6:])
    assert_allclose(back + origin, twin.dense_truth[:, :3], atol=0.01)
    assert left.max() < 0.01
    assert twin.info["volume_ratio"][1] == pytest.approx(0.52, abs=0.02)
    assert min(twin.info["smallest_determinant"]) > 0.1
    assert scan.lungs["right"].inside[tuple(np.rint(scan.ct.grid.to_ijk(twin.landmarks_ct)).astype(int).T)].all()


def test_given_nodule_is_followed_and_not_painted(scan: Scan, lobed: PhantomCase) -> None:
    given = replace(scan, nodule=Region(lobed.nodule.inside, scan.ct.ras_from_ijk))
    base = twin_base(given, SPEC, 0, np.random.default_rng(0))
    assert np.array_equal(base.ct.hu, scan.ct.hu)
    assert_allclose(base.patient.nodule.centre + base.origin, lobed.nodule_ct + FAR, atol=1e-6)
    assert base.patient.nodule.radius == pytest.approx(lobed.spec.lesion.radius, rel=0.15)


def test_lung_is_filled_with_flesh(scan: Scan) -> None:
    body = without_lung(scan.ct, scan.lungs["right"])
    inside = scan.lungs["right"].inside
    assert body.hu[inside].min() > -250
    assert np.array_equal(
        body.hu[~ndimage.binary_dilation(inside, iterations=3)],
        scan.ct.hu[~ndimage.binary_dilation(inside, iterations=3)],
    )


def test_breath_starts_at_the_scan_and_reaches_its_volumes(base: TwinBase) -> None:
    volume = volume_signal(10, 0.8)
    assert volume[0] == 1
    assert volume[5] == pytest.approx(0.8)
    assert_allclose(volume[1:5], volume[:5:-1])
    breath = breathe(base.patient, base.body, volume[[0, 2, 5]], 30.0, np.random.default_rng(1))
    points = breath.states[0].samples
    points = points[base.patient.lung.sample(points) < -1]
    assert_allclose(breath.states[0].from_ct(points), points, atol=1e-9)
    reached = [s.lung_map.determinant(points) for s in breath.states]
    assert_allclose([r.mean() for r in reached], volume[[0, 2, 5]], atol=0.02)
    assert min(r.min() for r in reached) > 0.2
    # The base of the lung rises, its apex stays.
    low, high = points[:, 2] < np.percentile(points[:, 2], 10), points[:, 2] > np.percentile(points[:, 2], 90)
    rise = (breath.states[-1].from_ct(points) - points)[:, 2]
    assert rise[low].mean() > 3 * abs(rise[high].mean())
    grid = Grid((60, 60, 60), np.array([[6.0, 0, 0, -180], [0, 6, 0, -180], [0, 0, 6, -180], [0, 0, 0, 1]]))
    first, last = (i.hu for i in replace(breath, states=breath.states[::2]).images(grid))
    # Gas leaves, tissue stays: what is not gas grows as the volume shrinks.
    deep = points[base.patient.lung.sample(points) < -12]
    tissue = []
    for hu, at in ((first, deep), (last, breath.states[-1].from_ct(deep))):
        ijk = (at - grid.ras_from_ijk[:3, 3]) / 6.0
        tissue.append(1000 + ndimage.map_coordinates(hu, ijk.T, order=1).mean())
    assert tissue[1] / tissue[0] == pytest.approx(1 / 0.8, rel=0.08)


def test_breath_of_a_scan_without_a_lung_is_refused(scan: Scan) -> None:
    empty = Region(np.zeros(scan.ct.hu.shape, dtype=bool), scan.ct.ras_from_ijk)
    with pytest.raises(ValueError, match="too little of the left lung"):
        make_breath(replace(scan, lungs=scan.lungs | {"left": empty}), "right", 10, 0.8)


def test_a_scan_of_a_lung_too_thin_for_a_nodule_says_how_deep_it_is(scan: Scan) -> None:
    right = scan.lungs["right"]
    x = right.grid.points()[..., 0]
    thin = Region(right.inside & (x > np.percentile(x[right.inside], 60)), right.ras_from_ijk)
    deep = replace(SPEC, lesion=Lesion(depth=45.0))
    with pytest.raises(ValueError, match=r"no place for a nodule 45 mm below the pleura .* lies \d+ mm below"):
        make_twin(replace(scan, lungs=scan.lungs | {"right": thin}), deep)
