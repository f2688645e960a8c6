"""Isotropic hyperelastic models of the breathing papers in principal stretches: Ogden, Veronda-Westmann, Eom's.

A strain energy comes with two derivatives by the principal stretches; stress and moduli follow from the singular value
decomposition of F, of which a change turns the axes as well as it stretches along them.
Ref: Ogden 1984, section 6.1; Smith, de Goes and Kim 2019 (moduli in the basis of the singular vectors).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from poro.arrays import Array
from poro.fem.constitutive import ConstitutiveModel
from poro.fem.tissue import Tissue

StrainEnergy = Callable[[Array], tuple[Array, Array, Array]]
"""Principal stretches (m, 3) > 0 -> energy density (m,) kPa, its gradient (m, 3) and its Hessian (m, 3, 3)."""

_EQUAL = 1e-6
"""Stretches nearer than this are taken for equal, where a quotient of differences becomes a derivative."""


def isotropic(name: str, energy_of: StrainEnergy) -> ConstitutiveModel:
    """Constitutive model of a strain energy in principal stretches. Inverted elements have infinite energy."""

    def respond(f: Array) -> tuple[Array, Array, Array]:
        if not (np.linalg.det(f) > 0).all():
            return np.full(len(f), np.inf), np.zeros_like(f), np.zeros((len(f), 3, 3, 3, 3))
        u, stretch, vt = np.linalg.svd(f)
        energy, slope, curvature = energy_of(stretch)
        stress = np.einsum("mia,ma,maj->mij", u, slope, vt)
        moduli = np.zeros((len(f), 3, 3, 3, 3))
        for a in range(3):
            for b in range(3):
                moduli[:, a, a, b, b] = curvature[:, a, b]
                if a == b:
                    continue
                apart = stretch[:, a] - stretch[:, b]
                near = np.abs(apart) < _EQUAL
                quotient = (slope[:, a] - slope[:, b]) / np.where(near, 1.0, apart)
                stretching = np.where(near, curvature[:, a, a] - curvature[:, a, b], quotient)
                turning = (slope[:, a] + slope[:, b]) / (stretch[:, a] + stretch[:, b])
                moduli[:, a, b, a, b] = (stretching + turning) / 2
                moduli[:, a, b, b, a] = (stretching - turning) / 2
        # dP = U (moduli : U' dF V) V'; two small products are cheaper than one over four indices.
        basis = np.einsum("mia,mbj->mijab", u, vt).reshape(-1, 9, 9)
        moduli = basis @ moduli.reshape(-1, 9, 9) @ basis.transpose(0, 2, 1)
        return energy, stress, moduli.reshape(-1, 3, 3, 3, 3)

    return ConstitutiveModel(name, respond)


def ogden(mu_kpa: float, alpha: float, bulk_kpa: float) -> ConstitutiveModel:
    """mu/alpha (sum of deviatoric stretches to the power alpha, less 3) + K/2 (ln J)^2: shear modulus mu alpha / 2.

    Ref: Li & Porikli 2014, eq. 3.
    """

    def energy_of(logs: Array) -> tuple[Array, Array, Array]:
        total, first, second = _power_sum(logs, alpha)
        swelling = logs.sum(axis=1)
        energy = mu_kpa / alpha * (total - 3) + bulk_kpa / 2 * swelling**2
        return energy, mu_kpa / alpha * first + (bulk_kpa * swelling)[:, None], mu_kpa / alpha * second + bulk_kpa

    return isotropic("Ogden", _of_logarithms(energy_of))


def ogden_lung(tissue: Tissue, alpha: float = 6.82) -> ConstitutiveModel:
    """Ogden's model with the paper's exponent and a lung's own moduli at small strain.

    The paper's mu = 0.0329 comes without a unit and its bulk modulus without a value ("sufficiently high", which would
    keep a lung from filling), so both are those of `tissue` here. Ref: Li & Porikli 2014, section 3.3.
    """
    return ogden(2 * tissue.shear_kpa / alpha, alpha, tissue.lame_kpa + 2 * tissue.shear_kpa / 3)


def veronda_westmann(tissue: Tissue, exponent: float = 1.0) -> ConstitutiveModel:
    """C (exp(b (I1 - 3)) - 1) - C b / 2 (I2 - 3) + K/2 (ln J)^2 in the deviatoric invariants; b C is the shear modulus.

    Ref: Veronda & Westmann 1970, eq. 17, with the volume set free; Li 2008, section 3 (which gives no constants).
    """
    bulk, shear = tissue.lame_kpa + 2 * tissue.shear_kpa / 3, tissue.shear_kpa

    def energy_of(logs: Array) -> tuple[Array, Array, Array]:
        one, one_slope, one_curve = _power_sum(logs, 2.0)
        two, two_slope, two_curve = _power_sum(logs, -2.0)
        swelling = logs.sum(axis=1)
        growth = np.exp(exponent * (one - 3))
        energy = shear / exponent * (growth - 1) - shear / 2 * (two - 3) + bulk / 2 * swelling**2
        slope = shear * growth[:, None] * one_slope - shear / 2 * two_slope + (bulk * swelling)[:, None]
        pairs = one_slope[:, :, None] * one_slope[:, None, :]
        curve = shear * growth[:, None, None] * (one_curve + exponent * pairs) - shear / 2 * two_curve + bulk
        return energy, slope, curve

    return isotropic("Veronda-Westmann", _of_logarithms(energy_of))


def eom_lung(modulus_kpa: float = 2.5, a: float = 0.433, b: float = -0.611) -> ConstitutiveModel:
    """xi/2 (exp(a J1^2 + b J2) - 1) in the first two invariants of the Green-Lagrange strain.

    The form is that of lung parenchyma in the experiments that Eom 2010 draws on. The coefficients of its table I are
    lost in the copy at hand; those here are of human lung in Tawhai 2009. At small strain lambda = xi (a + b/2) and
    mu = -xi b / 4, 0.32 and 0.38 kPa. Ref: Eom 2010, section II B; Zeng, Yager & Fung 1987; Tawhai 2009, eq. 1.
    """

    def energy_of(stretch: Array) -> tuple[Array, Array, Array]:
        e = (stretch**2 - 1) / 2
        one = e.sum(axis=1)
        two = (one**2 - (e**2).sum(axis=1)) / 2
        slope = 2 * a * one[:, None] + b * (one[:, None] - e)
        curve = 2 * a + b * (1 - np.eye(3))
        growth = modulus_kpa / 2 * np.exp(a * one**2 + b * two)
        by_strain = growth[:, None] * slope
        curvature = growth[:, None, None] * (curve + slope[:, :, None] * slope[:, None, :])
        curvature = curvature * stretch[:, :, None] * stretch[:, None, :] + by_strain[:, :, None] * np.eye(3)
        return growth - modulus_kpa / 2, by_strain * stretch, curvature

    return isotropic("Eom", energy_of)


def _of_logarithms(energy_of: StrainEnergy) -> StrainEnergy:
    """Strain energy in principal stretches of one in their logarithms."""

    def by_stretch(stretch: Array) -> tuple[Array, Array, Array]:
        energy, slope, curve = energy_of(np.log(stretch))
        curve = curve - slope[:, :, None] * np.eye(3)
        return energy, slope / stretch, curve / (stretch[:, :, None] * stretch[:, None, :])

    return by_stretch


def _power_sum(logs: Array, power: float) -> tuple[Array, Array, Array]:
    """Sum (m,) of the deviatoric stretches to a power, and its first two derivatives by the logarithms."""
    x = np.exp(power * (logs - logs.mean(axis=1, keepdims=True)))
    total = x.sum(axis=1)
    slope = power * (x - total[:, None] / 3)
    curve = x[:, :, None] * np.eye(3) - (x[:, :, None] + x[:, None, :]) / 3 + total[:, None, None] / 9
    return total, slope, power**2 * curve
