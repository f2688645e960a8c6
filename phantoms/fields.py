"""Smooth scalar fields on coarse lattices, and their values on images and at points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phantoms.voxels import Grid

Array = NDArray[Any]


@dataclass(frozen=True)
class Lattice:
    """Scalar field sampled on axes parallel to RAS. origin: (3,) mm; spacing: mm; values: (nx, ny, nz) float32."""

    origin: Array
    spacing: float
    values: Array

    @cached_property
    def axes(self) -> tuple[Array, Array, Array]:
        """Coordinates along x, y, z in mm, shaped to broadcast over the field."""
        x, y, z = (self.origin[m] + self.spacing * np.arange(n) for m, n in enumerate(self.values.shape))
        return x[:, None, None], y[None, :, None], z[None, None, :]

    def like(self, values: Array) -> Lattice:
        """Another field on the same lattice."""
        return Lattice(self.origin, self.spacing, np.ascontiguousarray(values, dtype=np.float32))

    def points(self) -> Array:
        """Lattice nodes in RAS mm, (nx ny nz, 3)."""
        return np.stack([np.broadcast_to(a, self.values.shape).ravel() for a in self.axes], axis=1)

    def at(self, points: Array) -> Array:
        """Trilinear values at points (..., 3) in RAS mm; the field is continued by its border."""
        return self.sample(points.reshape(-1, 3)).reshape(points.shape[:-1])

    def with_gradient(self, points: Array) -> tuple[Array, Array]:
        """Trilinear values (n,) and their exact gradient (n, 3) per mm at points (n, 3) in RAS mm."""
        top = np.array(self.values.shape) - 1
        s = np.clip((points - self.origin) / self.spacing, 0, top - 1e-6)
        base = s.astype(np.intp)
        f = s - base
        flat = self.values.ravel()
        strides = np.array([self.values.shape[1] * self.values.shape[2], self.values.shape[2], 1])
        start = base @ strides
        c = [[[flat[start + a * strides[0] + b * strides[1] + e] for e in (0, 1)] for b in (0, 1)] for a in (0, 1)]
        fx, fy, fz = f.T
        cz = [[c[a][b][0] * (1 - fz) + c[a][b][1] * fz for b in (0, 1)] for a in (0, 1)]
        dz = [[c[a][b][1] - c[a][b][0] for b in (0, 1)] for a in (0, 1)]
        cy = [cz[a][0] * (1 - fy) + cz[a][1] * fy for a in (0, 1)]
        gz = [dz[a][0] * (1 - fy) + dz[a][1] * fy for a in (0, 1)]
        gy = [cz[a][1] - cz[a][0] for a in (0, 1)]
        value = cy[0] * (1 - fx) + cy[1] * fx
        gradient = np.stack([cy[1] - cy[0], gy[0] * (1 - fx) + gy[1] * fx, gz[0] * (1 - fx) + gz[1] * fx], axis=1)
        return value, gradient / self.spacing

    def sample(self, points: Array) -> Array:
        """Trilinear values (n,) float32 at many points (n, 3) in RAS mm; the field is continued by its border."""
        index = ((points - self.origin) / self.spacing).T
        return ndimage.map_coordinates(self.values, index, order=1, mode="nearest", prefilter=False)

    def crop(self, inside: Array, margin_mm: float) -> Lattice:
        """The part of the field around the nodes where `inside` is true, wider by `margin_mm`."""
        box = _box(inside, int(np.ceil(margin_mm / self.spacing)))
        start = np.array([b.start for b in box])
        return Lattice(self.origin + self.spacing * start, self.spacing, np.ascontiguousarray(self.values[box]))

    def on(self, grid: Grid) -> Array:
        """Trilinear values on an image whose axes are parallel to RAS, float32."""
        step = np.diag(grid.ras_from_ijk[:3, :3])
        if np.abs(grid.ras_from_ijk[:3, :3] - np.diag(step)).max() > 1e-9:
            raise ValueError("the image's axes must be parallel to RAS; sample a rotated image with Lattice.at")
        at = [(grid.ras_from_ijk[m, 3] + step[m] * np.arange(grid.shape[m]) - self.origin[m]) for m in range(3)]
        return _separable(self.values, [a / self.spacing for a in at])


def lattice_over(lower: Array, upper: Array, spacing: float) -> Lattice:
    """Zero field over the box lower..upper (mm)."""
    n = np.ceil((np.asarray(upper) - np.asarray(lower)) / spacing).astype(int) + 1
    return Lattice(np.asarray(lower, dtype=float), float(spacing), np.zeros(n, dtype=np.float32))


def refine(coarse: Array, step: float, shape: tuple[int, int, int]) -> Array:
    """Trilinear refinement of samples taken at every `step`-th voxel onto an image of `shape`."""
    return _separable(np.asarray(coarse, dtype=np.float32), [np.arange(n) / step for n in shape])


def smooth_noise(lattice: Lattice, length_mm: float, rng: np.random.Generator) -> Array:
    """Gaussian random field of unit variance and correlation length `length_mm` on the lattice."""
    sigma = length_mm / lattice.spacing
    stride = max(1, int(sigma / 2))
    small = tuple(n // stride + 3 for n in lattice.values.shape)
    rough = ndimage.gaussian_filter(rng.standard_normal(small).astype(np.float32), sigma / stride, mode="wrap")
    nx, ny, nz = lattice.values.shape
    fine = refine(rough, stride, (nx, ny, nz))
    return (fine - fine.mean()) / fine.std()


def patches(region: Lattice, share: float, length_mm: float, rng: np.random.Generator, bias: Array) -> Lattice:
    """One in patches that fill a `share` of a region (signed distance, mm), zero between, smooth over a short way.

    length_mm: correlation length; bias: on the lattice, what makes a patch likelier, in deviations of the noise.
    """
    value = smooth_noise(region, length_mm, rng) + bias
    edge = np.quantile(value[region.values < 0], 1 - share) if share > 0 else np.inf
    return region.like(smoothstep(value, edge - 0.06, edge + 0.06) if share > 0 else np.zeros(value.shape))


def smoothstep(x: Array, low: float, high: float) -> Array:
    """Zero below `low`, one above `high`, cubic between."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def soft_max(a: Array, b: Array, blend_mm: float) -> Array:
    """Maximum of two signed distances with the edge rounded over `blend_mm`."""
    h = np.maximum(blend_mm - np.abs(a - b), 0) / blend_mm
    return np.maximum(a, b) + h * h * blend_mm / 4


def coverage(distance: Array, width_mm: float) -> Array:
    """Share of a voxel of `width_mm` inside a surface at signed `distance` (mm, negative inside)."""
    return np.clip(0.5 - distance / width_mm, 0, 1)


def near_distance(lattice: Lattice, implicit: Array) -> Lattice:
    """Signed distance (mm) to the zero level of an implicit function, negative inside; true near the level only."""
    gx, gy, gz = np.gradient(implicit.astype(np.float32), lattice.spacing)
    return lattice.like(implicit / np.sqrt(np.maximum(gx * gx + gy * gy + gz * gz, 0.0025)))


def as_distance(lattice: Lattice, implicit: Array) -> Lattice:
    """Signed distance (mm) to the zero level of an implicit function, negative inside; good everywhere.

    Further than ten nodes from the box around the region it is held at that distance.
    """
    h = lattice.spacing
    near = near_distance(lattice, implicit).values
    out = np.full(near.shape, 10 * h, dtype=np.float32)
    box = _box(near < 0, 10)
    inside = near[box] < 0
    far = ndimage.distance_transform_edt(~inside, sampling=h) - ndimage.distance_transform_edt(inside, sampling=h)
    far -= np.sign(far) * h / 2
    trust = np.clip((np.abs(far) - h) / h, 0, 1)
    out[box] = np.clip(near[box], -3 * h, 3 * h) * (1 - trust) + far * trust
    return lattice.like(out)


def _box(chosen: Array, pad: int) -> tuple[slice, slice, slice]:
    found = [np.flatnonzero(chosen.any(axis=tuple(m for m in range(3) if m != axis))) for axis in range(3)]
    x, y, z = (slice(max(int(f[0]) - pad, 0), int(f[-1]) + pad + 1) for f in found)
    return x, y, z


def _separable(values: Array, positions: list[Array]) -> Array:
    out = values
    for axis, position in enumerate(positions):
        n = out.shape[axis]
        p = np.clip(position, 0, n - 1)
        base = np.minimum(p.astype(np.intp), n - 2)
        f = (p - base).astype(np.float32).reshape([-1 if m == axis else 1 for m in range(3)])
        low = np.take(out, base, axis=axis)
        step = np.take(out, base + 1, axis=axis)
        step -= low
        step *= f
        step += low
        out = step
    return out
