"""Pressure-volume curve of the lung, parameterised by an exponential, and the recoil of a deformed one.

Ref: Salazar & Knowles 1964; Eom 2010, fig. 5 (pressure read off a curve at each phase's volume).
"""

from __future__ import annotations

import numpy as np

from poro.arrays import Array
from poro.fem.constitutive import neo_hookean
from poro.fem.forms import deformation_gradient
from poro.fem.tissue import Tissue
from poro.mesh.tetmesh import TetMesh

PER_PA = 0.147 / 98.07
"""Exponent of normal lungs, 0.147 per cmH2O."""
COMPLIANCE_PER_PA = 0.083 / 98.07
"""Compliance at rest over the volume there: 0.2 l/cmH2O of 2.4 l."""
_FULL = 0.95


def pressure_volume(inspired_ml: Array, rest_ml: float) -> Array:
    """Rise (k,) Pa of the recoil pressure with the volume inspired (k,) ml above the resting volume.

    inspired = C / k (1 - exp(-k P)). A breath beyond what the curve holds makes the lung as compliant as it has to be
    for 95 % of the curve, which is what emphysema does.
    """
    inspired = np.asarray(inspired_ml, float)
    compliance = max(COMPLIANCE_PER_PA * rest_ml, PER_PA * float(inspired.max(initial=0)) / _FULL)
    return np.asarray(-np.log(1 - PER_PA * inspired / compliance) / PER_PA)


def inspired_volume(pressure_pa: Array, compliance_ml_per_pa: float) -> Array:
    """The curve the other way: volume (k,) ml above rest at a rise of the recoil pressure (k,) Pa."""
    return np.asarray(compliance_ml_per_pa / PER_PA * (1 - np.exp(-PER_PA * np.asarray(pressure_pa, float))))


def recoil_pa(mesh: TetMesh, nodes: Array, tissue: Tissue) -> float:
    """By what the recoil of neo-Hookean tissue rises (less than 0: falls) as a mesh's nodes move to (n, 3) mm: the mean
    of its hydrostatic stress, in Pa. Inverted elements are left out.
    """
    f = deformation_gradient(mesh, nodes - mesh.points)
    det = np.linalg.det(f)
    whole = det > 0
    _, stress, _ = neo_hookean(tissue).respond(f[whole])
    pressure = np.einsum("mij,mij->m", stress, f[whole]) / det[whole] / 3
    return 1000 * float(np.average(pressure, weights=(det * mesh.volumes)[whole]))
