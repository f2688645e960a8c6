"""Equilibrium of a lung as pre-stressed, heterogeneous neo-Hookean tissue inside a cage, at finite strain.

The CT is the reference. The tissue's own rest shape is smaller by the factor `rest`; the chest wall holds it open.
    W(F) = rest^3 w(F / rest),   w(G) = mu/2 (tr G^T G - 3 - 2 ln det G) + lambda/2 (ln det G)^2
Energy is minimized over the coefficients of spline maps, one for each lobe. Lobes touch without friction at the
fissures and are tied where they have grown together.
Ref: Bonet and Wood 2008, eq. 6.27 (the tissue).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from phantoms.descent import Status, minimize
from phantoms.fields import Lattice
from phantoms.fissure_contact import Side, contact_energy, make_joint
from phantoms.lobes import LobedMap, Lobes
from phantoms.spline import SplineMap, basis, cofactors, determinant

Array = NDArray[Any]
TOUCH_SHARE = 0.03
"""Share of the stiffness of a fissure's contact that the metric of the steps knows: it resists no sliding."""


@dataclass(frozen=True)
class Tissue:
    """Lung tissue at quadrature points. points: (n, 3) RAS mm in the CT; volume: (n,) mm3; shear: (n,) kPa;
    rest: (n,) rest length over length in the CT; density: kg/m3 in the CT; lobe: (n,) which one each point is of."""

    points: Array
    volume: Array
    shear: Array
    rest: Array
    density: float
    lobe: Array


@dataclass(frozen=True)
class Pleura:
    """Surface of the lung in the CT. points: (n, 3) mm; area: (n,) mm2; cage: signed distance (mm) to the wall, in the
    state; held: whether the wall holds the lung (inflated) or only stops it (pleural gas); lobe: (n,)."""

    points: Array
    area: Array
    cage: Lattice
    held: bool
    lobe: Array


@dataclass(frozen=True)
class Tie:
    """Tissue tied to the mediastinum or the wall. points: (n, 3) mm in the CT; target: (n, 3) mm in the state;
    stiffness: kPa mm a point; lobe: (n,)."""

    points: Array
    target: Array
    stiffness: float
    lobe: Array


@dataclass(frozen=True)
class Scene:
    """A lung and all that acts on it. gravity: (3,) unit vector."""

    tissue: Tissue
    pleura: Pleura
    ties: Sequence[Tie]
    lobes: Lobes
    gravity: Array


@dataclass(frozen=True)
class Equilibrium:
    """Result of `relax`. history: out-of-balance force per step, relative to the first."""

    state_from_ct: LobedMap
    status: Status
    history: Array


def tissue_points(lung: Lattice, step_mm: float) -> tuple[Array, Array]:
    """Quadrature points (n, 3) mm and volumes (n,) mm3 that fill a region given by its signed distance."""
    low = lung.origin
    high = low + lung.spacing * (np.array(lung.values.shape) - 1)
    axes = [np.arange(a, b, step_mm) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    share = np.clip(0.5 - lung.at(points) / step_mm, 0, 1)
    return points[share > 0.05], share[share > 0.05] * step_mm**3


def relax(
    scene: Scene,
    guess: Callable[[Array], Array],
    volume_ratio: float | None,
    spacing_mm: float,
    limit: float = 1e-2,
) -> Equilibrium:
    """Equilibrium of the lung on splines of `spacing_mm`, from the start that maps CT points by `guess`.

    volume_ratio: volume over that in the CT, met by scaling the rest shape; None leaves it;
    limit: out-of-balance force at which to stop, over that of the start.
    """
    tissue = scene.tissue
    low, high = tissue.points.min(axis=0) - 2.5 * spacing_mm, tissue.points.max(axis=0) + 2.5 * spacing_mm
    nx, ny, nz = (int(n) for n in np.ceil((high - low) / spacing_mm) + 1)
    problem = _Problem(scene, low, spacing_mm, (nx, ny, nz))
    u = problem.fit(guess)
    histories: list[Array] = []
    for _ in range(4):
        u, status, history = minimize(problem, u, histories[0][0] if histories else None, limit=limit)
        histories.append(history)
        ratio = problem.volume(u) / float(tissue.volume.sum())
        if volume_ratio is None or abs(ratio / volume_ratio - 1) < 3e-3:
            break
        rest = problem.tissue.rest * np.cbrt(volume_ratio / ratio)
        problem.tissue = replace(problem.tissue, rest=np.clip(rest, 0.5, 0.99))
    forces = np.concatenate(histories)
    return Equilibrium(LobedMap(tuple(problem.maps(u)), scene.lobes), status, forces / forces[0])


class _Problem:
    """Energy of the lung over the splines' active coefficients (n, 3), its gradient, and a fixed metric for steps."""

    def __init__(self, scene: Scene, origin: Array, spacing: float, shape: tuple[int, int, int]) -> None:
        tissue, pleura, lobes = scene.tissue, scene.pleura, scene.lobes
        self.tissue, self.pleura, self.lobes = tissue, pleura, lobes
        self.origin, self.spacing, self.shape = origin, spacing, shape
        inside, *slopes = self._basis(tissue.points, tissue.lobe)
        self.active = np.flatnonzero(inside.sum(axis=0) > 0)
        self.spread = self._spread()
        self.value = inside[:, self.active]
        self.slopes = [s[:, self.active] for s in slopes]
        self.on_pleura = self._basis(pleura.points, pleura.lobe)[0][:, self.active]
        self.ties = [(tie, self._basis(tie.points, tie.lobe)[0][:, self.active]) for tie in scene.ties]
        joint = make_joint(lobes, pleura.held)
        self.sides = joint.sides
        self.grown = [(self._jump(side), side.stiffness[:, None]) for side in joint.grown]
        self.lame = 1.5 * tissue.shear
        self.contact = (4.0 if pleura.held else 1.5) * pleura.area
        weight = tissue.density * 9.81e-6 * tissue.volume
        self.load = (self.value.T @ weight)[:, None] * scene.gravity
        stiff = tissue.volume * tissue.shear * tissue.rest
        self.smooth = self._roughness(spacing) * (0.02 * float(tissue.shear.mean()))
        laplace = sum((s.T @ (s * (3 * stiff)[:, None]) for s in self.slopes), start=self.smooth)
        touch = self.on_pleura.T @ (self.on_pleura * (self.contact / 3)[:, None])
        for jump, stiffness in self.grown + [(self._jump(s), TOUCH_SHARE * s.stiffness[:, None]) for s in self.sides]:
            touch = touch + jump.T @ (jump * stiffness)
        metric = laplace + touch
        for tie, on in self.ties:
            metric = metric + on.T @ (on * tie.stiffness)
        self.metric = splu(sparse.csc_array(metric))

    def _basis(self, points: Array, lobe: Array) -> list[sparse.csr_array]:
        """As `basis`, with the columns of one lobe after those of another."""
        nodes, count = int(np.prod(self.shape)), len(self.lobes.regions)
        shift = np.repeat(np.asarray(lobe) * nodes, 27)
        return [
            sparse.csr_array((m.data, m.indices + shift, m.indptr), shape=(len(points), count * nodes))
            for m in basis(points, self.origin, self.spacing, self.shape)
        ]

    def _jump(self, side: Side) -> sparse.csr_array:
        """Displacement of the own lobe less that of the other at a side's points."""
        n = len(side.points)
        own, other = (self._basis(side.points, np.full(n, lobe))[0] for lobe in (side.own, side.other))
        return sparse.csr_array((own - other)[:, self.active])

    def _roughness(self, spacing: float) -> sparse.csr_array:
        """Bending of the coefficients: it carries the map smoothly a little way beyond the pleura."""
        nodes = int(np.prod(self.shape))
        lookup = np.full(len(self.lobes.regions) * nodes, -1)
        lookup[self.active] = np.arange(len(self.active))
        rows = []
        for grid in lookup.reshape(-1, *self.shape):
            for axis in range(3):
                a, b, c = (np.moveaxis(grid, axis, 0)[m : m + grid.shape[axis] - 2] for m in range(3))
                ok = (a >= 0) & (b >= 0) & (c >= 0)
                rows.append(np.stack([a[ok], b[ok], c[ok]], axis=1))
        index = np.concatenate(rows)
        n = len(index)
        data = np.tile([1.0, -2.0, 1.0], n) * np.sqrt(spacing)
        second = sparse.csr_array((data, index.ravel(), np.arange(n + 1) * 3), shape=(n, len(self.active)))
        return sparse.csr_array(second.T @ second)

    def fit(self, guess: Callable[[Array], Array]) -> Array:
        """Coefficients whose map is closest to `guess` at the tissue's points."""
        t = self.tissue
        normal = self.value.T @ (self.value * t.volume[:, None]) + self.smooth * 1e-2
        right = self.value.T @ ((guess(t.points) - t.points) * t.volume[:, None])
        return splu(sparse.csc_array(normal)).solve(right)

    def _spread(self) -> sparse.csr_array:
        """Matrix that gives every coefficient of every lobe the value of that lobe's nearest active one."""
        nodes = int(np.prod(self.shape))
        lookup = np.full(len(self.lobes.regions) * nodes, -1)
        lookup[self.active] = np.arange(len(self.active))
        found = []
        for grid in lookup.reshape(-1, *self.shape):
            i, j, k = ndimage.distance_transform_edt(grid < 0, return_distances=False, return_indices=True)
            found.append(grid[i, j, k].ravel())
        n = len(lookup)
        return sparse.csr_array((np.ones(n), np.concatenate(found), np.arange(n + 1)), shape=(n, len(self.active)))

    def maps(self, u: Array) -> list[SplineMap]:
        """The map of each lobe; passive coefficients are copied from their nearest active neighbour."""
        full = (self.spread @ u).reshape(-1, *self.shape, 3)
        return [SplineMap(np.ascontiguousarray(c), self.origin, self.spacing) for c in full]

    def volume(self, u: Array) -> float:
        """Volume of the lung in mm3."""
        f = np.stack([s @ u for s in self.slopes], axis=-1) + np.eye(3)
        return float(self.tissue.volume @ determinant(f))

    def energy(self, u: Array) -> tuple[float, Array]:
        """Energy (kPa mm3) and its gradient (n, 3); infinite where an element is turned inside out."""
        t = self.tissue
        f = np.stack([s @ u for s in self.slopes], axis=-1) + np.eye(3)
        cofactor = cofactors(f)
        j = (f[:, 0] * cofactor[:, 0]).sum(axis=1)
        if j.min() <= 0:
            return np.inf, np.zeros_like(u)
        g = f / t.rest[:, None, None]
        log_j = np.log(j / t.rest**3)
        rest_volume = t.volume * t.rest**3
        w = t.shear / 2 * (np.einsum("nij,nij->n", g, g) - 3 - 2 * log_j) + self.lame / 2 * log_j**2
        inverse_t = cofactor / j[:, None, None]
        stress = (t.shear / t.rest**2)[:, None, None] * f + ((self.lame * log_j - t.shear)[:, None, None]) * inverse_t
        stress *= rest_volume[:, None, None]
        total = float(w @ rest_volume) - float((self.load * u).sum())
        gradient = sum((s.T @ stress[:, :, m] for m, s in enumerate(self.slopes)), start=-self.load)
        rough = self.smooth @ u
        total += 0.5 * float((u * rough).sum())
        gradient = gradient + rough
        depth, normal = self.pleura.cage.with_gradient(self.pleura.points + self.on_pleura @ u)
        if not self.pleura.held:
            depth = np.maximum(depth, 0)
        push = self.contact * depth
        total += 0.5 * float(push @ depth)
        gradient = gradient + self.on_pleura.T @ (push[:, None] * normal)
        for tie, on in self.ties:
            pull = tie.points + on @ u - tie.target
            total += 0.5 * tie.stiffness * float((pull**2).sum())
            gradient = gradient + tie.stiffness * (on.T @ pull)
        for jump, stiffness in self.grown:
            tear = jump @ u
            total += 0.5 * float((stiffness * tear**2).sum())
            gradient = gradient + jump.T @ (stiffness * tear)
        if self.sides:
            touching, slopes, _ = contact_energy(self.sides, self.maps(u), self.lobes.regions)
            total += touching
            gradient = gradient + self.spread.T @ np.stack(slopes).reshape(-1, 3)
        return total, gradient
