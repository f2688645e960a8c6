"""Derivatives of a solved contact problem at its active set."""

from __future__ import annotations

import numpy as np
from scipy.linalg import lu_factor, lu_solve, solve

from poro.arrays import Array
from poro.contact.active_set import ContactState
from poro.contact.chest_wall import ChestWall
from poro.contact.compliance import Compliance

REFINEMENTS = 8  # of a factor in single precision, before double precision has to do


def contact_sensitivity(
    compliance: Compliance, wall: ChestWall, state: ContactState, free: Array, travel: Array
) -> Array:
    """Derivatives of the contact forces, (nc, 3, k), at a fixed active set.

    free: (nc, 3, k) derivatives of the displacements without wall; travel: (k,) derivatives of the wall's travel. The
    wall's curvature turns the forces as the nodes slide; normal and turning forces come from one symmetric system.
    Raises ValueError for contact between pieces, whose derivatives are not known.
    """
    if state.between is not None:
        raise ValueError("derivatives of contact are known for one piece in front of a wall, not for two that touch")
    active = np.flatnonzero(state.active)
    sliding, along, values = _nodal_stiffness(np.where(state.active, state.force, 0), state.hessian)
    rows = np.concatenate([active, sliding])
    direction = np.concatenate([state.gradient[active], along])
    result = np.zeros_like(free)
    if len(rows) == 0:
        return result
    matrix = compliance.between(rows, direction)
    matrix += np.diag(np.concatenate([np.zeros(len(active)), 1 / values]))
    drift = -(wall.moving[:, None] * wall.axis)[:, :, None] * travel
    weight = -_solved(matrix, np.einsum("rd,rdk->rk", direction, (free + drift)[rows]))
    np.add.at(result, rows, direction[:, :, None] * weight[:, None])
    return result


def _solved(matrix: Array, right: Array) -> Array:
    """Solutions (r, k) of a symmetric indefinite matrix (r, r): factored in single precision and refined, which is
    several times as fast; in double where that does not converge.
    """
    scale = 1 / np.sqrt(np.abs(np.diag(matrix)))
    scaled, wanted = matrix * np.outer(scale, scale), right * scale[:, None]
    factor = lu_factor(scaled.astype(np.float32), check_finite=False)
    x = np.zeros_like(wanted)
    for _ in range(REFINEMENTS):
        left = wanted - scaled @ x
        if np.linalg.norm(left) < 1e-9 * np.linalg.norm(wanted):
            return x * scale[:, None]
        x = x + lu_solve(factor, left.astype(np.float32), check_finite=False)
    return np.asarray(solve(matrix, right, assume_a="sym"))


LEAST_SHARE = 1e-4
"""Of the largest eigenvalue; what is smaller is left out."""


def _nodal_stiffness(force: Array, hessian: Array) -> tuple[Array, Array, Array]:
    """Geometric stiffness node by node: nodes (r,), directions (r, 3) and eigenvalues (r,) kPa mm of it under forces
    (nc,).
    """
    nodes = np.flatnonzero(force)
    values, vectors = np.linalg.eigh(-force[nodes, None, None] * hessian[nodes])
    flat = values.ravel()
    keep = np.abs(flat) > LEAST_SHARE * np.abs(flat).max(initial=0)
    return np.repeat(nodes, 3)[keep], vectors.transpose(0, 2, 1).reshape(-1, 3)[keep], flat[keep]
