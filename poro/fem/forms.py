"""Finite-element matrices of linear tetrahedra, assembled in batches.

Unknowns of displacement are numbered 3 * node + axis. Ref: Alvarez 2021, eqs. 2, 10, 11.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.sparse import bsr_matrix, coo_matrix, csr_matrix

from poro.arrays import Array
from poro.mesh.tetmesh import TetMesh


def _scatter(mesh: TetMesh, local: Array, rows: int, columns: int) -> csr_matrix:
    """Sum element blocks (m, 4 * rows, 4 * columns) into a sparse matrix (n * rows, n * columns)."""
    m, n = len(mesh.tets), len(mesh.points)
    i, j = np.broadcast_arrays(mesh.tets[:, :, None], mesh.tets[:, None, :])
    graph = coo_matrix((np.ones(16 * m), (i.ravel(), j.ravel())), shape=(n, n)).tocsr()
    blocks = np.zeros((graph.nnz, rows, columns))
    tets = np.asarray(mesh.tets, np.int64)
    _add_blocks(blocks, graph.indptr, graph.indices, tets, local.reshape(m, 4, rows, 4, columns))
    return bsr_matrix((blocks, graph.indices, graph.indptr), shape=(n * rows, n * columns)).tocsr()


@njit(cache=True)
def _add_blocks(blocks: Array, indptr: Array, indices: Array, tets: Array, local: Array) -> None:
    for t in range(len(tets)):
        for a in range(4):
            row = tets[t, a]
            neighbours = indices[indptr[row] : indptr[row + 1]]
            for b in range(4):
                blocks[indptr[row] + np.searchsorted(neighbours, tets[t, b])] += local[t, a, :, b]


def stiffness(mesh: TetMesh, lame: float | Array, shear: float | Array) -> csr_matrix:
    """Linear elasticity: integral of (lambda tr(eps) I + 2 mu eps) : eps(v), (3n, 3n) kPa mm; moduli scalar or (m,)
    kPa.
    """
    g = mesh.gradients
    volume = mesh.volumes
    outer = np.einsum("mai,mbj->maibj", g, g)
    dots = np.einsum("mai,mbi->mab", g, g)
    swapped = outer.transpose(0, 1, 4, 3, 2)
    local = (lame * volume)[:, None, None, None, None] * outer + (shear * volume)[:, None, None, None, None] * swapped
    for axis in range(3):
        local[:, :, axis, :, axis] += (shear * volume)[:, None, None] * dots
    return _scatter(mesh, local.reshape(-1, 12, 12), 3, 3)


def tangent_stiffness(mesh: TetMesh, moduli: Array) -> csr_matrix:
    """Integral of grad v : A : grad u, (3n, 3n) kPa mm, of moduli A (m, 3, 3, 3, 3) kPa by the displacement's
    gradient.
    """
    half = np.einsum("mijkl,mbl->mijbk", moduli, mesh.gradients)
    local = np.einsum("maj,mijbk,m->maibk", mesh.gradients, half, mesh.volumes, optimize=True)
    return _scatter(mesh, local.reshape(-1, 12, 12), 3, 3)


def laplacian(mesh: TetMesh) -> csr_matrix:
    """Integral of grad p . grad q, (n, n) mm."""
    return _scatter(mesh, np.einsum("mai,mbi,m->mab", mesh.gradients, mesh.gradients, mesh.volumes), 1, 1)


def consistent_mass(mesh: TetMesh) -> csr_matrix:
    """Integral of p q, (n, n) mm3."""
    local = (np.ones((4, 4)) + np.eye(4)) / 20 * mesh.volumes[:, None, None]
    return _scatter(mesh, local, 1, 1)


def gradient_load(mesh: TetMesh) -> csr_matrix:
    """Integral of -grad p . v, (3n, n) mm2: nodal forces of a unit Biot coefficient per kPa of nodal pressure."""
    local = -np.einsum("mbi,m->mib", mesh.gradients, mesh.volumes / 4)
    local = np.repeat(local[:, None], 4, axis=1).reshape(-1, 12, 4)
    return _scatter(mesh, local, 3, 1)


def body_load(mesh: TetMesh, density: Array) -> Array:
    """Nodal forces (n, 3) kPa mm2 of a uniform force density (3,) kPa/mm."""
    return mesh.node_volumes[:, None] * density


def eigenstress_load(mesh: TetMesh, stress: Array) -> Array:
    """Nodal forces (n, 3) that an eigenstress (m, 3, 3) kPa exerts: integral of stress : grad v."""
    local = np.einsum("mij,maj,m->mai", stress, mesh.gradients, mesh.volumes)
    force = np.zeros((len(mesh.points), 3))
    np.add.at(force, mesh.tets, local)
    return force


def deformation_gradient(mesh: TetMesh, u: Array) -> Array:
    """F = I + grad u in every tetrahedron, (m, 3, 3), of nodal displacements (n, 3) mm."""
    return np.eye(3) + np.einsum("mai,maj->mij", u[mesh.tets], mesh.gradients)
