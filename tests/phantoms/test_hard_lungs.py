"""Hidden nodules, airless tissue, empty vessels, fluid, disease, children, steel: each only where it is asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from phantoms import SPECS, SUITE, PhantomCase, PhantomSpec, make_case
from phantoms.disease import diseased, emphysema_of, fibrosis_of
from phantoms.fields import patches
from phantoms.imaging import AIRLESS_HU, FLUID_HU, PLEURAL_AIR_HU, Look, State, image_state
from phantoms.ports import draw_ports
from phantoms.spec import Collapse, Disease, Lesion
from phantoms.states import airless_of, lung_body
from phantoms.thorax import draw_thorax, operated_lung
from phantoms.voxels import Array, Grid, Image

COARSE = PhantomSpec("coarse", "left", ct_spacing=(4.0, 4.0, 4.0), cbct_spacing=(3.0, 3.0, 3.0), element=28.0)


def _grid(case: PhantomCase) -> Grid:
    """Every other voxel of the deflated image."""
    return Grid((80, 80, 56), case.cbct_deflated.grid.ras_from_ijk @ np.diag([2.0, 2.0, 2.0, 1.0]))


def _shown(case: PhantomCase, points: Array) -> Array:
    """Which of points (n, 3) lie in the deflated image."""
    ijk = _grid(case).to_ijk(points)
    return np.all((ijk > 0) & (ijk < np.array([79, 79, 55])), axis=1)


def _clean(case: PhantomCase, state: State, seen: str = "all") -> Array:
    """HU of a state of the demo on the deflated image's voxels, without noise, walls of plain flesh."""
    flesh = Image(np.full(case.ct.hu.shape, 40, dtype=np.float32), case.ct.ras_from_ijk)
    patient = replace(case.patient, nodule=replace(case.patient.nodule, seen=seen))
    return image_state(patient, flesh, state, _grid(case)).clean.hu


def _at(case: PhantomCase, hu: Array, points: Array) -> Array:
    i, j, k = np.rint(_grid(case).to_ijk(points)).astype(int).T
    return hu[i, j, k]


@pytest.mark.parametrize(
    ("seen", "inflated", "deflated"), [("all", True, True), ("ct and inflated", True, False), ("ct", False, False)]
)
def test_a_nodule_is_shown_by_the_images_that_are_to_show_it(
    demo: PhantomCase, seen: str, inflated: bool, deflated: bool
) -> None:
    for state, at, shown in (
        (demo.inflated, demo.nodule_inflated, inflated),
        (demo.deflated, demo.nodule_deflated, deflated),
    ):
        density = _at(demo, _clean(demo, state, seen), at[None])[0]
        assert (density > -150) == shown
        assert shown or -950 < density < -500
    assert demo.patient.nodule.stiffening > 1
    assert replace(demo.patient.nodule, seen="ct").stiffening == 1.0


def test_an_unknown_way_to_be_seen_is_refused() -> None:
    with pytest.raises(ValueError, match="a lesion is seen in 'all', 'ct and inflated' or 'ct', got 'never'"):
        make_case(replace(COARSE, lesion=Lesion(seen="never")))


def test_what_empties_lobes_and_tissue_acts_only_when_the_wall_has_let_go(lobed: PhantomCase) -> None:
    hard = Collapse(0.86, 0.28, lobes_apart=0.3, airless=0.3)
    gas = airless_of(lobed.patient, hard, np.array([-1.0, 0.0, 0.0]))
    calm, torn = (
        lung_body(lobed.patient, collapse, 28.0, np.random.default_rng(0), None, airless)
        for collapse, airless in ((replace(hard, lobes_apart=0.0), None), (hard, gas))
    )
    assert_allclose(torn.held.rest, calm.held.rest, rtol=1e-12)
    assert_allclose(torn.held.shear, calm.held.shear, rtol=1e-12)
    # Neo-Hookean tension is greatest at a stretch of 1.5; beyond, what is stretched more pulls less.
    assert np.quantile(1 / torn.held.rest, 0.95) < 1.45
    assert np.median(1 / calm.tissue.rest) > 1.5
    emptied = [np.mean((torn.tissue.rest / calm.tissue.rest)[torn.tissue.lobe == lobe] ** 3) for lobe in range(3)]
    assert max(emptied) / min(emptied) > 1.5


def test_airless_tissue_is_dense_and_as_large_as_asked_and_hangs(demo: PhantomCase) -> None:
    down = np.array([-1.0, 0.0, 0.0])
    found = airless_of(demo.patient, Collapse(airless=0.3), down)
    assert found is not None
    tissue = demo.deflated.samples[demo.patient.lung.sample(demo.deflated.samples) < -4]
    share = found.sample(tissue)
    assert share.mean() == pytest.approx(0.3, abs=0.06)
    hangs = tissue @ down
    assert share[hangs > np.quantile(hangs, 0.7)].mean() > 1.5 * share[hangs < np.quantile(hangs, 0.3)].mean()
    hu = _clean(demo, replace(demo.deflated, look=Look(airless=found)))
    before = _clean(demo, demo.deflated)
    at = demo.deflated.from_ct(tissue)
    shown = _shown(demo, at)
    at, share = at[shown], share[shown]
    assert np.median(_at(demo, hu, at[share > 0.99])) == pytest.approx(AIRLESS_HU, abs=8)
    assert np.median(np.abs(_at(demo, hu, at[share == 0]) - _at(demo, before, at[share == 0]))) < 1
    assert airless_of(demo.patient, Collapse(), down) is None


def test_vessels_that_empty_darken_the_lung_and_nothing_else(demo: PhantomCase) -> None:
    full, empty = (_clean(demo, replace(demo.deflated, look=Look(vessels=v))) for v in (1.0, 0.4))
    points = demo.deflated.from_ct(demo.deflated.samples)
    points = points[_shown(demo, points)]
    before, after = (_at(demo, hu, points) for hu in (full, empty))
    assert after.mean() < before.mean() - 5
    assert np.percentile(after, 10) == pytest.approx(np.percentile(before, 10), abs=4)
    flesh = full == 40
    assert flesh.mean() > 0.3
    assert (empty[flesh] == 40).mean() > 0.995


def test_fluid_fills_what_gas_would_below_its_level(demo: PhantomCase) -> None:
    state = demo.deflated
    room = state.cavity.points()[state.cavity.values.ravel() < -3]
    down = np.array([0.0, -1.0, 0.0])
    level = float(np.median(room @ down))
    wet, dry = (_clean(demo, replace(state, look=look)) for look in (Look(down=down, level=level), Look()))
    at = state.posed(room)
    shown = _shown(demo, at)
    gas = _at(demo, dry, at[shown]) < PLEURAL_AIR_HU + 1
    below = (room[shown] @ down > level + 3) & gas
    above = (room[shown] @ down < level - 3) & gas
    assert below.sum() > 50
    assert above.sum() > 50
    assert_allclose(np.median(_at(demo, wet, at[shown][below])), FLUID_HU, atol=1)
    assert_allclose(np.median(_at(demo, wet, at[shown][above])), PLEURAL_AIR_HU, atol=1)


def test_diseases_fill_their_shares_and_change_density_there_only() -> None:
    thorax = draw_thorax("right", "average", Lesion(), 3)
    lung = operated_lung(thorax.shapes, "right")
    inside = lung.points()[lung.values.ravel() < -3]
    for disease, of, sign in (
        (Disease(emphysema=0.3), emphysema_of, -1),
        (Disease(fibrosis=0.4), fibrosis_of, 1),
    ):
        where = of(lung, disease, 3)
        assert where.sample(lung.points()[lung.values.ravel() < 0]).mean() == pytest.approx(
            disease.emphysema + disease.fibrosis, abs=0.03
        )
        change = diseased(thorax.parenchyma, lung, disease, 3).sample(inside) - thorax.parenchyma.sample(inside)
        share = where.sample(inside)
        assert sign * change[share > 0.95].mean() > 40
        assert abs(change[share < 0.01]).mean() < 6


def test_a_healthy_lung_is_left_as_it_is(demo: PhantomCase) -> None:
    tissue = demo.patient.parenchyma
    assert diseased(tissue, demo.patient.lung, Disease(), 3) is tissue


def test_patches_fill_the_share_asked_for(demo: PhantomCase) -> None:
    lung = demo.patient.lung
    for share in (0.0, 0.2, 0.6):
        found = patches(lung, share, 20.0, np.random.default_rng(0), np.zeros(lung.values.shape))
        assert found.values[lung.values < 0].mean() == pytest.approx(share, abs=0.02)


def test_a_port_goes_through_the_wall_into_the_room(demo: PhantomCase) -> None:
    grid = demo.cbct_deflated.grid
    scene = Image(np.full(grid.shape, 40, dtype=np.float32), grid.ras_from_ijk)
    up = np.array([demo.patient.sign, 0.0, 0.0])
    draw_ports(scene, demo.deflated, 2, up, np.random.default_rng(1))
    steel = grid.to_ras(np.argwhere(scene.hu > 8000))
    depth = demo.deflated.cavity.at(demo.deflated.unposed(steel))
    assert len(steel) > 200
    # A tube as wide as 5.5 mm that is aslant to the wall reaches deeper on one side.
    assert -12 - 8 < depth.min() < -12 + 4
    assert (depth > 10).any()


def test_a_child_is_an_adult_made_smaller_under_the_same_scanner() -> None:
    small = make_case(replace(COARSE, size=0.7, ct_spacing=(2.8, 2.8, 2.8), cbct_spacing=(3.0, 3.0, 3.0)), 4)
    adult = make_case(replace(COARSE, lesion=Lesion(depth=15.0 / 0.7, radius=8.0 / 0.7)), 4)
    assert_allclose(small.nodule_ct, 0.7 * adult.nodule_ct, atol=0.5)
    assert small.masks["lung_ct"].inside.sum() * 2.8**3 == pytest.approx(
        0.343 * adult.masks["lung_ct"].inside.sum() * 4.0**3, rel=1e-3
    )
    assert_allclose(small.cbct_deflated.grid.spacing, 3.0)
    assert small.cbct_deflated.hu.shape == adult.cbct_deflated.hu.shape
    moved = small.deflated.from_ct(small.nodule_ct[None] / 0.7)[0] * 0.7
    assert_allclose(moved, small.nodule_deflated, atol=1.5)


def test_half_of_the_suite_hides_its_nodule_and_more_than_half_is_seen_by_a_c_arm() -> None:
    specs = [SPECS[name] for name in SUITE]
    assert len(specs) >= 20
    assert sum(s.lesion.seen != "all" for s in specs) >= len(specs) / 2
    assert sum(s.scanner.domain == "projection" for s in specs) >= len(specs) / 2
    depths = np.array([s.lesion.depth for s in specs])
    assert 3 <= depths.min() <= depths.max() <= 30
    assert np.mean((depths >= 5) & (depths <= 15)) > 0.5
    hard = [s for s in specs if s.collapse.airless > 0]
    assert len(hard) >= 8
    assert sum(s.collapse.deflated / s.collapse.inflated <= 0.45 for s in hard) >= 6
