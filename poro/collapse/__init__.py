"""The collapse of one lung: its loads, its solution at given parameters, and finite strain where that is needed.

`assemble` sets a lung up once (`still_lung` before it is known how the hilum moved), `solve` gives its deflated state
at parameters `Theta`; `keep_in_range` solves again at finite strain where linear strain leaves its range. Load modes
are freedom beyond the paper's.
"""

from poro.collapse.choice import LinearRange, StrainMeasure, keep_in_range
from poro.collapse.model import PoroSystem, Theta, assemble, still_lung
from poro.collapse.modes import hilum_modes, uniform_strain_modes
from poro.collapse.solution import PoroState, PoroStatus, solve

__all__ = [
    "LinearRange",
    "PoroState",
    "PoroStatus",
    "PoroSystem",
    "StrainMeasure",
    "Theta",
    "assemble",
    "hilum_modes",
    "keep_in_range",
    "solve",
    "still_lung",
    "uniform_strain_modes",
]
