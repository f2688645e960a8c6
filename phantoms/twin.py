"""Digital twin of one scan: its own lung, cage and spine, moved by the physics of the other phantoms."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phantoms.anatomy import SPINE_MM, Build
from phantoms.breathing import Breath, breathe, volume_signal
from phantoms.case import PhantomCase, finish_case
from phantoms.fields import Lattice, as_distance, lattice_over
from phantoms.lobes import Fissures, Sheet, whole
from phantoms.nodule import Nodule, paint_nodule
from phantoms.patient import Patient
from phantoms.spec import PhantomSpec
from phantoms.states import make_states
from phantoms.thorax import place_nodule
from phantoms.voxels import Image, Region

Array = NDArray[Any]
FLESH_HU = -200.0
TRIES = 30


@dataclass(frozen=True)
class Scan:
    """A chest CT and what is seen in it. lungs: by side; spine: (n, 3) centres of the vertebral column, hilum: (3,) of
    the operated lung, RAS mm; nodule: of the CT, or None to put one in."""

    ct: Image
    lungs: dict[str, Region]
    spine: Array
    hilum: Array
    nodule: Region | None = None


@dataclass(frozen=True)
class TwinBase:
    """A scanned person in the frame of `anatomy`. origin: (3,) mm of that frame in the scan's; ct: with the nodule;
    body: without the operated lung; lung: mask of that lung."""

    patient: Patient
    origin: Array
    ct: Image
    body: Image
    lung: Region


def make_twin(scan: Scan, spec: PhantomSpec, seed: int = 0) -> PhantomCase:
    """The case of a scanned person; the lung is one piece, since a scan does not say where its lobes have grown
    together.

    Raises ValueError where the scan shows no place for the nodule, or too little of either lung.
    """
    rng = np.random.default_rng([seed, 12])
    base = twin_base(scan, spec, seed, rng)
    table = make_states(base.patient, spec, rng)
    marks = _corners(base.patient)
    return _back(finish_case(base.patient, spec, seed, table, (base.ct, base.body, base.lung), marks, rng), base.origin)


def make_breath(scan: Scan, side: str, count: int, least: float, seed: int = 0) -> tuple[Breath, Array]:
    """`count` states of one breath of a scanned person, down to `least` of the lung's volume in the scan, and the
    origin (3,) mm of their frame in the scan's. Raises as `make_twin`."""
    rng = np.random.default_rng([seed, 13])
    base = twin_base(scan, PhantomSpec("breath", side), seed, rng)
    return breathe(base.patient, base.body, volume_signal(count, least), 18.0, rng), base.origin


def twin_base(scan: Scan, spec: PhantomSpec, seed: int, rng: np.random.Generator) -> TwinBase:
    """The person in a scan, with a nodule like that of `spec` put in where the scan has none."""
    origin, build = chest_frame(scan)
    scan = _shifted(scan, -origin)
    patient = _patient(scan, build, spec, seed, rng)
    ct = Image(scan.ct.hu.copy(), scan.ct.ras_from_ijk)
    if scan.nodule is None:
        paint_nodule(ct.hu, ct.grid, patient.nodule, float(ct.grid.spacing.mean()))
    lung = scan.lungs[spec.side]
    return TwinBase(patient, origin, ct, without_lung(scan.ct, lung), lung)


def chest_frame(scan: Scan) -> tuple[Array, Build]:
    """Origin (3,) mm of the frame of `anatomy` in a scan, and the measures of the person, from lungs and spine."""
    points = {}
    for side, mask in scan.lungs.items():
        found = np.argwhere(mask.inside[::3, ::3, ::2]) * [3, 3, 2]
        if len(found) < 1000:
            raise ValueError(f"the scan shows too little of the {side} lung, give one of the whole chest")
        points[side] = mask.grid.to_ras(found)
    both = np.concatenate(list(points.values()))
    low, high = np.percentile(both, [0.2, 99.8], axis=0)
    domes = {side: _dome(p) for side, p in points.items()}
    size = (high[2] - domes["right"]) / 222
    x, y = float(np.median(scan.spine[:, 0])), (low[1] + high[1]) / 2
    origin = np.array([x, y, high[2] - 120 * size])
    build = Build(
        width=float(max(high[0] - x, x - low[0])),
        depth=float(SPINE_MM - np.median(scan.spine[:, 1] - y)),
        apex=120 * size,
        dome=(domes["right"] - origin[2], domes["left"] - origin[2]),
        fat=(15.0, 15.0),
        heart=np.array([[-20.0, 22, -66], [50, 43, 54]]) * size,
        spine_bow=0.0,
        mediastinum=27.0,
    )
    return origin, build


def _dome(points: Array) -> float:
    """Height (mm) of the top of the diaphragm below a lung given by points (n, 3)."""
    cell = np.round(points[:, :2] / 6).astype(int)
    _, column = np.unique(cell, axis=0, return_inverse=True)
    column = column.ravel()
    bottom = np.full(column.max() + 1, np.inf)
    np.minimum.at(bottom, column, points[:, 2])
    centre = np.abs(cell - np.median(cell, axis=0)).max(axis=1) * 6 < 30
    return float(np.percentile(bottom[np.unique(column[centre])], 95))


def _patient(scan: Scan, build: Build, spec: PhantomSpec, seed: int, rng: np.random.Generator) -> Patient:
    lung = _distance(scan.lungs[spec.side], 3.0)
    tissue = _lung_tissue(scan.ct, scan.lungs[spec.side])
    sign = 1 if spec.side == "right" else -1
    if scan.nodule is None:
        lesion = spec.lesion
        places = [place_nodule(lung, build, lesion, sign, None, rng) for _ in range(TRIES)]
        around = rng.uniform(-lesion.radius, lesion.radius, (200, 3))
        # Lung that is plain in the scan: no vessel wide enough to be told from the nodule.
        centre = min(places, key=lambda p: float(np.percentile(tissue.sample(p + around), 95)))
        nodule = Nodule(centre, lesion.radius, 0.12 * lesion.radius, lesion.kind, lesion.seen)
    else:
        inside = scan.nodule.grid.to_ras(np.argwhere(scan.nodule.inside))
        volume = len(inside) * float(scan.nodule.grid.spacing.prod())
        nodule = Nodule(inside.mean(axis=0), float(np.cbrt(volume * 0.75 / np.pi)), 0.0, "given", spec.lesion.seen)
    lobes = whole(lung, Fissures(Sheet(scan.hilum, 8.0, 0.9, 0.0), None, np.inf, drawn=False))
    return Patient(spec.side, seed, build, lung, lobes, scan.hilum, nodule, tissue, None)


def _distance(mask: Region, spacing: float) -> Lattice:
    """Signed distance (mm) to the surface of a mask, on a lattice wide enough for the lung to be carried in."""
    box = mask.grid.to_ras(np.argwhere(mask.inside))
    lattice = lattice_over(box.min(axis=0) - 24, box.max(axis=0) + 24, spacing)
    soft = ndimage.gaussian_filter(mask.inside.astype(np.float32), 2.0 / mask.grid.spacing)
    return as_distance(lattice, 0.5 - _on(soft, mask, lattice))


def _on(values: Array, at: Region | Image, lattice: Lattice) -> Array:
    index = at.grid.to_ijk(lattice.points()).T
    sampled = ndimage.map_coordinates(values, index, order=1, mode="nearest", prefilter=False)
    return np.asarray(sampled.reshape(lattice.values.shape))


def _lung_tissue(ct: Image, lung: Region) -> Lattice:
    """HU of the lung on a lattice as fine as the scan's pixels, but not finer than 1 mm; at the border and beyond, that
    of the nearest tissue well inside."""
    spacing = max(1.0, float(ct.grid.spacing.min()))
    box = lung.grid.to_ras(np.argwhere(lung.inside))
    lattice = lattice_over(box.min(axis=0) - 8, box.max(axis=0) + 8, spacing)
    hu = _on(ct.hu, ct, lattice)
    inner = ndimage.binary_erosion(
        _on(lung.inside.astype(np.float32), lung, lattice) > 0.5, iterations=max(round(2 / spacing), 1)
    )
    nearest = ndimage.distance_transform_edt(~inner, return_distances=False, return_indices=True)
    return lattice.like(hu[tuple(nearest)])


def without_lung(ct: Image, lung: Region) -> Image:
    """The CT with a lung replaced by the flesh that is nearest to each of its places."""
    spacing = ct.grid.spacing
    found = np.argwhere(lung.inside)
    pad = np.ceil(12 / spacing).astype(int)
    box = tuple(
        slice(max(a - p, 0), b + p + 1) for a, b, p in zip(found.min(axis=0), found.max(axis=0), pad, strict=True)
    )
    inside = ndimage.binary_dilation(lung.inside[box], iterations=2)
    flesh = ~inside & (ct.hu[box] > FLESH_HU)
    nearest = ndimage.distance_transform_edt(~flesh, sampling=spacing, return_distances=False, return_indices=True)
    hu = ct.hu.copy()
    filled = ct.hu[box][tuple(nearest)]
    hu[box] = np.where(inside, filled, ct.hu[box])
    return Image(hu, ct.ras_from_ijk)


def _corners(patient: Patient) -> Array:
    """Points (n, 3) mm in the lung where vessels fork: peaks of how much the image changes in every direction.

    Ref: Foerstner 1987 (det / trace of the structure tensor).
    """
    tissue = patient.parenchyma
    voxel = tissue.spacing
    smooth = ndimage.gaussian_filter(np.minimum(tissue.values, 0.0), max(1.2 / voxel, 0.6))
    slopes = np.gradient(smooth)
    products = {
        (a, b): ndimage.gaussian_filter(slopes[a] * slopes[b], 2.0 / voxel) for a in range(3) for b in range(a, 3)
    }
    tensor = np.stack([products[min(a, b), max(a, b)] for a in range(3) for b in range(3)], axis=-1)
    strength = np.linalg.det(tensor.reshape(*tissue.values.shape, 3, 3)) / np.maximum(
        tensor[..., 0] + tensor[..., 4] + tensor[..., 8], 1e-6
    )
    peak = strength == ndimage.maximum_filter(strength, size=max(round(7 / voxel), 3))
    points = tissue.origin + tissue.spacing * np.argwhere(peak)
    power = strength[peak]
    inner = (patient.lung.at(points) < -6.0) & (patient.nodule.distance(points) > 5.0)
    points, power = points[inner], power[inner]
    return np.asarray(points[power > np.quantile(power, 0.8)])


def _shifted(scan: Scan, shift: Array) -> Scan:
    move = np.eye(4)
    move[:3, 3] = shift
    return replace(
        scan,
        ct=Image(scan.ct.hu, move @ scan.ct.ras_from_ijk),
        lungs={side: Region(m.inside, move @ m.ras_from_ijk) for side, m in scan.lungs.items()},
        spine=scan.spine + shift,
        hilum=scan.hilum + shift,
        nodule=None if scan.nodule is None else Region(scan.nodule.inside, move @ scan.nodule.ras_from_ijk),
    )


def _back(made: PhantomCase, origin: Array) -> PhantomCase:
    """The case with its CT, and all that is said in the CT's frame, where the scan was."""
    move = np.eye(4)
    move[:3, 3] = origin
    masks = {k: Region(m.inside, move @ m.ras_from_ijk) if k.endswith("_ct") else m for k, m in made.masks.items()}
    shift = np.concatenate([origin, np.zeros(6)])
    return replace(
        made,
        ct=Image(made.ct.hu, move @ made.ct.ras_from_ijk),
        nodule=Region(made.nodule.inside, move @ made.nodule.ras_from_ijk),
        nodule_ct=made.nodule_ct + origin,
        landmarks_ct=made.landmarks_ct + origin,
        dense_truth=made.dense_truth + shift,
        masks=masks,
    )
