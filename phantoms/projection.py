"""A cone-beam scanner in the projection domain: a C-arm's short scan of a scene, its photons and their correction.

Its beam hardens, is scattered, and is cut by the detector; the heart beats while it turns. What is corrected is so with
errors: of scatter a part is left, hardening is undone as if all were water, rows end in a cylinder of water.
Ref: Hsieh et al. 2004 (truncated projections); Berger et al. 2010 (NIST XCOM: attenuation at 45, 65 and 95 keV).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phantoms.cbct import OUTSIDE_HU, Scanner
from phantoms.cone_beam import Circle, feldkamp
from phantoms.cone_beam import project as line_integrals_of
from phantoms.voxels import Grid, Image

Array = NDArray[Any]
WATER_PER_MM = 0.02
"""Attenuation of water at the mean energy of a C-arm's beam."""
BONE_HU, STEEL_HU = 150.0, 3000.0
"""What exceeds these attenuates as bone and as steel does."""
ENERGIES = np.array([0.30, 0.45, 0.25])
"""Shares of a beam's photons at 45, 65 and 95 keV."""
HARDER = np.array([[1.22, 1.00, 0.87], [1.85, 1.00, 0.69], [2.70, 1.00, 0.42]])
"""Attenuation of water, bone and steel at these over that at 65 keV."""
MOST_SCATTER = 0.7
"""Share of a pixel's counts that the correction takes for scatter at most. Ref: Siewerdsen et al. 2006."""
THIN = 4
"""Scatter is smooth, and computed on every so many pixels."""


@dataclass(frozen=True)
class Beat:
    """A heart that beats. middle: (3,) RAS mm; radius: mm of its wall; inward: mm that the wall moves at its most;
    pulse: beats during the scan."""

    middle: Array
    radius: float
    inward: float
    pulse: float = 9.6


@dataclass(frozen=True)
class CArm:
    """Geometry and physics of a C-arm. source_axis, source_detector: mm; arc: degrees; pixel: mm on the detector;
    width, height: mm of the detector; photons: counts of a pixel in an open view; scattered: share of the photons lost
    by a ray that are counted elsewhere; scatter: that of it which the correction leaves; spread: mm standard deviation
    of scatter on the detector; hardening: whether the beam has more than one energy; cut: end of the filter's window
    (Hann) over the highest frequency."""

    source_axis: float = 785.0
    source_detector: float = 1200.0
    arc: float = 200.0
    views: int = 320
    pixel: float = 2.0
    width: float = 380.0
    height: float = 296.0
    photons: float = 4.9e4
    scattered: float = 0.10
    scatter: float = 0.03
    spread: float = 50.0
    hardening: bool = True
    cut: float = 0.9

    @property
    def circle(self) -> Circle:
        """Where its views are taken."""
        shape = round(self.height / self.pixel), round(self.width / self.pixel)
        return Circle(self.source_axis, self.source_detector, self.arc, self.views, self.pixel, shape)


def c_arm_of(scanner: Scanner, voxel_mm: float = 1.0) -> CArm:
    """The C-arm whose field of view, dose and leftover scatter are those of a scanner, its pixels put together for
    voxels that are coarser than they."""
    plain, usual = CArm(), Scanner()
    half = np.arcsin((scanner.fov / 2 + 4) / plain.source_axis)
    pixel = max(plain.pixel, voxel_mm * plain.source_detector / plain.source_axis)
    return CArm(
        pixel=pixel,
        width=min(2 * plain.source_detector * np.tan(half), plain.width),
        height=plain.height * scanner.length / usual.length,
        photons=plain.photons * (usual.noise / scanner.noise * pixel / plain.pixel) ** 2,
        scatter=scanner.flaws.scatter,
    )


def scene_grid(view: Grid) -> Grid:
    """Voxels of all that the rays through a field of view meet, 1.5 mm or coarser, about the same centre."""
    h = np.maximum(view.spacing, 1.5)
    length = view.shape[2] * view.spacing[2]
    n = np.ceil(np.array([440.0, 360.0, 1.25 * length + 30]) / h).astype(int)
    axes = view.ras_from_ijk[:3, :3] / view.spacing * h
    affine = np.eye(4)
    affine[:3, :3] = axes
    affine[:3, 3] = view.to_ras((np.array(view.shape) - 1) / 2) - axes @ ((n - 1) / 2)
    return Grid((int(n[0]), int(n[1]), int(n[2])), affine)


def expose_views(
    scene: Image,
    grid: Grid,
    scanner: Scanner,
    rng: np.random.Generator,
    arm: CArm | None = None,
    beat: Beat | None = None,
) -> Image:
    """Image on `grid` that a C-arm makes of `scene` (HU), turning about the third axis of `grid` through its centre.

    scene: as on `scene_grid(grid)`, about the same centre; axes of both are parallel to RAS; beat: of its heart.
    """
    arm = c_arm_of(scanner, float(grid.spacing.mean())) if arm is None else arm
    return develop(project(scene, arm, beat), grid, scanner, rng, arm)


def attenuation(hu: Array) -> Array:
    """Attenuation per mm of densities in HU."""
    return WATER_PER_MM * np.maximum(1 + hu / 1000, 0)


def project(scene: Image, arm: CArm, beat: Beat | None = None) -> Array:
    """Exact line integrals (3, views, columns, rows) of a scene centred on the C-arm's isocentre: all, what exceeds
    tissue, what exceeds bone."""
    levels = np.array([0.0, attenuation(np.array(BONE_HU)), attenuation(np.array(STEEL_HU))])
    paths = line_integrals_of(attenuation(scene.hu), scene.grid.spacing, arm.circle, levels)
    if beat is not None:
        moved, middle = _systole(scene, beat)
        phase = 2 * np.pi * beat.pulse * np.linspace(0, 1, arm.views)
        share = (0.5 - 0.5 * np.cos(phase)).astype(np.float32)[:, None, None]
        for sign in (1, -1):
            paths[0] += (
                sign * share * line_integrals_of(sign * moved, scene.grid.spacing, arm.circle, levels[:1], middle)[0]
            )
    return paths


def _systole(scene: Image, beat: Beat) -> tuple[Array, Array]:
    """What the heart's contraction adds to the attenuation in a box about it, and the box's middle from the scene's."""
    grid = scene.grid
    reach = beat.radius + 40.0
    at = grid.to_ijk(beat.middle)
    box = grid.box(at - reach / grid.spacing, at + reach / grid.spacing)
    low = np.round(grid.to_ijk(box.to_ras(np.zeros(3)))).astype(int)
    own = scene.hu[tuple(slice(a, a + n) for a, n in zip(low, box.shape, strict=True))]
    away = box.points() - beat.middle
    r = np.linalg.norm(away, axis=-1)
    beyond = np.clip((r - beat.radius) / 40.0, 0, 1)
    # Inside, the wall's motion fades towards the middle; outside, what lies on the heart follows less and less.
    pull = beat.inward * np.where(r < beat.radius, r / beat.radius, (1 - beyond) ** 2)
    index = grid.to_ijk(beat.middle + away * (1 + pull / np.maximum(r, 1.0))[..., None])
    contracted = ndimage.map_coordinates(scene.hu, np.moveaxis(index, -1, 0), order=1, mode="nearest", prefilter=False)
    off = (low + (np.array(box.shape) - 1) / 2 - (np.array(grid.shape) - 1) / 2) * grid.spacing
    return attenuation(contracted) - attenuation(own), off


def develop(paths: Array, grid: Grid, scanner: Scanner, rng: np.random.Generator, arm: CArm) -> Image:
    """Image on `grid` from exact line integrals (3, views, columns, rows): detected, reconstructed, in HU."""
    hu = 1000 * (reconstruct(detect(paths, arm, rng), grid, arm) / WATER_PER_MM - 1)
    hu = (hu + 1000) * scanner.flaws.gain - 1000 + scanner.flaws.offset
    i, j = ((np.arange(n) - (n - 1) / 2) * h for n, h in zip(grid.shape[:2], grid.spacing[:2], strict=True))
    within = np.hypot(i[:, None], j[None, :])[:, :, None] <= scanner.fov / 2
    hu = np.where(within, np.clip(hu, -1024, 3071), OUTSIDE_HU)
    return Image(np.ascontiguousarray(hu, dtype=np.float32), grid.ras_from_ijk)


def detect(paths: Array, arm: CArm, rng: np.random.Generator) -> Array:
    """Line integrals (views, columns, rows) that the scanner reads: it counts photons, scattered ones among them, takes
    off what it believes to be scatter, and undoes the hardening that water would cause."""
    open_view = np.float32(arm.photons)
    primary = open_view * _transmitted(paths, arm)
    lost = primary * np.maximum(paths[0], 0)
    counts = rng.poisson(primary + arm.scattered * _spread(lost, arm.spread / arm.pixel)).astype(np.float32)
    # The correction knows how much is scattered but for a part, and spreads it further than it is; it takes no more of
    # a pixel's counts than can be scatter.
    believed = (arm.scattered - arm.scatter) * _spread(lost, 1.5 * arm.spread / arm.pixel)
    counts -= np.minimum(believed, MOST_SCATTER * counts)
    read = -np.log(np.maximum(counts, 1.0) / open_view)
    if not arm.hardening:
        return np.asarray(read, dtype=np.float32)
    water = np.linspace(0.0, 20.0, 2001)
    return np.interp(read, -np.log(np.exp(-np.outer(water, HARDER[0])) @ ENERGIES), water).astype(np.float32)


def _transmitted(paths: Array, arm: CArm) -> Array:
    """Share of the photons that go straight through."""
    if not arm.hardening:
        return np.exp(-paths[0])
    out = np.zeros(paths.shape[1:], dtype=np.float32)
    for share, (water, bone, steel) in zip(ENERGIES, HARDER.T, strict=True):
        along = np.float32(water) * paths[0] + np.float32(bone - water) * paths[1] + np.float32(steel - bone) * paths[2]
        out += np.float32(share) * np.exp(-along)
    return out


def _spread(lost: Array, pixels: float) -> Array:
    """Views (n, columns, rows) blurred by a standard deviation in pixels, computed on few of them."""
    n, columns, rows = lost.shape
    few = lost[:, : columns // THIN * THIN, : rows // THIN * THIN]
    few = few.reshape(n, columns // THIN, THIN, rows // THIN, THIN).mean(axis=(2, 4))
    few = ndimage.gaussian_filter(few, (0, pixels / THIN, pixels / THIN), mode="nearest", truncate=2.5)
    for axis, count in ((1, columns), (2, rows)):
        at = np.clip((np.arange(count) + 0.5) / THIN - 0.5, 0, few.shape[axis] - 1)
        low = np.minimum(at.astype(int), few.shape[axis] - 2)
        share = (at - low).astype(np.float32).reshape([-1 if m == axis else 1 for m in range(3)])
        few = np.take(few, low, axis) * (1 - share) + np.take(few, low + 1, axis) * share
    return few


def reconstruct(line_integrals: Array, grid: Grid, arm: CArm) -> Array:
    """Attenuation [i, j, k] per mm on a grid whose centre is the isocentre, by the method of Feldkamp."""
    extra = line_integrals.shape[1] // 2
    wide = extend(line_integrals.transpose(0, 2, 1), arm.pixel * arm.source_axis / arm.source_detector, extra)
    return feldkamp(wide.transpose(0, 2, 1), arm.circle, grid.shape, grid.spacing, arm.cut)


def extend(line_integrals: Array, step_mm: float, extra: int) -> Array:
    """Rows (..., columns) continued by `extra` columns of `step_mm` on either side, as if a cylinder of water ended the
    patient there.

    Ref: Hsieh et al. 2004: its radius and place follow from value and slope near the edge.
    """
    sides, near = [], 6
    for rows in (line_integrals[..., ::-1], line_integrals):
        inner, outer = rows[..., -2 * near : -near].mean(axis=-1), rows[..., -near:].mean(axis=-1)
        inner, outer = ndimage.gaussian_filter(inner, 2.0), ndimage.gaussian_filter(outer, 2.0)
        value, slope = np.maximum((inner + outer) / 2, 0), (outer - inner) / (near * step_mm)
        off = np.clip(-value * slope / (4 * WATER_PER_MM**2), 0, 150)
        radius2 = (value / (2 * WATER_PER_MM)) ** 2 + off**2
        x = off[..., None] + step_mm * (near - 0.5 + np.arange(1, extra + 1))
        sides.append(2 * WATER_PER_MM * np.sqrt(np.maximum(radius2[..., None] - x**2, 0)))
    return np.concatenate([sides[0][..., ::-1], line_integrals, sides[1]], axis=-1, dtype=np.float32)
