"""Simple bodies the mechanics tests share."""

from __future__ import annotations

import numpy as np

from poro.arrays import Array
from poro.contact import Compliance
from poro.fem import Solid
from poro.fem.solid import unknowns_of
from poro.mesh import TetMesh, stuff_level_set
from poro.mesh.tetmesh import signed_volumes


def box(cells: tuple[int, int, int], size: tuple[float, float, float]) -> TetMesh:
    """Box from the origin to `size` mm, every cell cut into six tetrahedra around its diagonal."""
    axes = [np.linspace(0, s, c + 1) for c, s in zip(cells, size, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    number = np.arange(len(points)).reshape(np.array(cells) + 1)
    tets = []
    for order in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
        corner = np.zeros(3, int)
        path = [number[: cells[0], : cells[1], : cells[2]]]
        for axis in order:
            corner[axis] = 1
            path.append(number[tuple(slice(o, o + c) for o, c in zip(corner, cells, strict=True))])
        tets.append(np.stack(path, -1).reshape(-1, 4))
    joined = np.concatenate(tets)
    flipped = signed_volumes(points, joined) < 0
    joined[flipped] = joined[flipped][:, [0, 1, 3, 2]]
    return TetMesh(points, joined)


def ellipsoid(edge_mm: float, radii: tuple[float, float, float] = (40.0, 50.0, 65.0)) -> TetMesh:
    """Stuffed ellipsoid about the origin."""
    r = np.array(radii)
    return stuff_level_set(lambda p: (1 - np.linalg.norm(p / r, axis=1)) * r.min(), -r - 5, r + 5, edge_mm)


def compliance_of(body: Solid, nodes: Array) -> Compliance:
    """Compliance of a body's contact nodes (nc,)."""
    place = np.full(3 * len(body.mesh.points), -1)
    place[body.free_unknowns] = np.arange(len(body.free_unknowns))
    return Compliance(body.solver, place[unknowns_of(nodes)].reshape(-1, 3), len(body.free_unknowns))


def order(steps: list[float], errors: list[float]) -> Array:
    """Observed orders of convergence between successive meshes."""
    return np.log(np.array(errors[:-1]) / errors[1:]) / np.log(np.array(steps[:-1]) / steps[1:])
