"""Hertz's problem: a block that is fine under the contact, and how a half-space moves under Hertz's pressure."""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq
from shapes import box

from poro.arrays import Array
from poro.fem import Tissue
from poro.mesh import TetMesh


def graded(cells: int, far: float, finest: float) -> Array:
    """Coordinates 0..far whose steps grow in a constant ratio from `finest`."""
    ratio = brentq(lambda r: finest * (r**cells - 1) / (r - 1) - far, 1.0001, 10)
    return finest * (ratio ** np.arange(cells + 1) - 1) / (ratio - 1)


def half_block(cells: int, finest: float, contact: float) -> TetMesh:
    """Half-space z <= 0 cut off 4 contact radii from the middle, fine under the contact."""
    side = graded(cells, 4 * contact, finest)
    across = np.concatenate([-side[:0:-1], side])
    unit = box((2 * cells, 2 * cells, cells), (2 * cells, 2 * cells, cells))
    index = np.rint(unit.points).astype(int)
    points = np.stack([across[index[:, 0]], across[index[:, 1]], -side[::-1][index[:, 2]]], axis=1)
    return TetMesh(points, unit.tets)


def half_space(points: Array, contact: float, peak: float, tissue: Tissue) -> Array:
    """Displacement (n, 3) under Hertz's pressure: Boussinesq's point force, integrated over the contact.

    Ref: Johnson 1985, eqs. 3.19 and 3.39.
    """
    x, w = np.polynomial.legendre.leggauss(8)
    r, wr = (x + 1) / 2, w / 2
    angle = 2 * np.pi * np.arange(24) / 24
    u = np.zeros_like(points)
    for s, ws in zip(r, wr, strict=True):
        # r = a sqrt(1 - s^2) turns the pressure p0 s into a polynomial.
        rho = contact * np.sqrt(1 - s**2)
        load = peak * s * contact**2 * s * ws * 2 * np.pi / len(angle)
        for t in angle:
            d = points - [rho * np.cos(t), rho * np.sin(t), 0]
            far, z, nu = np.linalg.norm(d, axis=1), -d[:, 2], tissue.poisson
            unit = (1 + nu) * load / (2 * np.pi * tissue.young_kpa)
            u[:, :2] += (unit * (z / far**3 - (1 - 2 * nu) / (far * (far + z))))[:, None] * d[:, :2]
            u[:, 2] -= unit * (z**2 / far**3 + 2 * (1 - nu) / far)
    return u
