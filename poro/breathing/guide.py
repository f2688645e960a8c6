"""What is known of a lung's motion, by whatever means, as constraints that drive any of its models."""

from __future__ import annotations

from poro.arrays import Array
from poro.breathing.equilibrium import ConstraintTerms
from poro.fem.constraints import interpolation_matrix, point_constraints
from poro.fem.tissue import Tissue
from poro.mesh.locate import locate
from poro.mesh.tetmesh import TetMesh

HELD_MM = 5.0
"""Tissue follows what is known but for what varies within this length."""
NEAR_MM = 8.0
"""Points farther outside the mesh say nothing about it."""


def guide(mesh: TetMesh, points: Array, motion: Array, volumes: Array) -> ConstraintTerms:
    """Constraints that ask points (k, 3) mm of a mesh to move by `motion` (k, 3) mm; volumes: (k,) mm3 of the tissue
    that each stands for. An elastic foundation of E / `HELD_MM`^2.
    """
    where = locate(mesh, points)
    stiffness = Tissue().young_kpa / HELD_MM**2 * volumes * (where.distance < NEAR_MM)
    return ConstraintTerms(*point_constraints(interpolation_matrix(where, len(mesh.points)), stiffness, motion))
