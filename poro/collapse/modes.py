"""Loads beyond the paper's: uniform strains of the resting shape and small motions of the hilum, each a column of one
linear system.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from poro.arrays import Array
from poro.fem.forms import eigenstress_load
from poro.fem.tissue import Tissue
from poro.mesh.tetmesh import TetMesh


@dataclass(frozen=True)
class LoadMode:
    """One linear load with a prior. force: (n, 3) kPa mm2 and imposed: (n, 3) mm at held nodes, per unit amplitude.

    sigma: standard deviation of the amplitude about zero.
    """

    name: str
    force: Array
    imposed: Array
    sigma: float


def eigenstrain_mode(mesh: TetMesh, tissue: Tissue, name: str, strain: Array, sigma: float) -> LoadMode:
    """Mode whose stress-free shape is stretched by `strain` (m, 3, 3), symmetric."""
    trace = np.trace(strain, axis1=1, axis2=2)
    stress = tissue.lame_kpa * trace[:, None, None] * np.eye(3) + 2 * tissue.shear_kpa * strain
    return LoadMode(name, eigenstress_load(mesh, stress), np.zeros_like(mesh.points), sigma)


STRAIN_SIGMA = 0.1
"""Prior standard deviation of a uniform strain."""


def uniform_strain_modes(mesh: TetMesh, tissue: Tissue) -> tuple[LoadMode, ...]:
    """The six components of a uniform strain of the stress-free shape, volume kept or not."""
    result = []
    for i in range(3):
        for j in range(i, 3):
            unit = np.zeros((3, 3))
            unit[i, j] = unit[j, i] = 1 if i == j else 0.5
            strain = np.broadcast_to(unit, (len(mesh.tets), 3, 3))
            result.append(eigenstrain_mode(mesh, tissue, f"strain {'RAS'[i]}{'RAS'[j]}", strain, STRAIN_SIGMA))
    return tuple(result)


SHIFT_SIGMA_MM = 3.0
"""Prior standard deviation of a shift of the hilum."""
TURN_SIGMA_RAD = 0.1
"""Prior standard deviation of a turn of the hilum."""


def hilum_modes(mesh: TetMesh, hilum: Array) -> tuple[LoadMode, ...]:
    """Translations and rotations of the held nodes, for a hilum whose motion is only roughly known."""
    centre = mesh.points[hilum].mean(axis=0)
    result = []
    for axis in range(3):
        unit = np.eye(3)[axis]
        for name, motion, sigma in (
            ("hilum shift", np.broadcast_to(unit, (len(hilum), 3)), SHIFT_SIGMA_MM),
            ("hilum turn", np.cross(unit, mesh.points[hilum] - centre), TURN_SIGMA_RAD),
        ):
            imposed = np.zeros_like(mesh.points)
            imposed[hilum] = motion
            result.append(LoadMode(f"{name} {'RAS'[axis]}", np.zeros_like(mesh.points), imposed, sigma))
    return tuple(result)
