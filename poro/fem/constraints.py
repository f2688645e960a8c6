"""Point constraints: penalty terms that draw points of a mesh to places, the soft form of imposed displacements."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, identity, kron

from poro.arrays import Array
from poro.mesh.locate import Location


def interpolation_matrix(location: Location, nodes: int) -> csr_matrix:
    """Sparse (q, n) that interpolates a nodal field at located points."""
    rows = np.repeat(np.arange(len(location.nodes)), 4)
    return coo_matrix(
        (location.barycentric.ravel(), (rows, location.nodes.ravel())), shape=(len(location.nodes), nodes)
    ).tocsr()


def point_constraints(operator: csr_matrix, stiffness: Array, wanted: Array) -> tuple[csr_matrix, Array]:
    """Stiffness (3n, 3n) and nodal forces (n, 3) of penalties k |u(x) - wanted|^2 / 2 at interpolated points x.

    operator: (q, n); stiffness k: (q,) kPa mm in all directions, or (q, 3, 3); wanted: (q, 3) mm.
    """
    q, n = operator.shape
    if stiffness.ndim == 1:
        stiffness = stiffness[:, None, None] * np.eye(3)
    wide = kron(operator, identity(3), format="csr")
    index = np.arange(3 * q).reshape(q, 3)
    i, j = np.broadcast_arrays(index[:, :, None], index[:, None, :])
    block = coo_matrix((stiffness.ravel(), (i.ravel(), j.ravel())), shape=(3 * q, 3 * q)).tocsr()
    force = wide.T @ (block @ wanted.ravel())
    return (wide.T @ block @ wide).tocsr(), force.reshape(n, 3)
