"""A cone-beam scanner in the projection domain: a C-arm's short scan, quanta, scatter, truncation, Feldkamp's method.

Projector and reconstruction are those of RTK, on the CPU; everything else is here. Needs the extra "projections".
Ref: Feldkamp, Davis and Kress 1984; Parker 1982 (weights of a short scan); Hsieh et al. 2004 (truncated projections).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phantoms.cbct import OUTSIDE_HU, Scanner
from phantoms.voxels import Grid, Image

Array = NDArray[Any]
WATER_PER_MM = 0.02
"""Attenuation of water at the mean energy of a C-arm's beam."""
MISSING = 'projections need itk-rtk; get it by pip install "vatsloc[projections]", or ".[projections]" here'


@dataclass(frozen=True)
class CArm:
    """Geometry and physics of a C-arm. source_axis, source_detector: mm; arc: degrees; pixel: mm on the detector;
    width, height: mm of the detector; photons: counts of a pixel in an open view; scatter: share of what is scattered
    once that the scanner's correction leaves; spread: mm standard deviation of scatter on the detector; cut: end of the
    filter's window (Hann) over the highest frequency."""

    source_axis: float = 785.0
    source_detector: float = 1200.0
    arc: float = 200.0
    views: int = 400
    pixel: float = 1.6
    width: float = 380.0
    height: float = 296.0
    photons: float = 2.5e4
    scatter: float = 0.03
    spread: float = 50.0
    cut: float = 0.8

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the detector."""
        return round(self.height / self.pixel), round(self.width / self.pixel)

    @cached_property
    def circle(self) -> Any:
        """RTK's geometry of the views."""
        geometry = _rtk().ThreeDCircularProjectionGeometry.New()
        for angle in np.linspace(0.0, self.arc, self.views):
            geometry.AddProjection(self.source_axis, self.source_detector, float(angle))
        return geometry


def c_arm_of(scanner: Scanner, voxel_mm: float = 1.0) -> CArm:
    """The C-arm whose field of view and dose are those of a scanner described in the image domain, its pixels put
    together for voxels that are coarser than they."""
    plain, usual = CArm(), Scanner()
    half = np.arcsin((scanner.fov / 2 + 4) / plain.source_axis)
    pixel = max(plain.pixel, voxel_mm * plain.source_detector / plain.source_axis)
    return CArm(
        pixel=pixel,
        width=min(2 * plain.source_detector * np.tan(half), plain.width),
        height=plain.height * scanner.length / usual.length,
        photons=plain.photons * (usual.noise / scanner.noise * pixel / plain.pixel) ** 2,
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
    scene: Image, grid: Grid, scanner: Scanner, rng: np.random.Generator, arm: CArm | None = None
) -> Image:
    """Image on `grid` that a C-arm makes of `scene` (HU), turning about the third axis of `grid` through its centre.

    scene: as on `scene_grid(grid)`, about the same centre. Raises ModuleNotFoundError without RTK.
    """
    arm = c_arm_of(scanner, float(grid.spacing.mean())) if arm is None else arm
    return develop(project(attenuation(scene), scene.grid.spacing, arm), grid, scanner, rng, arm)


def attenuation(image: Image) -> Array:
    """Attenuation [i, j, k] per mm of an image in HU."""
    return WATER_PER_MM * np.maximum(1 + image.hu / 1000, 0)


def develop(line_integrals: Array, grid: Grid, scanner: Scanner, rng: np.random.Generator, arm: CArm) -> Image:
    """Image on `grid` from exact line integrals (views, rows, columns): detected, reconstructed, in HU."""
    hu = 1000 * (reconstruct(detect(line_integrals, arm, rng), grid, arm) / WATER_PER_MM - 1)
    i, j = ((np.arange(n) - (n - 1) / 2) * h for n, h in zip(grid.shape[:2], grid.spacing[:2], strict=True))
    within = np.hypot(i[:, None], j[None, :])[:, :, None] <= scanner.fov / 2
    hu = np.where(within, np.clip(hu, -1024, 3071), OUTSIDE_HU)
    return Image(np.ascontiguousarray(hu, dtype=np.float32), grid.ras_from_ijk)


def project(per_mm: Array, spacing: Array, arm: CArm) -> Array:
    """Line integrals (views, rows, columns) of an attenuation [i, j, k] per mm centred on the C-arm's isocentre."""
    joseph = _rtk().JosephForwardProjectionImageFilter[_image(), _image()].New()
    joseph.SetInput(0, _stack(np.zeros((arm.views, *arm.shape), dtype=np.float32), arm))
    joseph.SetInput(1, _centred(per_mm, spacing))
    joseph.SetGeometry(arm.circle)
    joseph.Update()
    return np.asarray(_itk().array_from_image(joseph.GetOutput()))


def detect(line_integrals: Array, arm: CArm, rng: np.random.Generator) -> Array:
    """Line integrals that the scanner reads: it counts photons, those scattered once among them."""
    primary = arm.photons * np.exp(-line_integrals)
    blur = arm.spread / arm.pixel
    once = primary * np.maximum(line_integrals, 0)
    scattered = ndimage.gaussian_filter(once, (0, blur, blur), mode="nearest", truncate=2.5)
    counts = rng.poisson(primary + arm.scatter * scattered)
    return np.asarray(-np.log(np.maximum(counts, 1) / arm.photons), dtype=np.float32)


def reconstruct(line_integrals: Array, grid: Grid, arm: CArm) -> Array:
    """Attenuation [i, j, k] per mm on a grid whose centre is the isocentre, by the method of Feldkamp."""
    rtk, image = _rtk(), _image()
    parker = rtk.ParkerShortScanImageFilter[image].New()
    parker.SetInput(_stack(np.ones_like(line_integrals), arm))
    parker.SetGeometry(arm.circle)
    parker.Update()
    weights = np.asarray(_itk().array_from_image(parker.GetOutput()))
    extra = line_integrals.shape[2] // 2
    wide = extend(line_integrals, arm.pixel * arm.source_axis / arm.source_detector, extra)
    wide *= np.pad(weights, ((0, 0), (0, 0), (extra, extra)), mode="edge")
    feldkamp = rtk.FDKConeBeamReconstructionFilter[image].New()
    feldkamp.SetInput(0, _centred(np.zeros(grid.shape, dtype=np.float32), grid.spacing))
    feldkamp.SetInput(1, _stack(wide, arm))
    feldkamp.SetGeometry(arm.circle)
    feldkamp.GetRampFilter().SetHannCutFrequency(arm.cut)
    feldkamp.Update()
    return np.asarray(_itk().array_from_image(feldkamp.GetOutput())).transpose(2, 0, 1)


def extend(line_integrals: Array, step_mm: float, extra: int) -> Array:
    """Rows continued by `extra` columns of `step_mm` on either side, as if a cylinder of water ended the patient there.

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


def _stack(views: Array, arm: CArm) -> Any:
    """Views (n, rows, columns) as an image of RTK, the detector's middle opposite the source."""
    out = _itk().image_from_array(np.ascontiguousarray(views, dtype=np.float32))
    out.SetSpacing([arm.pixel, arm.pixel, 1.0])
    out.SetOrigin([-(views.shape[2] - 1) / 2 * arm.pixel, -(views.shape[1] - 1) / 2 * arm.pixel, 0.0])
    return out


def _centred(values: Array, spacing: Array) -> Any:
    """An array [i, j, k] about the isocentre as an image of RTK, which turns about its second axis."""
    out = _itk().image_from_array(np.ascontiguousarray(values.transpose(1, 2, 0), dtype=np.float32))
    h = [float(spacing[m]) for m in (0, 2, 1)]
    n = [values.shape[m] for m in (0, 2, 1)]
    out.SetSpacing(h)
    out.SetOrigin([-(count - 1) / 2 * step for count, step in zip(n, h, strict=True)])
    return out


@cache
def _itk() -> Any:
    with warnings.catch_warnings():
        # SWIG's types name no module, of which Python warns as each is first used; as an error it ends the interpreter.
        warnings.filterwarnings("ignore", "builtin type", DeprecationWarning)
        try:
            import itk

            image = itk.Image[itk.F, 3]
            itk.array_from_image(itk.image_from_array(np.zeros((2, 2, 2), dtype=np.float32)))
            itk.RTK.ThreeDCircularProjectionGeometry.New()
            itk.RTK.JosephForwardProjectionImageFilter[image, image].New()
            itk.RTK.ParkerShortScanImageFilter[image].New()
            itk.RTK.FDKConeBeamReconstructionFilter[image].New().GetRampFilter()
        except (ModuleNotFoundError, AttributeError) as missing:
            raise ModuleNotFoundError(MISSING) from missing
    return itk


def _rtk() -> Any:
    return _itk().RTK


def _image() -> Any:
    return _itk().Image[_itk().F, 3]
