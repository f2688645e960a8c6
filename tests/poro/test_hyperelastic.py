"""Laws of the breathing papers: derivatives by finite differences, closed forms, small strain, objectivity."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from shapes import ellipsoid

from poro.arrays import Array
from poro.fem import ConstitutiveModel, Tissue
from poro.fem.forms import deformation_gradient, stiffness, tangent_stiffness
from poro.fem.hyperelastic import eom_lung, ogden, ogden_lung, veronda_westmann

TISSUE = Tissue()
LAWS = [ogden_lung(TISSUE), veronda_westmann(TISSUE), eom_lung()]
all_laws = pytest.mark.parametrize("material", LAWS, ids=lambda material: material.name)
STRETCHES = [0.7, 0.9, 1.25, 1.6]


@all_laws
def test_stress_and_moduli_are_derivatives(material: ConstitutiveModel) -> None:
    rng = np.random.default_rng(0)
    f = np.eye(3) + 0.2 * rng.normal(size=(8, 3, 3))
    f[np.linalg.det(f) < 0.2] = np.eye(3)
    f[0], f[1] = np.eye(3), np.diag([1.3, 1.3, 0.8])  # equal stretches, where a quotient becomes a derivative
    direction = rng.normal(size=f.shape)
    h = 1e-6
    ahead, behind = material.respond(f + h * direction), material.respond(f - h * direction)
    _, stress, moduli = material.respond(f)
    slope = np.einsum("mij,mij->m", stress, direction)
    assert_allclose((ahead[0] - behind[0]) / (2 * h), slope, rtol=1e-6, atol=1e-8)
    change = np.einsum("mijkl,mkl->mij", moduli, direction)
    assert_allclose((ahead[1] - behind[1]) / (2 * h), change, atol=1e-6 * np.abs(change).max())


@all_laws
def test_turned_body_carries_no_stress_and_a_turned_stretch_the_turned_one(material: ConstitutiveModel) -> None:
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    energy, stress, _ = material.respond(turn[None])
    assert_allclose(energy, 0, atol=1e-14)
    assert_allclose(stress, 0, atol=1e-14)
    f = np.array([[[1.2, 0.1, 0], [0.0, 0.9, 0.2], [0.1, 0, 1.1]]])
    plain, turned = material.respond(f), material.respond(turn @ f)
    assert_allclose(turned[0], plain[0])
    assert_allclose(turned[1], turn @ plain[1], atol=1e-13)


@pytest.mark.parametrize("material", LAWS[:2], ids=lambda material: material.name)
def test_tangent_at_rest_is_the_tissue_s_linear_elasticity(material: ConstitutiveModel) -> None:
    mesh = ellipsoid(25.0)
    moduli = material.respond(deformation_gradient(mesh, np.zeros_like(mesh.points)))[2]
    linear = stiffness(mesh, TISSUE.lame_kpa, TISSUE.shear_kpa)
    assert abs(tangent_stiffness(mesh, moduli) - linear).max() < 1e-10 * abs(linear).max()


def test_eom_s_moduli_at_rest_are_the_stated_ones() -> None:
    moduli = eom_lung().respond(np.eye(3)[None])[2][0]
    assert moduli[0, 0, 1, 1] == pytest.approx(2.5 * (0.433 - 0.611 / 2))
    assert moduli[0, 1, 0, 1] == pytest.approx(2.5 * 0.611 / 4)


def swollen(s: float) -> Array:
    return s * np.eye(3)[None]


@pytest.mark.parametrize("s", STRETCHES)
def test_swelling_has_the_closed_form(s: float) -> None:
    """F = s I: deviatoric parts vanish, P = 3 K ln s / s; Eom's: xi/2 exp(Q) dQ/dE s with E = (s^2 - 1)/2."""
    bulk = TISSUE.lame_kpa + 2 * TISSUE.shear_kpa / 3
    for material in LAWS[:2]:
        assert_allclose(material.respond(swollen(s))[1][0], 3 * bulk * np.log(s) / s * np.eye(3), atol=1e-13)
    e = (s**2 - 1) / 2
    q = 0.433 * 9 * e**2 - 0.611 * 3 * e**2
    wanted = 2.5 / 2 * np.exp(q) * (2 * 0.433 * 3 * e - 0.611 * 2 * e) * s
    assert_allclose(eom_lung().respond(swollen(s))[1][0], wanted * np.eye(3), atol=1e-12)


@pytest.mark.parametrize("s", STRETCHES)
def test_stretch_at_constant_volume_has_the_closed_form(s: float) -> None:
    """F = diag(s, 1/sqrt s, 1/sqrt s) with free sides: Cauchy stress s W'(s) of the deviatoric energy alone."""
    f = np.diag([s, s**-0.5, s**-0.5])[None]

    def axial_less_lateral(material: ConstitutiveModel) -> float:
        cauchy = material.respond(f)[1][0] @ f[0].T
        return float(cauchy[0, 0] - cauchy[1, 1])

    mu, alpha = 0.0329, 6.82
    assert axial_less_lateral(ogden(mu, alpha, 3.0)) == pytest.approx(mu * (s**alpha - s ** (-alpha / 2)), rel=1e-9)
    shear, b = TISSUE.shear_kpa, 1.5
    growth = np.exp(b * (s**2 + 2 / s - 3))
    wanted = 2 * (s**2 - 1 / s) * (shear * growth) - shear * (s - s**-2)
    assert axial_less_lateral(veronda_westmann(TISSUE, b)) == pytest.approx(wanted, rel=1e-9)


@all_laws
def test_an_inverted_element_costs_infinite_energy(material: ConstitutiveModel) -> None:
    assert np.isinf(material.respond(np.diag([-1.0, 1.0, 1.0])[None])[0]).all()
