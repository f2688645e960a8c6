"""Loads beyond the paper's: smooth fields of shrinkage and small motions of the hilum, each a column of one linear
system.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from poro.fem.forms import eigenstress_load
from poro.fem.tissue import Tissue
from poro.mesh.tetmesh import Array, TetMesh


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


def lung_coordinates(mesh: TetMesh, gravity: Array) -> Array:
    """Centroids of the elements in (gravity, foot to head, third axis), each scaled to about [-1, 1], (m, 3)."""
    up = np.array([0.0, 0.0, 1.0])
    first = gravity - (gravity @ up) * up
    first = first / np.linalg.norm(first) if np.linalg.norm(first) > 1e-6 else np.array([1.0, 0.0, 0.0])
    axes = np.stack([first, up, np.cross(first, up)], axis=1)
    along = mesh.points[mesh.tets].mean(axis=1) @ axes
    low, high = along.min(axis=0), along.max(axis=0)
    return 2 * (along - low) / (high - low) - 1


def shrinkage_modes(
    mesh: TetMesh, tissue: Tissue, gravity: Array, degree: int = 1, sigma: float = 0.1
) -> tuple[LoadMode, ...]:
    """Isotropic stretch of the stress-free shape, as polynomials of total `degree` in the lung's own coordinates."""
    x = lung_coordinates(mesh, gravity)
    result = []
    for powers in _powers(degree):
        weight = np.prod(x ** np.array(powers), axis=1)
        strain = weight[:, None, None] * np.eye(3)
        name = "stretch g{} h{} t{}".format(*powers)
        result.append(eigenstrain_mode(mesh, tissue, name, strain, sigma))
    return tuple(result)


def shape_modes(
    mesh: TetMesh, tissue: Tissue, gravity: Array, degree: int = 1, sigma: float = 0.1
) -> tuple[LoadMode, ...]:
    """Any stretch of the stress-free shape, volume kept or not: six strain components times polynomials of `degree`."""
    x = lung_coordinates(mesh, gravity)
    result = []
    for powers in _powers(degree):
        weight = np.prod(x ** np.array(powers), axis=1)
        for i in range(3):
            for j in range(i, 3):
                unit = np.zeros((3, 3))
                unit[i, j] = unit[j, i] = 1 if i == j else 0.5
                name = "strain {}{} g{} h{} t{}".format("RAS"[i], "RAS"[j], *powers)
                result.append(eigenstrain_mode(mesh, tissue, name, weight[:, None, None] * unit, sigma))
    return tuple(result)


def hilum_modes(mesh: TetMesh, hilum: Array, sigma_mm: float = 3.0, sigma_rad: float = 0.1) -> tuple[LoadMode, ...]:
    """Translations and rotations of the held nodes, for a hilum whose motion is only roughly known."""
    centre = mesh.points[hilum].mean(axis=0)
    result = []
    for axis in range(3):
        unit = np.eye(3)[axis]
        for name, motion, sigma in (
            ("hilum shift", np.broadcast_to(unit, (len(hilum), 3)), sigma_mm),
            ("hilum turn", np.cross(unit, mesh.points[hilum] - centre), sigma_rad),
        ):
            imposed = np.zeros_like(mesh.points)
            imposed[hilum] = motion
            result.append(LoadMode(f"{name} {'RAS'[axis]}", np.zeros_like(mesh.points), imposed, sigma))
    return tuple(result)


def _powers(degree: int) -> list[tuple[int, int, int]]:
    span = range(degree + 1)
    return sorted(((a, b, c) for a in span for b in span for c in span if a + b + c <= degree), key=sum)
