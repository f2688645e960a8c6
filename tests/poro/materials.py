"""A second constitutive model, so that solvers are tested with more than the one that the product uses."""

from __future__ import annotations

import numpy as np

from poro.arrays import Array
from poro.fem import ConstitutiveModel, Tissue


def saint_venant_kirchhoff(tissue: Tissue) -> ConstitutiveModel:
    """Linear in the Green-Lagrange strain; softens, and in the end buckles, below 58 % of its length."""
    lame, mu = tissue.lame_kpa, tissue.shear_kpa
    eye = np.eye(3)

    def respond(f: Array) -> tuple[Array, Array, Array]:
        e = (np.einsum("mki,mkj->mij", f, f) - eye) / 2
        trace = np.einsum("mii->m", e)
        s = lame * trace[:, None, None] * eye + 2 * mu * e
        left = np.einsum("mik,mjk->mij", f, f)
        moduli = (
            np.einsum("ik,mlj->mijkl", eye, s)
            + lame * np.einsum("mij,mkl->mijkl", f, f)
            + mu * (np.einsum("mil,mkj->mijkl", f, f) + np.einsum("mik,jl->mijkl", left, eye))
        )
        energy = lame / 2 * trace**2 + mu * np.einsum("mij,mij->m", e, e)
        return energy, f @ s, moduli

    return ConstitutiveModel("Saint Venant-Kirchhoff", respond)
