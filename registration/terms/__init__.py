"""What a free-form deformation minimizes, and how.

`ImageTerm` is the dissimilarity of the images by a `Metric`; `Bending`, `CorrespondingPoints` and `Folding` are
penalties. Each is a term: a value, and a quadratic model of it near given B-spline coefficients. `Objective` adds terms
up, and `gauss_newton` minimizes the sum.
"""

from registration.terms.gauss_newton import Descent, Stop, gauss_newton
from registration.terms.image_term import ImageTerm
from registration.terms.metrics import GlobalNcc, LocalNcc, Metric
from registration.terms.objective import Objective
from registration.terms.penalties import Bending, CorrespondingPoints, Folding

__all__ = [
    "Bending",
    "CorrespondingPoints",
    "Descent",
    "Folding",
    "GlobalNcc",
    "ImageTerm",
    "LocalNcc",
    "Metric",
    "Objective",
    "Stop",
    "gauss_newton",
]
