"""Cone-beam CT made fit for measuring: its field of view, its bad end slices, and its cupping taken away."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage

from registration.volume import Array, Mask, Volume
from vatsloc.errors import InputRefused

END_SLICES_MM = 12.0
KNOT_STEP = 0.2
SOFT_TISSUE_HU = 40.0


@dataclass(frozen=True)
class FieldOfView:
    """What the scanner saw. mask: inside the cylinder; usable: that without the bad end slices, on the image's grid.

    centre_ij: (2,) of its axis, in-plane voxels; radius_mm: inf where the image has no rim; axis: voxel axis along it.
    """

    mask: Mask
    usable: Mask
    centre_ij: Array
    radius_mm: float
    axis: int


@dataclass(frozen=True)
class Cupping:
    """Circularly symmetric error of a CBCT, piece-wise linear in the radius, and the scale that was left.

    radius_mm, hu: (m,) knots of what was subtracted; gain: contrast between air and soft tissue as a share of 1040 HU,
    which was divided out about soft tissue; before, after: HU of "air", "lung" and "soft" tissue (nan: not seen).
    """

    radius_mm: Array
    hu: Array
    gain: float
    before: dict[str, float]
    after: dict[str, float]

    def at(self, radius_mm: Array) -> Array:
        """HU that the artefact adds at a distance from the axis in mm."""
        return np.interp(radius_mm, self.radius_mm, self.hu)

    def entry(self) -> dict[str, Any]:
        """What was removed, for run.json: the profile's knots, the gain, HU of each tissue (None: not seen)."""

        def seen(hu: dict[str, float]) -> dict[str, float | None]:
            return {tissue: None if np.isnan(value) else value for tissue, value in hu.items()}

        return {
            "cupping_radius_mm": self.radius_mm,
            "cupping_hu": self.hu,
            "gain": self.gain,
            "end_slices_mm": END_SLICES_MM,
            "hu_before": seen(self.before),
            "hu_after": seen(self.after),
        }


@dataclass(frozen=True)
class PreparedCbct:
    """CBCT ready for registration. volume: corrected, -1000 HU outside; field: what was seen; removed: the artefact."""

    volume: Volume
    field: FieldOfView
    removed: Cupping


def prepare_cbct(cbct: Volume) -> PreparedCbct:
    """Field of view, bad end slices and cupping of `cbct`, and the corrected image.

    Beyond the paper, the contrast that scatter took is given back where air is seen, so that lung HU tells mass.
    Ref: Alvarez 2021, section 5.
    """
    field = field_of_view(cbct)
    radius = _radius_map(cbct, field)
    usable = field.usable.inside
    knots, profile = estimate_cupping(cbct, field)
    hu = cbct.hu - np.interp(radius, knots, profile).astype(np.float32)
    gain = _gain(hu[usable & (radius <= 0.85 * knots[-1])][::5])
    hu = SOFT_TISSUE_HU + (hu - SOFT_TISSUE_HU) / np.float32(gain)
    hu = np.where(field.mask.inside, np.maximum(hu, -1024), np.float32(-1000)).astype(np.float32)
    removed = Cupping(knots, profile, gain, tissue_hu(cbct.hu[usable]), tissue_hu(hu[usable]))
    return PreparedCbct(Volume(hu, cbct.ras_from_ijk), field, removed)


def _gain(hu: Array) -> float:
    """Contrast between air and soft tissue as a share of 1040 HU; 1 where fewer than 0.05 % of the voxels are air.

    Air is what lies at least a tenth of the lung's contrast below the lung's peak.
    """
    peak = tissue_hu(hu)["lung"]
    if np.isnan(peak):
        return 1.0
    airy = hu[hu < peak - 0.1 * (SOFT_TISSUE_HU - peak)]
    if airy.size < 5e-4 * hu.size:
        return 1.0
    return float(np.clip((SOFT_TISSUE_HU - np.median(airy)) / (SOFT_TISSUE_HU + 1000.0), 0.6, 1.2))


def field_of_view(cbct: Volume) -> FieldOfView:
    """The cylinder in which the image is not constant; its axis is the voxel axis nearest to the patient's S."""
    axis = int(np.argmax(np.abs(cbct.grid.ras_from_ijk[2, :3]) / cbct.grid.spacing))
    plane = [m for m in range(3) if m != axis]
    sx, sy = cbct.grid.spacing[plane]
    hu = np.moveaxis(cbct.hu, axis, 2)
    inside, centre, radius = _disc(hu, sx, sy)
    steps = hu.shape[2]
    lit = inside[:, :, None] & _lit_slices(hu, inside)[None, None, :]
    ends = int(np.ceil(END_SLICES_MM / cbct.grid.spacing[axis] - 1e-6))
    found = np.flatnonzero(lit.any(axis=(0, 1)))
    if found.size <= 2 * ends:
        raise InputRefused(
            f"The CBCT has {found.size} slices with content, {2 * ends + 1} needed; give the whole reconstruction."
        )
    good = np.zeros(steps, dtype=bool)
    good[found[0] + ends : found[-1] - ends + 1] = True
    mask = Mask(np.moveaxis(lit, 2, axis), cbct.ras_from_ijk)
    rim = _disc_of(hu.shape[:2], centre, radius - 2 * max(sx, sy), sx, sy) & inside
    usable = np.moveaxis(lit & rim[:, :, None] & good[None, None, :], 2, axis)
    return FieldOfView(mask, Mask(usable, cbct.ras_from_ijk), centre, radius, axis)


def _disc(hu: Array, sx: float, sy: float) -> tuple[Array, Array, float]:
    """In-plane region that is not constant along the axis, the centre of its circle in voxels, and its radius in mm."""
    sample = hu[:, :, :: max(hu.shape[2] // 40, 1)]
    constant = sample.max(axis=2) == sample.min(axis=2)
    labels, count = ndimage.label(constant)
    corner = np.zeros(count + 1, dtype=bool)
    corner[[labels[0, 0], labels[0, -1], labels[-1, 0], labels[-1, -1]]] = True
    corner[0] = False
    inside = ndimage.binary_fill_holes(~corner[labels])
    middle = (np.array(inside.shape) - 1) / 2
    if inside.all():
        return inside, middle, np.inf
    if not inside.any():
        raise InputRefused("The CBCT is constant everywhere; give an image with content.")
    edge = inside & ~ndimage.binary_erosion(inside, border_value=1)
    i, j = np.nonzero(edge)
    x, y = i * sx, j * sy
    a = np.column_stack([2 * x, 2 * y, np.ones(len(x))])
    cx, cy, c = np.linalg.lstsq(a, x**2 + y**2, rcond=None)[0]
    radius = float(np.sqrt(c + cx**2 + cy**2)) + 0.5 * (sx + sy) / 2
    misfit = np.abs(np.hypot(x - cx, y - cy) - radius)
    if np.percentile(misfit, 90) > 4 * max(sx, sy):
        return inside, middle, np.inf
    return inside, np.array([cx / sx, cy / sy]), radius


def _disc_of(shape: tuple[int, ...], centre: Array, radius: float, sx: float, sy: float) -> Array:
    i, j = np.ogrid[: shape[0], : shape[1]]
    return np.hypot((i - centre[0]) * sx, (j - centre[1]) * sy) <= radius


def _lit_slices(hu: Array, inside: Array) -> Array:
    """Slices that hold more than a constant, in HU or, as `evaluate` reads them, in the units of the file."""
    values = hu[inside][:: max(int(inside.sum()) // 2000, 1)]
    return values.max(axis=0) - values.min(axis=0) > min(1.0, 1e-3 * float(np.ptp(values)))


def _radius_map(cbct: Volume, field: FieldOfView) -> Array:
    """Distance of every voxel from the axis in mm, broadcastable to the image."""
    plane = [m for m in range(3) if m != field.axis]
    n0, n1 = (cbct.hu.shape[m] for m in plane)
    s0, s1 = cbct.grid.spacing[plane]
    i, j = np.ogrid[:n0, :n1]
    return np.expand_dims(np.hypot((i - field.centre_ij[0]) * s0, (j - field.centre_ij[1]) * s1), field.axis)


def estimate_cupping(cbct: Volume, field: FieldOfView) -> tuple[Array, Array]:
    """Knots in mm and HU (m,) of the radial error: the peak of lean tissue beside that of fat, followed over rings.

    The profile is zero where lean tissue reads 40 HU, so that it also carries a constant offset.
    """
    taken = np.flatnonzero(field.usable.inside)[::3]
    hu = ndimage.uniform_filter(cbct.hu, 3).reshape(-1)[taken]
    r = np.broadcast_to(_radius_map(cbct, field), cbct.hu.shape)[np.unravel_index(taken, cbct.hu.shape)]
    rings = np.linspace(0.0, float(r.max()), 31)
    levels = np.arange(-320.0, 241.0, 8.0)
    told = (hu >= levels[0]) & (hu <= levels[-1])
    table = np.histogram2d(r[told], hu[told], bins=(rings, levels))[0]
    table = ndimage.gaussian_filter(table, (0.7, 0.7))
    weight = table.sum(axis=1)
    shift = np.arange(-180.0, 181.0, 6.0)
    score = _lean_and_fat(table / np.maximum(weight[:, None], 1.0), (levels[:-1] + levels[1:]) / 2, shift)
    ridge = shift[_ridge(score * np.minimum(weight / 200.0, 1.0)[:, None], steepest=4)]
    centres = (rings[:-1] + rings[1:]) / 2
    knots = np.linspace(0.0, float(r.max()), round(1 / KNOT_STEP) + 1)
    return knots, _piecewise_linear(centres, ridge - SOFT_TISSUE_HU, np.sqrt(weight), knots)


def _lean_and_fat(share: Array, level: Array, shift: Array) -> Array:
    """Log-likelihood (rings, shifts) of each ring's histogram when its lean tissue peaks at `shift`.

    Fat lies about 105 HU lower in scatter-laden images; its share of a ring is free, little of it preferred.
    """

    def bell(at: Array) -> Array:
        return np.exp(-0.5 * ((level[None] - at[:, None]) / 32.0) ** 2) / (32.0 * np.sqrt(2 * np.pi))

    lean, fat = bell(shift), bell(shift - 105.0)
    options = [
        share @ np.log(0.15 / 560.0 + 0.85 * ((1 - w) * lean + w * fat)).T - 0.15 * w for w in (0.0, 0.25, 0.5, 0.75)
    ]
    return np.max(options, axis=0)


def _ridge(score: Array, steepest: int) -> Array:
    """Column index per row along the path of greatest total score that moves at most `steepest` columns per row."""
    best, trail = score[0], [score[0]]
    cost = 0.05 * np.abs(np.arange(-steepest, steepest + 1))
    for row in score[1:]:
        padded = np.pad(best, steepest, constant_values=-np.inf)
        options = np.stack([padded[s : s + best.size] - cost[s] for s in range(2 * steepest + 1)])
        best = options.max(axis=0) + row
        trail.append(best)
    path = [int(trail[-1].argmax())]
    for values in reversed(trail[:-1]):
        lo = max(path[-1] - steepest, 0)
        window = values[lo : path[-1] + steepest + 1]
        path.append(lo + int((window - 0.05 * np.abs(np.arange(lo, lo + window.size) - path[-1])).argmax()))
    return np.array(path[::-1])


def _piecewise_linear(x: Array, y: Array, weight: Array, knots: Array) -> Array:
    """Values at `knots` whose piece-wise linear interpolant fits y(x) best, with bent knots slightly penalized."""
    hats = np.stack([np.interp(x, knots, np.eye(len(knots))[m]) for m in range(len(knots))], axis=1)
    w = weight / max(float(weight.max()), 1e-9)
    values = np.linalg.lstsq(hats * w[:, None], y * w, rcond=None)[0]
    for _ in range(10):
        misfit = np.abs(hats @ values - y)
        robust = w / np.maximum(1.0, misfit / 12.0)
        second = 0.1 * np.diff(np.eye(len(knots)), 2, axis=0)
        a = np.vstack([hats * robust[:, None], second])
        values = np.linalg.lstsq(a, np.concatenate([y * robust, np.zeros(len(second))]), rcond=None)[0]
    return values


def tissue_hu(hu: Array) -> dict[str, float]:
    """Histogram peaks: "air" below -880, "lung" from -930 to -500, "soft" tissue from -150 to 200 HU (nan: none)."""
    counts = np.bincount(np.clip((hu + 1104.0) / 8.0, 0, 175).astype(int), minlength=176)[1:-1]
    smooth = ndimage.gaussian_filter1d(counts.astype(float), 1.5)
    centre = -1092.0 + 8.0 * np.arange(counts.size)
    peak = np.zeros(counts.size, dtype=bool)
    peak[1:-1] = (smooth[1:-1] > smooth[:-2]) & (smooth[1:-1] >= smooth[2:]) & (smooth[1:-1] > 1e-4 * hu.size)
    out = {}
    for name, (lo, hi) in {"air": (-1100, -880), "lung": (-930, -500), "soft": (-150, 200)}.items():
        part = np.where(peak & (centre >= lo) & (centre < hi), smooth, 0.0)
        out[name] = float(centre[int(part.argmax())]) if part.any() else float("nan")
    if out["air"] == out["lung"]:
        out["air"] = float("nan")
    return out
