"""Geometric stiffness of contact: how a curved wall turns the contact forces on nodes that slide along it.

The potential of a contact force f on a gap g has the Hessian -f grad grad g. A hollow wall makes it positive, which
steadies the lung; a bulging one negative. Ref: Wriggers 2006 (tangent of contact).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.sparse import csr_matrix

from poro.arrays import Array
from poro.contact.compliance import Compliance, Groups

STIFFNESS_CUT = 0.03  # eigenvalues below this share of the largest wait for the next linearization


class Directions(NamedTuple):
    """Rank-one terms of a stiffness. group: (r,) whose mean motion each resists; unit: (r, 3) along which."""

    group: Array
    unit: Array


@dataclass(frozen=True)
class GeometricStiffness:
    """Stiffness of low rank r on the mean motion of groups of contact nodes.

    directions: of its r terms; compliance: (r, r) among the terms, the inverse of their own stiffness included.
    """

    groups: Groups
    directions: Directions
    compliance: Array

    def project(self, u: Array) -> Array:
        """Mean motion (r,) along every term of displacements u (nc, 3)."""
        label, share = self.groups.label, self.groups.share
        mean = np.stack([np.bincount(label, u[:, axis], len(share)) * share for axis in range(3)], axis=1)
        return np.asarray(np.einsum("rb,rb->r", mean[self.directions.group], self.directions.unit))

    def coupling(self, nodes: Array, normal: Array) -> Array:
        """Motion (k, r) of nodes (k,) along normal (k, 3) under a unit force of every term."""
        return _coupling(self.groups.motion, nodes, normal, self.directions)

    def coupling_of(self, gradients: csr_matrix) -> Array:
        """Motion (k, r) along gradients (k, 3 nc), each of several nodes, under a unit force of every term."""
        group, unit = self.directions
        motion = self.groups.motion
        moved = np.asarray(gradients @ motion.reshape(len(motion) * 3, -1)).reshape(gradients.shape[0], -1, 3)
        return np.asarray(np.einsum("krb,rb->kr", moved[:, group], unit))

    def displacements(self, force: Array) -> Array:
        """Displacements (nc, 3) under the terms' forces (r,)."""
        label = self.groups.label
        if not len(force):
            return np.zeros((len(label), 3))
        on_groups = self._on_groups(force)
        flat = self.groups.motion.reshape(3 * len(label), -1) @ on_groups.ravel().astype(self.groups.motion.dtype)
        return flat.astype(float).reshape(-1, 3)

    def nodal_forces(self, force: Array) -> Array:
        """The terms' forces (r,) as forces (nc, 3) on the nodes."""
        return (self._on_groups(force) * self.groups.share[:, None])[self.groups.label]

    def _on_groups(self, force: Array) -> Array:
        total = np.zeros((len(self.groups.share), 3))
        np.add.at(total, self.directions.group, self.directions.unit * force[:, None])
        return total


def geometric_stiffness(compliance: Compliance, points: Array, force: Array, hessian: Array) -> GeometricStiffness:
    """Geometric stiffness of forces (nc,) on a wall of Hessian (nc, 3, 3), the largest terms of it.

    Only motions as long as a group feel the curvature as much as the tissue, so groups of nodes at points (nc, 3)
    share three terms; what they miss the next linearization makes up.
    """
    groups = compliance.groups(points)
    count = len(groups.share)
    terms = (-force[:, None, None] * hessian).reshape(-1, 9)
    stiff = np.stack([np.bincount(groups.label, terms[:, k], count) for k in range(9)], axis=1).reshape(-1, 3, 3)
    values, vectors = np.linalg.eigh(stiff)
    flat = values.ravel()
    keep = np.abs(flat) > STIFFNESS_CUT * np.abs(flat).max(initial=0)
    group = np.repeat(np.arange(count), 3)[keep]
    directions = Directions(group, vectors.transpose(0, 2, 1).reshape(-1, 3)[keep])
    return GeometricStiffness(groups, directions, _among(groups.mean, directions) + np.diag(1 / flat[keep]))


@njit(cache=True)
def _among(mean: Array, directions: Directions) -> Array:
    group, unit = directions
    result = np.zeros((len(group), len(group)))
    for r in range(len(group)):
        for s in range(len(group)):
            for a in range(3):
                for b in range(3):
                    result[r, s] += unit[r, a] * mean[group[r], a, group[s], b] * unit[s, b]
    return result


@njit(cache=True)
def _coupling(motion: Array, nodes: Array, normal: Array, directions: Directions) -> Array:
    group, unit = directions
    result, row = np.empty((len(nodes), len(group))), np.empty(motion.shape[2:])
    for k in range(len(nodes)):
        m, n = motion[nodes[k]], normal[k]
        for g in range(len(row)):
            for b in range(3):
                row[g, b] = n[0] * m[0, g, b] + n[1] * m[1, g, b] + n[2] * m[2, g, b]
        for r in range(len(group)):
            g = group[r]
            result[k, r] = unit[r, 0] * row[g, 0] + unit[r, 1] * row[g, 1] + unit[r, 2] * row[g, 2]
    return result
