"""Equilibrium of a lung as pre-stressed, heterogeneous neo-Hookean tissue inside a cage, at finite strain.

The CT is the reference. The tissue's own rest shape is smaller by the factor `rest`; the chest wall holds it open.
    W(F) = rest^3 w(F / rest),   w(G) = mu/2 (tr G^T G - 3 - 2 ln det G) + lambda/2 (ln det G)^2
Energy is minimized over the coefficients of a spline map by limited-memory quasi-Newton steps.
Ref: Bonet and Wood 2008, eq. 6.27 (the tissue); Liu 2017 (quasi-Newton steps in the metric of a Laplacian).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu
from skimage.measure import marching_cubes

from phantoms.fields import Lattice
from phantoms.spline import SplineMap, basis, cofactors, determinant

Array = NDArray[Any]


class Status(Enum):
    """How the search for equilibrium ended."""

    CONVERGED = "The out-of-balance force fell below its limit."
    STALLED = "The energy stopped falling before the out-of-balance force was below its limit."
    STEPS = "The allowed steps were used up."


@dataclass(frozen=True)
class Tissue:
    """Lung tissue at quadrature points. points: (n, 3) RAS mm in the CT; volume: (n,) mm3; shear: (n,) kPa;
    rest: (n,) rest length over length in the CT; density: kg/m3 in the CT."""

    points: Array
    volume: Array
    shear: Array
    rest: Array
    density: float


@dataclass(frozen=True)
class Pleura:
    """Surface of the lung in the CT. points: (n, 3) mm; area: (n,) mm2; cage: signed distance (mm) to the wall, in the
    state; held: whether the wall holds the lung (inflated) or only stops it (pleural gas)."""

    points: Array
    area: Array
    cage: Lattice
    held: bool


@dataclass(frozen=True)
class Hilum:
    """Tissue tied to the mediastinum. points: (n, 3) mm in the CT; target: (n, 3) mm in the state; stiffness: kPa mm
    a point."""

    points: Array
    target: Array
    stiffness: float


@dataclass(frozen=True)
class Equilibrium:
    """Result of `relax`. history: out-of-balance force per step, relative to the first."""

    state_from_ct: SplineMap
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


def pleura_points(lung: Lattice, step: int) -> tuple[Array, Array]:
    """Points (n, 3) mm on the zero level and the area (n,) mm2 each stands for."""
    vertices, faces, _, _ = marching_cubes(lung.values, 0.0, spacing=(lung.spacing,) * 3, step_size=step)
    a, b, c = (vertices[faces[:, m]] for m in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    per_vertex = np.bincount(faces.ravel(), np.repeat(area / 3, 3), minlength=len(vertices))
    return vertices + lung.origin, per_vertex


def relax(
    tissue: Tissue,
    pleura: Pleura,
    hilum: Hilum,
    gravity: Array,
    guess: Callable[[Array], Array],
    volume_ratio: float | None,
    spacing_mm: float,
) -> Equilibrium:
    """Equilibrium of the lung on a spline of `spacing_mm`, from the start that maps CT points by `guess`.

    gravity: (3,) unit vector; volume_ratio: volume over that in the CT, met by scaling the rest shape; None leaves it.
    """
    low, high = tissue.points.min(axis=0) - 2.5 * spacing_mm, tissue.points.max(axis=0) + 2.5 * spacing_mm
    nx, ny, nz = (int(n) for n in np.ceil((high - low) / spacing_mm) + 1)
    problem = _Problem(tissue, pleura, hilum, gravity, low, spacing_mm, (nx, ny, nz))
    u = problem.fit(guess)
    histories: list[Array] = []
    for _ in range(4):
        u, status, history = _minimize(problem, u, histories[0][0] if histories else None)
        histories.append(history)
        ratio = problem.volume(u) / float(tissue.volume.sum())
        if volume_ratio is None or abs(ratio / volume_ratio - 1) < 3e-3:
            break
        rest = problem.tissue.rest * np.cbrt(volume_ratio / ratio)
        problem.tissue = replace(problem.tissue, rest=np.clip(rest, 0.5, 0.99))
    forces = np.concatenate(histories)
    return Equilibrium(SplineMap(problem.full(u), low, spacing_mm), status, forces / forces[0])


class _Problem:
    """Energy of the lung over the spline's active coefficients (n, 3), its gradient, and a fixed metric for steps."""

    def __init__(
        self,
        tissue: Tissue,
        pleura: Pleura,
        hilum: Hilum,
        gravity: Array,
        origin: Array,
        spacing: float,
        shape: tuple[int, int, int],
    ) -> None:
        self.tissue, self.pleura, self.hilum, self.shape = tissue, pleura, hilum, shape
        inside, *slopes = basis(tissue.points, origin, spacing, shape)
        self.active = np.flatnonzero(inside.sum(axis=0) > 0)
        self.value = inside[:, self.active]
        self.slopes = [s[:, self.active] for s in slopes]
        self.on_pleura = basis(pleura.points, origin, spacing, shape)[0][:, self.active]
        self.on_hilum = basis(hilum.points, origin, spacing, shape)[0][:, self.active]
        self.lame = 1.5 * tissue.shear
        self.contact = (4.0 if pleura.held else 1.5) * pleura.area
        weight = tissue.density * 9.81e-6 * tissue.volume
        self.load = (self.value.T @ weight)[:, None] * gravity
        stiff = tissue.volume * tissue.shear * tissue.rest
        self.smooth = self._roughness(spacing) * (0.02 * float(tissue.shear.mean()))
        laplace = sum((s.T @ (s * (3 * stiff)[:, None]) for s in self.slopes), start=self.smooth)
        touch = self.on_pleura.T @ (self.on_pleura * (self.contact / 3)[:, None])
        tie = self.on_hilum.T @ (self.on_hilum * hilum.stiffness)
        self.metric = splu(sparse.csc_array(laplace + touch + tie))

    def _roughness(self, spacing: float) -> sparse.csr_array:
        """Bending of the coefficients: it carries the map smoothly a little way beyond the pleura."""
        lookup = np.full(int(np.prod(self.shape)), -1)
        lookup[self.active] = np.arange(len(self.active))
        grid = lookup.reshape(self.shape)
        rows = []
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

    def full(self, u: Array) -> Array:
        """Coefficients on the whole lattice, the passive ones copied from their nearest active neighbour."""
        nodes = int(np.prod(self.shape))
        passive = np.ones(nodes, dtype=bool)
        passive[self.active] = False
        out = np.zeros((nodes, 3))
        out[self.active] = u
        nearest = ndimage.distance_transform_edt(
            passive.reshape(self.shape), return_distances=False, return_indices=True
        )
        return np.ascontiguousarray(out.reshape(*self.shape, 3)[tuple(nearest)])

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
        pull = self.hilum.points + self.on_hilum @ u - self.hilum.target
        total += 0.5 * self.hilum.stiffness * float((pull**2).sum())
        return total, gradient + self.hilum.stiffness * (self.on_hilum.T @ pull)


def _minimize(
    problem: _Problem, u: Array, first_force: float | None, steps: int = 150, limit: float = 1e-2
) -> tuple[Array, Status, Array]:
    """Limited-memory BFGS in the problem's metric until the force, that metric's norm of the next step, is small."""
    value, gradient = problem.energy(u)
    if not np.isfinite(value):
        raise ValueError("the lung is folded at the start, reduce the motion of the cage")
    memory: list[tuple[Array, Array, float]] = []
    history: list[float] = []
    while len(history) < steps:
        step = _two_loop(problem, gradient, memory)
        slope = float((step * gradient).sum())
        history.append(float(np.sqrt(max(-slope, 0.0))))
        if history[-1] <= limit * (first_force or history[0]):
            return u, Status.CONVERGED, np.array(history)
        t, found = 1.0, problem.energy(u + step)
        while found[0] > value + 1e-4 * t * slope and t > 1e-3:
            t *= 0.4
            found = problem.energy(u + t * step)
        if found[0] >= value:
            if not memory:
                return u, Status.STALLED, np.array(history)
            memory = []
            continue
        y, s = found[1] - gradient, t * step
        curvature = float((y * s).sum())
        if curvature > 0:
            memory = [*memory[-11:], (s, y, curvature)]
        u, (value, gradient) = u + s, found
    return u, Status.STEPS, np.array(history)


def _two_loop(problem: _Problem, gradient: Array, memory: list[tuple[Array, Array, float]]) -> Array:
    q = gradient.copy()
    shares = []
    for s, y, sy in reversed(memory):
        a = float((s * q).sum()) / sy
        q -= a * y
        shares.append(a)
    d = problem.metric.solve(q)
    for (s, y, sy), a in zip(memory, reversed(shares), strict=True):
        d += (a - float((y * d).sum()) / sy) * s
    return -d
