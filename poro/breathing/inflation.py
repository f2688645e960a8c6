"""A lung filled to a given volume inside a cavity: the transpulmonary pressure is an unknown of the same Newton.

Ref: Eom 2010, section II B (pressure by volume, sliding contact without friction); Riks 1979 (bordered systems).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_matrix, csr_matrix, diags

from poro.arrays import Array
from poro.breathing.equilibrium import Scene, convex, energy_of, volume
from poro.fem.forms import deformation_gradient, eigenstress_load, tangent_stiffness
from poro.linalg.solver import linear_solver

STEPS = 20
_HALVINGS = 8
VOLUME_KPA = 60.0
"""Stiffness of the spring that holds the volume: a pressure of 0.6 kPa leaves one hundredth of it missing."""
CLOSE_MM = 0.3
"""Largest change of a node in a step at which the lung has settled."""


@dataclass(frozen=True)
class Filled:
    """A lung at a volume. u: (n, 3) mm; transpulmonary_kpa: that holds it; steps: of Newton; settled: whether the last
    one was below `CLOSE_MM`; volume_mm3: reached.
    """

    u: Array
    transpulmonary_kpa: float
    steps: int
    settled: bool
    volume_mm3: float


def fill(
    scene_at: Callable[[float], Scene], shares: Sequence[float], wanted_mm3: Callable[[float], float], guess: Array
) -> Iterator[Filled]:
    """The lung at every share of its way, each from the one before and a step of the first guess (n, 3) mm.

    scene_at: what acts at a share; wanted_mm3: the volume there; guess: displacement at share 1, roughly.
    """
    u, last = np.zeros_like(guess), 0.0
    for share in shares:
        start = u + (share - last) * guess
        if not (np.linalg.det(deformation_gradient(scene_at(share).mesh, start)) > 0.05).all():
            start = u
        found = fill_to(scene_at(share), wanted_mm3(share), start)
        u, last = found.u, share
        yield found


def fill_to(scene: Scene, wanted_mm3: float, u: Array) -> Filled:
    """Displacement at which the forces balance and the volume is all but `wanted_mm3`, and the pressure that asks for.

    Energy descent: tissue, constraints, cavity and a stiff spring on the volume, whose force is the pressure.
    """
    rest_mm3 = float(scene.mesh.volumes.sum())
    settled, taken = False, 0
    while not np.isfinite(energy_of(scene, u)) and np.abs(u).max() > CLOSE_MM:
        u = u / 2
    while taken < STEPS and not settled:
        taken += 1
        pressure = VOLUME_KPA * (wanted_mm3 - volume(scene.mesh, u)) / rest_mm3
        swell = _swelling(scene, u)
        rest, matrix = _linearized(scene, u)
        solver = linear_solver(matrix, scene.mesh.points, scene.tree)
        solved = solver.solve(np.stack([(rest + pressure * swell).ravel(), swell.ravel()], axis=1))
        free, forced = (solved[:, k].reshape(-1, 3) for k in range(2))
        # Sherman and Morrison: the volume's spring adds a product of one vector with itself to the matrix.
        share = VOLUME_KPA / rest_mm3
        change = free - forced * (share * (swell * free).sum() / (1 + share * (swell * forced).sum()))
        length = _length(scene, u, change, wanted_mm3, float(((rest + pressure * swell) * change).sum()))
        if length is None:
            break
        u = u + length * change
        settled = bool(length == 1.0 and np.abs(change).max() < CLOSE_MM)
    reached = volume(scene.mesh, u)
    return Filled(u, VOLUME_KPA * (wanted_mm3 - reached) / rest_mm3, taken, settled, reached)


def _length(scene: Scene, u: Array, change: Array, wanted_mm3: float, slope: float) -> float | None:
    """Largest tried length at which the energy falls; None when it falls at none."""
    rest_mm3 = float(scene.mesh.volumes.sum())

    def energy(at: Array) -> float:
        stored = energy_of(scene, at)
        if not np.isfinite(stored):
            return np.inf
        return stored + VOLUME_KPA / 2 * (wanted_mm3 - volume(scene.mesh, at)) ** 2 / rest_mm3

    before, length = energy(u), 1.0
    if not np.isfinite(before):
        return None
    for _ in range(_HALVINGS):
        if energy(u + length * change) <= before - 1e-4 * length * slope + 1e-12 * abs(before):
            return length
        length /= 2
    return None


def _swelling(scene: Scene, u: Array) -> Array:
    """Derivative (n, 3) mm2 of the volume by the nodes: the force of a unit pressure within."""
    f = deformation_gradient(scene.mesh, u)
    cofactor = np.linalg.det(f)[:, None, None] * np.linalg.inv(f).transpose(0, 2, 1)
    return eigenstress_load(scene.mesh, cofactor)


def _linearized(scene: Scene, u: Array) -> tuple[Array, csr_matrix]:
    """Unbalanced forces (n, 3) without pressure, and the convex part of their tangent.

    The pressure's own tangent cancels but at the surface, and is left out: it can only slow the descent down.
    """
    _, stress, moduli = scene.material.respond(deformation_gradient(scene.mesh, u))
    moduli = convex(moduli.reshape(-1, 9, 9)).reshape(moduli.shape)
    rest = scene.constraints.force - (scene.constraints.matrix @ u.ravel()).reshape(-1, 3)
    rest = rest - eigenstress_load(scene.mesh, stress)
    matrix = tangent_stiffness(scene.mesh, moduli) + scene.constraints.matrix
    if scene.cavity is not None:
        _, force, blocks = scene.cavity.respond(scene.mesh.points + u)
        rest = rest + force
        n = len(u)
        matrix = matrix + bsr_matrix((blocks, np.arange(n), np.arange(n + 1))).tocsr()
    return rest, (matrix + diags(np.full(matrix.shape[0], 1e-6 * matrix.diagonal().mean()))).tocsr()
