"""Elastic correction: the elastic field of least energy that brings a solved lung nearer to the data.

The parameters of a model say how a lung deforms in the large; what they leave is smooth, and inner points say what it
is.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count, islice

import numpy as np
from scipy.sparse import csr_matrix, diags

from poro.arrays import Array
from poro.fem.constraints import interpolation_matrix, point_constraints
from poro.fem.forms import deformation_gradient
from poro.fem.solid import Constrained, anchor, constrained
from poro.fem.tissue import Tissue
from poro.fit.observations import Target, facing, independence
from poro.fit.problem import FitSettings
from poro.mesh.closest import closest_points
from poro.mesh.locate import Location, locate
from poro.mesh.tetmesh import TetMesh

REGION_MM3 = 1e5
REACH_MM = 20.0
CORRECTION_TOLERANCE, PULL_TOLERANCE = 1e-7, 1e-5
"""Of the residual. With the second, fields of 3 mm were right to 0.002 mm; the blocks they follow scatter by 0.5 mm."""
KEYPOINT_SHARE = 0.75
"""Of a keypoint's standard deviation in the fit: that holds what few parameters cannot follow too, which the correction
can. Chosen (1.5 mm beside 2 mm), not derived."""


@dataclass(frozen=True)
class PointConstraints:
    """Where points of a lung should go. points: (q, 3) mm at rest; offset: (q, 3) mm wanted on top of the solved state;
    sigma_mm: (q,) uncertainty; normals: (q, 3) unit vectors along which alone a constraint acts, zero for all
    directions.
    """

    points: Array
    offset: Array
    sigma_mm: Array
    normals: Array


@dataclass(frozen=True)
class ElasticCorrection:
    """Elastic displacement on top of a solved state.

    u: (n, 3) mm; det_f: (m,) of both together; influence: (q,) how far each constraint is believed, 0..1.
    """

    u: Array
    det_f: Array
    influence: Array


def constraints_to(target: Target, mesh: TetMesh, u: Array, settings: FitSettings) -> PointConstraints:
    """Constraints from a solved state (n, 3) to a target: along the normal at the surface, in all directions at inner
    points. Standard deviations and correlation of the data are those of the fit's settings, but for KEYPOINT_SHARE.

    Surface points farther than REACH_MM from the solved surface, or facing another way, are left out.
    """
    boundary = mesh.boundary
    moved = boundary.moved(boundary.points + u[boundary.nodes])
    near = closest_points(moved, target.points)
    agree = facing(moved, near, target.normals) > 0.5
    used = np.flatnonzero(agree & (np.abs(near.distance) < REACH_MM) & (target.weights > 0))
    corners = boundary.points[boundary.triangles[near.triangle[used]]]
    rest = np.einsum("qk,qkd->qd", near.barycentric[used], corners)
    share = target.weights[used] * independence(target.points[used], settings.correlation_mm)
    inner = target.inflated[target.keypoint_weights > 0]
    where = locate(mesh, inner)
    now = inner + interpolation_matrix(where, len(u)) @ u
    trust = target.keypoint_weights[target.keypoint_weights > 0]
    keypoint_sigma_mm = KEYPOINT_SHARE * settings.keypoint_sigma_mm
    return PointConstraints(
        np.concatenate([rest, inner]),
        np.concatenate([(target.points - near.points)[used], target.deflated[target.keypoint_weights > 0] - now]),
        np.concatenate([settings.surface_sigma_mm / np.sqrt(share), keypoint_sigma_mm / np.sqrt(trust)]),
        np.concatenate([target.normals[used], np.zeros_like(inner)]),
    )


def elastic_correction(
    mesh: TetMesh,
    u: Array,
    tissue: Tissue,
    wanted: PointConstraints,
    model_sigma: float = 0.05,
    robust: float = 3.0,
    rounds: int = 5,
) -> ElasticCorrection:
    """The last of `rounds` fields of `loosened`.

    model_sigma: strain by which a tenth of a litre of the solved state is expected to be wrong; it weighs the
    tissue's energy against the constraints.
    """
    fields = loosened(mesh, u, tissue, wanted, model_sigma / 2.0 ** (rounds - 1), robust)
    return next(islice(fields, rounds - 1, None))


def loosened(
    mesh: TetMesh, u: Array, tissue: Tissue, wanted: PointConstraints, stiffest: float, robust: float = 3.0
) -> Iterator[ElasticCorrection]:
    """Elastic fields of least energy that follow the constraints, outliers losing influence (Cauchy), without end.

    Each expects twice the strain of the one before, the first `stiffest`, so that outliers show before they are
    followed.
    """
    where = locate(mesh, wanted.points)
    operator, shape = interpolation_matrix(where, len(u)), _shape(wanted.normals)
    influence = _near(where)
    for number in count():
        unit = energy_per_datum(tissue, stiffest * 2.0**number)
        penalty = _penalty(shape, unit * influence / wanted.sigma_mm**2)
        field = _pull(mesh, tissue, operator, penalty, CORRECTION_TOLERANCE)(wanted.offset)
        misfit = np.linalg.norm(np.einsum("qij,qj->qi", shape, wanted.offset - operator @ field), axis=1)
        scale = robust * np.maximum(wanted.sigma_mm, 1.4826 * np.median(misfit[influence > 0]))
        influence = _near(where) / (1 + (misfit / scale) ** 2)
        yield ElasticCorrection(field, np.linalg.det(deformation_gradient(mesh, u + field)), influence)


@dataclass(frozen=True)
class ElasticPull:
    """Elastic fields of least energy that follow what is wanted at the same points again and again.

    operator: (q, n) that interpolates at these; penalty: (q, 3, 3) kPa mm.
    """

    operator: csr_matrix
    penalty: Array
    body: Constrained

    def __call__(self, offset: Array) -> Array:
        """Field (n, 3) mm for offsets (q, 3) mm."""
        return self.body.solve(self.operator.T @ np.einsum("qij,qj->qi", self.penalty, offset))


def elastic_pull(mesh: TetMesh, tissue: Tissue, wanted: PointConstraints, model_sigma: float) -> ElasticPull:
    """What the first round of `elastic_correction` gives, for other offsets too. model_sigma: as there."""
    where = locate(mesh, wanted.points)
    stiffness = energy_per_datum(tissue, model_sigma) * _near(where) / wanted.sigma_mm**2
    operator = interpolation_matrix(where, len(mesh.points))
    return _pull(mesh, tissue, operator, _penalty(_shape(wanted.normals), stiffness), PULL_TOLERANCE)


def _pull(mesh: TetMesh, tissue: Tissue, operator: csr_matrix, penalty: Array, tolerance: float) -> ElasticPull:
    matrix, _ = point_constraints(operator, penalty, np.zeros((len(penalty), 3)))
    held = (matrix + diags(anchor(mesh, tissue))).tocsr()
    return ElasticPull(operator, penalty, constrained(mesh, tissue, held, tolerance))


def _shape(normals: Array) -> Array:
    """Directions (q, 3, 3) that constraints act along: normals (q, 3), or all where one is zero."""
    axial = np.linalg.norm(normals, axis=1) > 0.5
    return np.where(axial[:, None, None], normals[:, :, None] * normals[:, None, :], np.eye(3))


def _penalty(shape: Array, stiffness: Array) -> Array:
    """Stiffness (q,) kPa mm along directions (q, 3, 3)."""
    return np.asarray(stiffness[:, None, None] * shape)


def energy_per_datum(tissue: Tissue, model_sigma: float) -> float:
    """Energy, kPa mm3, of a strain of `model_sigma` in a tenth of a litre: what one standard deviation of a datum is
    worth, squared and halved.
    """
    return tissue.young_kpa * REGION_MM3 * model_sigma**2


def _near(where: Location) -> Array:
    """1 in the mesh, falling off over a few millimetres outside it."""
    return 1 / (1 + (where.distance / 3.0) ** 2)
