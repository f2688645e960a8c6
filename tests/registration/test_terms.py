"""Every metric and penalty: exact gradients against finite differences; Hessians symmetric, exact where quadratic."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.testing import assert_allclose

from registration.correspondences import Correspondences
from registration.images.pyramid import Samples
from registration.kernels.box_sums import box_sums
from registration.maps.bspline import control_grid
from registration.maps.jacobian import Jacobian, cofactor, determinant
from registration.maps.rigid import RigidTransform
from registration.terms.image_term import ImageTerm
from registration.terms.metrics import GlobalNcc, LocalNcc
from registration.terms.objective import Objective, Term
from registration.terms.penalties import Bending, CorrespondingPoints, Folding, barrier
from registration.volume import Grid, Volume
from tests.registration.scenes import image_of, make_pattern, oriented

RNG = np.random.default_rng(5)
CENTRE = np.array([10.0, -30.0, 120.0])
GRID = oriented("LPS", (24, 22, 20), 2.5, CENTRE)
CONTROL = control_grid(GRID, 16.0)
PRIOR = RigidTransform.about(CENTRE, np.array([0.05, -0.1, 0.15]), np.array([2.0, -1.0, 3.0]))
C = RNG.normal(scale=0.7, size=(3, *CONTROL.shape))
POINTS = GRID.to_ras(RNG.uniform(2, 18, (40, 3)))
MATCHED = Correspondences.of(
    POINTS, PRIOR(POINTS) + RNG.normal(scale=3, size=POINTS.shape), weights=RNG.uniform(0.2, 1, 40)
)


def samples() -> Samples:
    return Samples(GRID, np.flatnonzero(np.linalg.norm(GRID.points() - CENTRE, axis=3) < 22))


def image_term(metric: str, seen: bool = False) -> ImageTerm:
    where = samples()
    fixed = image_of(make_pattern(1), GRID).hu.reshape(-1)[where.index].astype(float)
    moving = image_of(make_pattern(1), oriented("RAS", (40, 40, 40), 2.0, CENTRE))
    window = LocalNcc(fixed, where.index, GRID.shape, 2, 10.0)
    half = Volume((moving.grid.points()[..., 0] > CENTRE[0] - 8).astype(np.float32), moving.ras_from_ijk)
    chosen = GlobalNcc(fixed) if metric == "global" else window
    term = ImageTerm(where, chosen, moving, PRIOR, CONTROL, half if seen else None)
    term.refresh(C)
    return term


TERMS: dict[str, Callable[[], Term]] = {
    "global ncc": lambda: image_term("global"),
    "local ncc": lambda: image_term("local"),
    "local ncc, partly outside the moving image's view": lambda: image_term("local", seen=True),
    "bending": lambda: Bending(CONTROL, 200.0),
    "corresponding points": lambda: CorrespondingPoints(CONTROL, MATCHED, PRIOR, 0.05, 3.0),
    "folding": lambda: Folding(CONTROL, samples().blocks()[0], PRIOR, 1.0),
}


@pytest.mark.parametrize("name", TERMS)
def test_gradients_agree_with_finite_differences(name: str) -> None:
    term = TERMS[name]()
    c = C * (12.0 if name == "folding" else 1.0)
    gradient = term.model(c).gradient
    rng = np.random.default_rng(7)
    for _ in range(3):
        d = rng.normal(size=c.shape) + np.sign(gradient)
        h = 2e-6 if "ncc" in name else 1e-4
        difference = (term.value(c + h * d) - term.value(c - h * d)) / (2 * h)
        assert abs(difference) > 0
        assert_allclose(np.vdot(gradient, d), difference, rtol=1e-5)


@pytest.mark.parametrize("name", TERMS)
def test_hessians_are_symmetric_and_positive(name: str) -> None:
    model = TERMS[name]().model(C * (12.0 if name == "folding" else 1.0))
    rng = np.random.default_rng(8)
    a, b = rng.normal(size=(2, *C.shape))
    ha, hb = model.apply(a), model.apply(b)
    assert_allclose(np.vdot(a, hb), np.vdot(b, ha), rtol=1e-4)
    assert np.vdot(a, ha) > 0
    assert np.all(model.diagonal >= 0)


@pytest.mark.parametrize("name", ["bending"])
def test_quadratic_terms_are_their_own_models(name: str) -> None:
    term = TERMS[name]()
    model, d = term.model(C), np.random.default_rng(9).normal(size=C.shape)
    predicted = model.value + np.vdot(model.gradient, d) + 0.5 * np.vdot(d, model.apply(d))
    assert_allclose(term.value(C + d), predicted, rtol=1e-6)


def test_a_sum_of_terms_adds_values_gradients_and_hessians() -> None:
    parts = [TERMS["bending"](), TERMS["corresponding points"]()]
    whole, each = Objective(parts).model(C), [p.model(C) for p in parts]
    assert_allclose(whole.value, each[0].value + each[1].value)
    assert_allclose(whole.gradient, each[0].gradient + each[1].gradient)
    assert_allclose(whole.apply(C), each[0].apply(C) + each[1].apply(C))


def test_the_global_coefficient_is_numpys_and_ignores_scale_and_offset() -> None:
    f, m = RNG.normal(size=(2, 500))
    metric, w = GlobalNcc(f), np.ones(500)
    assert_allclose(metric.evaluate(m, w).value, 1 - np.corrcoef(f, m)[0, 1], rtol=1e-10)
    assert_allclose(metric.evaluate(3 * f - 100, w).value, 0, atol=1e-12)
    assert_allclose(metric.evaluate(-f, w).value, 2, rtol=1e-12)


def test_the_local_coefficient_sees_through_a_drifting_gain() -> None:
    where, grid = samples(), GRID
    f = image_of(make_pattern(1), grid).hu.reshape(-1)[where.index].astype(float)
    x = where.points()[:, 0] - CENTRE[0]
    m = f * (1 + 0.02 * x) - 3 * x
    w = np.ones(len(f))
    local = LocalNcc(f, where.index, grid.shape, 2, 1.0).evaluate(m, w).value
    assert local < 0.5 * GlobalNcc(f).evaluate(m, w).value


def test_box_sums_are_windows() -> None:
    values = RNG.normal(size=(7, 9, 8))
    padded = np.pad(values, 2)
    expected = sum(
        padded[2 + a : 9 + a, 2 + b : 11 + b, 2 + c : 10 + c]
        for a in range(-2, 3)
        for b in range(-2, 3)
        for c in range(-2, 3)
    )
    assert_allclose(box_sums(np.stack([values, 2 * values]), 2), [expected, 2 * expected], atol=1e-12)


def test_the_jacobian_of_an_affine_map_by_value() -> None:
    a = np.array([[0.1, 0.05, 0.0], [-0.02, -0.2, 0.1], [0.0, 0.03, 0.15]])
    c = np.moveaxis(CONTROL.points() @ a.T, 3, 0)
    blocks = Grid((4, 4, 4), GRID.with_spacing(5.0).ras_from_ijk)
    jacobian = Jacobian(CONTROL, blocks, PRIOR)
    f = jacobian.gradient(c)
    assert_allclose(f, np.broadcast_to((PRIOR.matrix[:3, :3] + a)[..., None, None, None], f.shape), atol=1e-9)
    assert_allclose(determinant(f), np.linalg.det(PRIOR.matrix[:3, :3] + a), rtol=1e-9)
    inverse = np.linalg.inv(f[:, :, 0, 0, 0])
    assert_allclose(cofactor(f)[:, :, 0, 0, 0], determinant(f)[0, 0, 0] * inverse.T, rtol=1e-8, atol=1e-10)


def test_the_barrier_rises_smoothly_from_its_knee_and_never_stops() -> None:
    det = np.array([0.5, 0.3, 0.15, 0.02, -0.1])
    value, slope, _ = barrier(det)
    assert_allclose(value[:4], [0, 0, 1, 196])
    h = 1e-6
    numeric = (barrier(det + h)[0] - barrier(det - h)[0]) / (2 * h)
    assert_allclose(slope, numeric, atol=1e-3, rtol=1e-4)
    assert value[4] > value[3]
