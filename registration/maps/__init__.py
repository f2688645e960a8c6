"""Maps of space: anything that takes points (n, 3) to points (n, 3), RAS mm.

`RigidTransform`, `BSplineField` and `DisplacementField` are maps by themselves; `CompositeTransform` adds a B-spline
displacement to a prior map, and `Jacobian` is its gradient. `sample_map` and `compose` put any map on a grid;
`invert_at` finds the points that a map takes to given ones, and says how nearly.
"""

from registration.maps.bspline import BSplineField
from registration.maps.composite import CompositeTransform
from registration.maps.field import DisplacementField, PointMap, compose, sample_map
from registration.maps.inversion import Inversion, invert_at
from registration.maps.jacobian import Jacobian
from registration.maps.rigid import RigidTransform

__all__ = [
    "BSplineField",
    "CompositeTransform",
    "DisplacementField",
    "Inversion",
    "Jacobian",
    "PointMap",
    "RigidTransform",
    "compose",
    "invert_at",
    "sample_map",
]
