"""Finite strain: tangents, closed-form compression, the linear limit, contact, and when it is chosen."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from materials import saint_venant_kirchhoff
from numpy.testing import assert_allclose
from scipy.optimize import brentq
from shapes import box, ellipsoid

from poro.arrays import Array
from poro.collapse.finite_strain import FiniteProblem, FiniteStatus, WallContact, deform
from poro.contact import ChestWall, LevelSet
from poro.fem import ConstitutiveModel, Tissue, neo_hookean, solid
from poro.fem.forms import body_load, deformation_gradient, eigenstress_load, stiffness, tangent_stiffness
from poro.fem.tissue import GRAVITY_KPA_PER_MM

TISSUE = Tissue()
MATERIALS = [saint_venant_kirchhoff(TISSUE), neo_hookean(TISSUE)]
both_materials = pytest.mark.parametrize("material", MATERIALS, ids=lambda material: material.name)


@both_materials
def test_stress_and_moduli_are_derivatives(material: ConstitutiveModel) -> None:
    rng = np.random.default_rng(0)
    f = np.eye(3) + 0.25 * rng.normal(size=(6, 3, 3))
    f[np.linalg.det(f) < 0.1] = np.eye(3)
    direction = rng.normal(size=f.shape)
    h = 1e-6
    ahead, behind = material.respond(f + h * direction), material.respond(f - h * direction)
    _, stress, moduli = material.respond(f)
    assert_allclose((ahead[0] - behind[0]) / (2 * h), np.einsum("mij,mij->m", stress, direction), rtol=1e-6, atol=1e-9)
    change = np.einsum("mijkl,mkl->mij", moduli, direction)
    assert_allclose((ahead[1] - behind[1]) / (2 * h), change, atol=1e-7 * np.abs(change).max())


@both_materials
def test_tangent_at_rest_is_linear_elasticity(material: ConstitutiveModel) -> None:
    mesh = ellipsoid(20.0)
    _, stress, moduli = material.respond(deformation_gradient(mesh, np.zeros_like(mesh.points)))
    linear = stiffness(mesh, TISSUE.lame_kpa, TISSUE.shear_kpa)
    assert_allclose(stress, 0, atol=1e-14)
    assert abs(tangent_stiffness(mesh, moduli) - linear).max() < 1e-12 * abs(linear).max()


@both_materials
def test_rotated_body_carries_no_stress(material: ConstitutiveModel) -> None:
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    energy, stress, _ = material.respond(turn[None])
    assert_allclose(energy, 0, atol=1e-15)
    assert_allclose(stress, 0, atol=1e-14)


def _pressed_bar(material: ConstitutiveModel, stretch: Array) -> tuple[Array, float]:
    """Bar held at both ends in a uniform stretch (3,), sides free: det F of its elements and the force at its top."""
    mesh = box((2, 2, 4), (10.0, 10.0, 20.0))
    exact = mesh.points * (stretch - 1)
    ends = np.flatnonzero((mesh.points[:, 2] == 0) | (mesh.points[:, 2] == 20))
    state = deform(FiniteProblem(mesh, material, ends, exact[ends], np.zeros_like(exact)))
    assert state.status is FiniteStatus.SOLVED
    f = deformation_gradient(mesh, state.u)
    assert_allclose(state.u, exact, atol=1e-7)
    force = eigenstress_load(mesh, material.respond(f)[1])[mesh.points[:, 2] == 20].sum(axis=0)
    return np.linalg.det(f), float(force[2])


@pytest.mark.parametrize("s", [0.6, 0.85, 1.3])
def test_uniaxial_neo_hookean_has_the_closed_form(s: float) -> None:
    """Free sides: mu (b^2 - 1) + lambda ln(b^2 s) = 0 gives the lateral stretch b, and P = mu (s - b^2 / s)."""
    lame, mu = TISSUE.lame_kpa, TISSUE.shear_kpa
    b = brentq(lambda b: mu * (b**2 - 1) + lame * np.log(b**2 * s), 0.5, 2)
    det, force = _pressed_bar(neo_hookean(TISSUE), np.array([b, b, s]))
    assert_allclose(det, b**2 * s, rtol=1e-8)
    assert force == pytest.approx(100 * mu * (s - b**2 / s), rel=1e-7)
    assert (force < 0) == (s < 1)


@pytest.mark.parametrize("s", [0.7, 0.85, 1.3])
def test_uniaxial_saint_venant_kirchhoff_has_the_closed_form(s: float) -> None:
    """Free sides: the lateral Green strain is -nu times the axial one, and P = s E (s^2 - 1) / 2."""
    b = np.sqrt(1 - TISSUE.poisson * (s**2 - 1))
    _, force = _pressed_bar(saint_venant_kirchhoff(TISSUE), np.array([b, b, s]))
    assert force == pytest.approx(100 * s * TISSUE.young_kpa * (s**2 - 1) / 2, rel=1e-7)


@both_materials
def test_small_loads_give_the_linear_answer(material: ConstitutiveModel) -> None:
    mesh = ellipsoid(18.0)
    held = np.flatnonzero(mesh.points[:, 2] < -50)
    load = body_load(mesh, np.array([0.3, 0, -1]) * GRAVITY_KPA_PER_MM * 300)
    body = solid(mesh, TISSUE, held)
    for share, bound in ((1e-3, 1e-2), (1e-5, 1e-4)):
        state = deform(FiniteProblem(mesh, material, body.fixed, np.zeros((len(body.fixed), 3)), share * load), 1e-10)
        linear = body.solve(share * load)
        assert np.abs(state.u - linear).max() < bound * np.abs(linear).max()


def test_newton_ends_quadratically() -> None:
    mesh = ellipsoid(18.0)
    held = np.flatnonzero(mesh.points[:, 2] < -50)
    load = body_load(mesh, np.array([0, 0, -1]) * GRAVITY_KPA_PER_MM * 100)
    state = deform(FiniteProblem(mesh, neo_hookean(TISSUE), held, np.zeros((len(held), 3)), load))
    last = [r for r in state.residuals if r > 1e-12][-3:]
    assert state.status is FiniteStatus.SOLVED
    assert any(b < 30 * a**1.6 for a, b in pairwise(last))


def test_block_pressed_on_a_floor_carries_the_closed_form() -> None:
    """nu = 0, top pushed down to stretch s: pressure mu (1/s - s) on the floor, and no node below it."""
    tissue, s, height = Tissue(poisson=0.0), 0.75, 20.0
    mesh = box((3, 3, 4), (12.0, 12.0, height))
    top, bottom = (np.flatnonzero(mesh.points[:, 2] == z) for z in (height, 0.0))
    grid = np.broadcast_to((np.arange(60) * 5.0 - 100)[None, None], (40, 40, 60)).copy()
    level = LevelSet(grid, np.full(3, -100.0), 5.0)
    wall = ChestWall(
        level, mesh.points[bottom], np.zeros(len(bottom), bool), np.array([0, 0, 1.0]), np.zeros(len(bottom))
    )
    push = np.broadcast_to([0, 0, (s - 1) * height], (len(top), 3)).copy()
    contact = WallContact(wall, bottom, 0.0)
    state = deform(FiniteProblem(mesh, neo_hookean(tissue), top, push, np.zeros_like(mesh.points), contact))
    assert state.status is FiniteStatus.SOLVED
    assert state.active.all()
    assert_allclose(state.u[bottom, 2], 0, atol=1e-8)
    assert state.force.sum() == pytest.approx(tissue.shear_kpa * (1 / s - s) * 144, rel=0.02)
