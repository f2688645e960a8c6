"""Springs by which a curved wall turns the contact forces on nodes that slide along it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from poro.contact.compliance import Compliance, Groups
from poro.mesh.tetmesh import Array

SPRING_CUT = 0.03  # springs softer than this share of the stiffest wait for the next linearization


@dataclass(frozen=True)
class Springs:
    """Springs on the mean motion of groups of contact nodes.

    which: (r,) group; along: (r, 3) unit directions; matrix: (r, r) of their own compliance, the springs' included.
    """

    groups: Groups
    which: Array
    along: Array
    matrix: Array

    def stretch(self, u: Array) -> Array:
        """Mean motion (r,) along every spring of displacements u (nc, 3)."""
        label, share = self.groups.label, self.groups.share
        mean = np.stack([np.bincount(label, u[:, axis], len(share)) * share for axis in range(3)], axis=1)
        return np.asarray(np.einsum("rb,rb->r", mean[self.which], self.along))

    def along_normals(self, nodes: Array, normal: Array) -> Array:
        """Motion (k, r) of nodes (k,) along normal (k, 3) under a unit force of every spring."""
        return _along_normals(self.groups.motion, nodes, normal, self.which, self.along)

    def motion(self, force: Array) -> Array:
        """Displacements (nc, 3) under the springs' forces (r,)."""
        label = self.groups.label
        if not len(force):
            return np.zeros((len(label), 3))
        pull = self._pull(force)
        flat = self.groups.motion.reshape(3 * len(label), -1) @ pull.ravel().astype(self.groups.motion.dtype)
        return flat.astype(float).reshape(-1, 3)

    def spread(self, force: Array) -> Array:
        """The springs' forces (r,) as forces (nc, 3) on the nodes."""
        return (self._pull(force) * self.groups.share[:, None])[self.groups.label]

    def _pull(self, force: Array) -> Array:
        pull = np.zeros((len(self.groups.share), 3))
        np.add.at(pull, self.which, self.along * force[:, None])
        return pull


def group_springs(compliance: Compliance, points: Array, force: Array, hessian: Array) -> Springs:
    """Springs of forces (nc,) on a wall of Hessian (nc, 3, 3): a hollow wall steadies the nodes that press on it.

    Only motions as long as a group feel the curvature as much as the tissue, so groups of nodes at points (nc, 3)
    share three springs; what they miss the next linearization makes up.
    """
    groups = compliance.groups(points)
    count = len(groups.share)
    turned = (-force[:, None, None] * hessian).reshape(-1, 9)
    stiff = np.stack([np.bincount(groups.label, turned[:, k], count) for k in range(9)], axis=1).reshape(-1, 3, 3)
    values, vectors = np.linalg.eigh(stiff)
    flat = values.ravel()
    keep = np.abs(flat) > SPRING_CUT * np.abs(flat).max(initial=0)
    which = np.repeat(np.arange(count), 3)[keep]
    along = vectors.transpose(0, 2, 1).reshape(-1, 3)[keep]
    return Springs(groups, which, along, _among(groups.mean, which, along) + np.diag(1 / flat[keep]))


@njit(cache=True)
def _among(mean: Array, which: Array, along: Array) -> Array:
    result = np.zeros((len(which), len(which)))
    for r in range(len(which)):
        for s in range(len(which)):
            for a in range(3):
                for b in range(3):
                    result[r, s] += along[r, a] * mean[which[r], a, which[s], b] * along[s, b]
    return result


@njit(cache=True)
def _along_normals(motion: Array, nodes: Array, normal: Array, which: Array, along: Array) -> Array:
    result, row = np.empty((len(nodes), len(which))), np.empty(motion.shape[2:])
    for k in range(len(nodes)):
        m, n = motion[nodes[k]], normal[k]
        for g in range(len(row)):
            for b in range(3):
                row[g, b] = n[0] * m[0, g, b] + n[1] * m[1, g, b] + n[2] * m[2, g, b]
        for r in range(len(which)):
            g = which[r]
            result[k, r] = along[r, 0] * row[g, 0] + along[r, 1] * row[g, 1] + along[r, 2] * row[g, 2]
    return result
