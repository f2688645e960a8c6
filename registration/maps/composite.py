"""Composite transforms: a prior map and a B-spline displacement, on whole grids by separable products if possible."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeGuard

from registration.maps.bspline import BSplineField, parallel
from registration.maps.field import DisplacementField, PointMap, sample_map
from registration.volume import Array, Grid


@dataclass(frozen=True)
class CompositeTransform:
    """x -> prior(x) + u(x): a B-spline displacement added to a prior map."""

    prior: PointMap
    field: BSplineField

    def __call__(self, points_ras: Array) -> Array:
        """Images (n, 3) of points (n, 3) in RAS mm."""
        return self.prior(points_ras) + self.field.displacement(points_ras)

    def dense(self, grid: Grid) -> DisplacementField:
        """The whole map on the voxels of a grid parallel to the control grid."""
        u = self.field.dense(grid).vectors
        return DisplacementField(dense_field(self.prior, grid).vectors + u, grid.ras_from_ijk)


def dense_field(mapping: PointMap, grid: Grid) -> DisplacementField:
    """Any map on the voxels of `grid`, float32."""
    return mapping.dense(grid) if is_separable(mapping, grid) else sample_map(mapping, grid)


def is_separable(mapping: PointMap, grid: Grid) -> TypeGuard[CompositeTransform]:
    """Whether the map is a prior and splines whose axes are parallel to the grid's."""
    return isinstance(mapping, CompositeTransform) and parallel(mapping.field.control, grid)
