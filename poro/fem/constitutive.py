"""Constitutive models at finite strain, values that a solver is given."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from poro.arrays import Array
from poro.fem.tissue import Tissue


@dataclass(frozen=True)
class ConstitutiveModel:
    """Hyperelastic material. respond: F (m, 3, 3) -> energy density (m,) kPa, first Piola-Kirchhoff stress (m, 3, 3)
    kPa and its derivative (m, 3, 3, 3, 3) by F.
    """

    name: str
    respond: Callable[[Array], tuple[Array, Array, Array]]


def neo_hookean(tissue: Tissue) -> ConstitutiveModel:
    """mu/2 (tr C - 3) - mu ln J + lambda/2 (ln J)^2: infinite energy at J = 0, so that no element turns inside out."""
    lame, mu = tissue.lame_kpa, tissue.shear_kpa
    eye = np.eye(3)

    def respond(f: Array) -> tuple[Array, Array, Array]:
        det = np.linalg.det(f)
        if not (det > 0).all():
            return np.full(len(f), np.inf), np.zeros_like(f), np.zeros((len(f), 3, 3, 3, 3))
        log = np.log(det)
        inverse = np.linalg.inv(f).transpose(0, 2, 1)
        stress = mu * f + (lame * log - mu)[:, None, None] * inverse
        moduli = (
            mu * np.einsum("ik,jl->ijkl", eye, eye)
            + np.einsum("m,mil,mkj->mijkl", mu - lame * log, inverse, inverse)
            + lame * np.einsum("mij,mkl->mijkl", inverse, inverse)
        )
        energy = mu / 2 * (np.einsum("mij,mij->m", f, f) - 3) - mu * log + lame / 2 * log**2
        return energy, stress, moduli

    return ConstitutiveModel("neo-Hookean", respond)
