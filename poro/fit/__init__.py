"""Fit of the collapse to the visible surface and to points matched inside the lung, and what it is worth.

`fit_collapse` finds the parameters that bring the lung to a `Target`; `point_covariance` and `ellipsoid95` say how sure
places are, `identifiability` how well each parameter is held; `elastic_correction` takes what the parameters leave.
"""

from poro.fit.collapse_fit import Fit, FitStatus, fit_collapse
from poro.fit.covariance import ellipsoid95, point_covariance
from poro.fit.elastic_correction import PointConstraints, constraints_to, elastic_correction
from poro.fit.identifiability import Identifiability, identifiability
from poro.fit.observations import Target
from poro.fit.problem import FitSettings

__all__ = [
    "Fit",
    "FitSettings",
    "FitStatus",
    "Identifiability",
    "PointConstraints",
    "Target",
    "constraints_to",
    "elastic_correction",
    "ellipsoid95",
    "fit_collapse",
    "identifiability",
    "point_covariance",
]
