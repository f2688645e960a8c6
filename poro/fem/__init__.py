"""Finite elements of the poroelastic lung: tissue, weak forms in scikit-fem, linear solid, air flow and continuation.

`solid` factors the elastic stiffness (`prepare_solid` makes it beforehand), `Flow` solves for the pressure,
`PressureBasis` for both at any evacuation rate, `extrapolate` continues known displacements elastically, and
constitutive models serve finite strain.
"""

from poro.fem.constitutive import ConstitutiveModel, neo_hookean
from poro.fem.extrapolation import Extrapolation, extrapolate
from poro.fem.flow import Flow
from poro.fem.pressure_basis import PressureBasis
from poro.fem.solid import Solid, prepare_solid, solid
from poro.fem.tissue import Tissue

__all__ = [
    "ConstitutiveModel",
    "Extrapolation",
    "Flow",
    "PressureBasis",
    "Solid",
    "Tissue",
    "extrapolate",
    "neo_hookean",
    "prepare_solid",
    "solid",
]
