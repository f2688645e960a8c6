"""The weak forms of the method on linear tetrahedra, as scikit-fem reads them, and the matrices and loads they become.

Find u and p so that for all v and q

    elasticity(u, v) = biot pressure_force(p, v) + body_force(v) + initial_stress(v)
    mobility diffusion(p, q) + kappa_b reaction(p, q) = kappa_b reaction(p_bronchial, q)

Unknowns of displacement are numbered 3 * node + axis. Ref: Alvarez 2021, eqs. 2, 10, 11.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit
from scipy.sparse import coo_matrix, csr_matrix
from skfem import Basis, BilinearForm, ElementTetP1, ElementVector, LinearForm, MeshTet
from skfem.helpers import ddot, div, dot, grad, sym_grad

from poro.arrays import Array
from poro.mesh.tetmesh import TetMesh

KEPT_MESHES = 3  # of a run that works on a fine mesh and a coarse one, and makes a fine one ready beside them
CONSTANT, QUADRATIC = 1, 2  # degree of the polynomials that the quadrature integrates exactly


@BilinearForm
def elasticity(u: Any, v: Any, w: Any) -> Any:  # lambda (div u, div v) + 2 mu (eps(u), eps(v));  kPa mm
    return w.lame * div(u) * div(v) + 2 * w.shear * ddot(sym_grad(u), sym_grad(v))


@BilinearForm
def diffusion(p: Any, q: Any, _: Any) -> Any:  # (grad p, grad q);  mm
    return dot(grad(p), grad(q))


@BilinearForm
def reaction(p: Any, q: Any, _: Any) -> Any:  # (p, q);  mm3
    return p * q


@BilinearForm
def pressure_force(p: Any, v: Any, _: Any) -> Any:  # -(grad p, v);  mm2
    return -dot(grad(p), v)


@LinearForm
def body_force(v: Any, w: Any) -> Any:  # (f, v);  kPa mm2
    return dot(w.force, v)


@LinearForm
def initial_stress(v: Any, w: Any) -> Any:  # (sigma, grad v);  kPa mm2
    return ddot(w.stress, grad(v))


def scalar_basis(mesh: TetMesh, degree: int = CONSTANT) -> Basis:
    """Linear nodal functions, integrated exactly up to polynomials of `degree`."""
    return Basis(_skfem(mesh), ElementTetP1(), intorder=degree)


def vector_basis(mesh: TetMesh) -> Basis:
    """Linear nodal vector functions."""
    return Basis(_skfem(mesh), ElementVector(ElementTetP1()), intorder=CONSTANT)


def _skfem(mesh: TetMesh) -> MeshTet:
    return MeshTet(np.ascontiguousarray(mesh.points.T), np.ascontiguousarray(mesh.tets.T))


def stiffness(mesh: TetMesh, lame_kpa: float, shear_kpa: float) -> csr_matrix:
    """Matrix (3n, 3n) kPa mm of `elasticity`. The last few are kept, since an elastic correction or a continuation
    solves with the same one again and again; add to it, never change it.
    """
    return _stiffness(mesh, float(lame_kpa), float(shear_kpa))


@lru_cache(maxsize=KEPT_MESHES)
def _stiffness(mesh: TetMesh, lame_kpa: float, shear_kpa: float) -> csr_matrix:
    local = elasticity.coo_data(vector_basis(mesh), lame=lame_kpa, shear=shear_kpa).data
    return _sum_blocks(mesh, local.reshape(4, 3, 4, 3, -1))


def laplacian(mesh: TetMesh) -> csr_matrix:
    """Matrix (n, n) mm of `diffusion`."""
    return diffusion.assemble(scalar_basis(mesh))


def consistent_mass(mesh: TetMesh) -> csr_matrix:
    """Matrix (n, n) mm3 of `reaction`."""
    return reaction.assemble(scalar_basis(mesh, QUADRATIC))


def lumped_mass(mesh: TetMesh) -> csr_matrix:
    """Diagonal matrix (n, n) mm3 of `reaction`, integrated at the nodes."""
    at_nodes = np.column_stack([np.zeros(3), np.eye(3)]), np.full(4, 1 / 24)
    return reaction.assemble(Basis(_skfem(mesh), ElementTetP1(), quadrature=at_nodes))


def gradient_load(mesh: TetMesh) -> csr_matrix:
    """Matrix (3n, n) mm2 of `pressure_force`: nodal forces of a unit Biot coefficient per kPa of nodal pressure."""
    return pressure_force.assemble(scalar_basis(mesh), vector_basis(mesh))


def body_load(mesh: TetMesh, density: Array) -> Array:
    """Nodal forces (n, 3) kPa mm2 of `body_force` for a uniform force density (3,) kPa/mm."""
    return body_force.assemble(vector_basis(mesh), force=np.asarray(density, float)[:, None, None]).reshape(-1, 3)


def eigenstress_load(mesh: TetMesh, stress: Array) -> Array:
    """Nodal forces (n, 3) kPa mm2 of `initial_stress` for a stress (m, 3, 3) kPa."""
    return initial_stress.assemble(vector_basis(mesh), stress=stress.transpose(1, 2, 0)[..., None]).reshape(-1, 3)


def tangent_stiffness(mesh: TetMesh, moduli: Array) -> csr_matrix:
    """Integral of grad v : A : grad u, (3n, 3n) kPa mm, of moduli A (m, 3, 3, 3, 3) kPa by the displacement's
    gradient.

    Made anew in every Newton step. As a scikit-fem form it takes 82 instead of 28 ms for 6,127 tetrahedra and 362
    instead of 136 ms for 26,382 (processor time), so it stays a batched product; a test holds both to each other.
    """
    half = np.einsum("mijkl,mbl->mijbk", moduli, mesh.gradients)
    local = np.einsum("maj,mijbk,m->maibk", mesh.gradients, half, mesh.volumes, optimize=True)
    local = np.ascontiguousarray(local.transpose(1, 2, 3, 4, 0))
    return _sum_blocks(mesh, local)


def deformation_gradient(mesh: TetMesh, u: Array) -> Array:
    """F = I + grad u in every tetrahedron, (m, 3, 3), of nodal displacements (n, 3) mm."""
    return np.eye(3) + np.einsum("mai,maj->mij", u[mesh.tets], mesh.gradients)


def _sum_blocks(mesh: TetMesh, local: Array) -> csr_matrix:
    """Sum element matrices (4, 3, 4, 3, m) into a sparse one (3n, 3n): a block of 3 x 3 for each pair of nodes, 23 ms
    for 26,382 tetrahedra where scikit-fem's own summing of entries takes 91.
    """
    m, n = len(mesh.tets), len(mesh.points)
    i, j = np.broadcast_arrays(mesh.tets[:, :, None], mesh.tets[:, None, :])
    graph = coo_matrix((np.ones(16 * m), (i.ravel(), j.ravel())), shape=(n, n)).tocsr()
    data, columns = np.zeros(9 * graph.nnz), np.empty(9 * graph.nnz, np.int32)
    _add_blocks(data, columns, graph.indptr, graph.indices, np.asarray(mesh.tets, np.int64), local)
    start = 9 * graph.indptr[:-1, None] + 3 * np.diff(graph.indptr)[:, None] * np.arange(3)
    return csr_matrix((data, columns, np.append(start.ravel(), len(data)).astype(np.int32)), shape=(3 * n, 3 * n))


@njit(cache=True)
def _add_blocks(data: Array, columns: Array, indptr: Array, indices: Array, tets: Array, local: Array) -> None:
    for row in range(len(indptr) - 1):
        first, degree = indptr[row], indptr[row + 1] - indptr[row]
        for axis in range(3):
            start = 9 * first + 3 * degree * axis
            for k in range(degree):
                for other in range(3):
                    columns[start + 3 * k + other] = 3 * indices[first + k] + other
    for a in range(4):
        for b in range(4):
            for t in range(len(tets)):
                row = tets[t, a]
                first, degree = indptr[row], indptr[row + 1] - indptr[row]
                k = np.searchsorted(indices[first : first + degree], tets[t, b])
                for axis in range(3):
                    start = 9 * first + 3 * (degree * axis + k)
                    for other in range(3):
                        data[start + other] += local[a, axis, b, other, t]
