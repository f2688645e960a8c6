"""Both lungs and the windpipe in a diagnostic CT, told apart by shape and by where they lie in the patient."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from registration.images.morphology import close, dilate, distances_to, erode, largest
from registration.volume import Array, Grid, Mask, Volume
from vatsloc.errors import InputRefused
from vatsloc.frames import Side
from vatsloc.imaging.airways import grow_airways, trachea
from vatsloc.imaging.lattice import on_grid, working_copy

AIRY_HU = -400.0
ROOM_AIR_HU = -930.0
SPACING_MM = 2.0
LEAST_LUNG_ML = 250.0


@dataclass(frozen=True)
class Lungs:
    """Lungs of a CT on its grid. left, right: lung masks (empty where the CT shows none); airways: trachea and bronchi.

    midline_r: R coordinate in mm of the plane between the lungs; volume_ml: of each side.
    """

    left: Mask
    right: Mask
    airways: Mask
    midline_r: float
    volume_ml: dict[str, float]

    def of(self, side: Side) -> Mask:
        """The lung on `side`."""
        return self.left if side == "left" else self.right


def segment_lungs(ct: Volume, side: Side, nodule: Mask | None = None, nodule_ras: Array | None = None) -> Lungs:
    """Both lungs of `ct` with vessels and hilum closed; the lung on `side` also takes in the nodule.

    nodule: mask in the CT's frame; nodule_ras: (3,) its centre in RAS mm. Raises InputRefused when the CT does not show
    the lung, or the nodule lies in the other one. Ref: Alvarez 2021, section 6.1.2.
    """
    work, airways, halves, midline = lung_halves(ct)
    spacing, voxel_ml = work.grid.spacing, float(work.grid.spacing.prod()) / 1000
    spots = nodule_voxels(work.grid, nodule, nodule_ras)
    done = {
        name: _finished(halves[name], halves[_other(name)], spots if name == side else None, spacing)
        for name in ("left", "right")
    }
    volume = {name: float(done[name].sum()) * voxel_ml for name in done}
    _check_side(side, volume, halves, spots, spacing)
    masks = {name: on_grid(done[name], work.grid, ct.grid, smooth_mm=1.5) for name in done}
    if nodule is not None and nodule.grid.same_as(ct.grid):
        masks[side] = Mask(masks[side].inside | nodule.inside, ct.ras_from_ijk)
    return Lungs(masks["left"], masks["right"], on_grid(airways, work.grid, ct.grid), midline, volume)


def lung_halves(ct: Volume) -> tuple[Volume, Array, dict[str, Array], float]:
    """Working copy of `ct`, and on it the airways, the airy part of either lung, and the midline's R coordinate in mm.

    Raises InputRefused when the CT shows no lung.
    """
    work = working_copy(ct, SPACING_MM)
    spacing, voxel_ml = work.grid.spacing, float(work.grid.spacing.prod()) / 1000
    air = _air_in_body(work)
    windpipe = trachea(work, air)
    airways = grow_airways(work, windpipe)
    candidates = air & ~dilate(airways, 2.5, spacing)
    pieces = _lung_pieces(candidates, voxel_ml)
    if not pieces:
        found = candidates.sum() * voxel_ml
        raise InputRefused(
            f"The CT shows no lung: {found:.0f} ml of airy tissue inside the body, {LEAST_LUNG_ML:.0f} ml needed; "
            "give a chest CT in HU, or a lung mask as [hints] lung_mask_ct."
        )
    midline = _midline(work.grid, pieces, airways)
    return work, airways, _sides(work.grid, pieces, midline), midline


def split_lungs(both: Mask) -> dict[Side, Mask]:
    """Left and right lung of one mask of both, on voxels about 2 mm wide along the patient's axes, dents closed.

    Raises InputRefused when one of the lungs is missing.
    """
    work = working_copy(Volume(both.inside.astype(np.float32), both.ras_from_ijk), SPACING_MM)
    spacing, voxel_ml = work.grid.spacing, float(work.grid.spacing.prod()) / 1000
    pieces = _lung_pieces(work.hu >= 0.5, voxel_ml)
    empty = np.zeros(work.grid.shape, dtype=bool)
    halves = _sides(work.grid, pieces, _midline(work.grid, pieces, empty)) if pieces else {}
    lungs: dict[Side, Mask] = {}
    for side in ("left", "right"):
        volume = float(halves[side].sum()) * voxel_ml if halves else 0.0
        if volume < LEAST_LUNG_ML:
            raise InputRefused(
                f"The mask holds {volume:.0f} ml of the {side} lung, {LEAST_LUNG_ML:.0f} ml needed; "
                "give one mask of both lungs."
            )
        lungs[side] = Mask(_finished(halves[side], halves[_other(side)], None, spacing), work.ras_from_ijk)
    return lungs


def _other(side: str) -> str:
    return "right" if side == "left" else "left"


def _air_in_body(work: Volume) -> Array:
    """Air-like voxels that no axial slice joins to the outside.

    Where a CT was cropped through a lung, what touches its side face is inside unless it is as dark as room air.
    """
    airy = work.hu < AIRY_HU
    in_slice = np.zeros((3, 3, 3), dtype=bool)
    in_slice[:, :, 1] = ndimage.generate_binary_structure(2, 1)
    labels, count = ndimage.label(airy, in_slice)
    outside = np.zeros(count + 1, dtype=bool)
    for face in (labels[:, 0], labels[:, -1]):
        outside[np.unique(face)] = True
    pieces = np.bincount(labels.ravel(), minlength=count + 1)
    mean = np.bincount(labels.ravel(), work.hu.ravel(), minlength=count + 1) / np.maximum(pieces, 1)
    for face in (labels[0], labels[-1]):
        at_side = np.unique(face)
        outside[at_side[mean[at_side] < ROOM_AIR_HU]] = True
    outside[0] = True
    return ~outside[labels]


def _lung_pieces(candidates: Array, voxel_ml: float) -> list[Array]:
    """The large connected parts: two separate lungs, one lung, or both as one; bowel gas is smaller or lies lower."""
    labels, _ = ndimage.label(candidates)
    ml = np.bincount(labels.ravel()) * voxel_ml
    ml[0] = 0
    order = np.argsort(ml)[::-1][:4]
    kept = [n for n in order if ml[n] >= max(LEAST_LUNG_ML, 0.15 * ml[order[0]])]
    pieces = [labels == n for n in kept]
    if len(pieces) > 2:
        height = [float(np.argwhere(p)[:, 2].mean()) for p in pieces]
        pieces = [pieces[m] for m in np.argsort(height)[::-1][:2]]
    return pieces


def _midline(grid: Grid, pieces: list[Array], airways: Array) -> float:
    """R coordinate between the lungs: halfway between two, or where the windpipe runs, or the middle of one block."""
    centres = [grid.to_ras(np.argwhere(p).mean(axis=0))[0] for p in pieces]
    if airways.any():
        top = np.argwhere(airways)
        return float(np.median(grid.to_ras(top[top[:, 2] >= np.percentile(top[:, 2], 50)].astype(float))[:, 0]))
    if len(pieces) == 2:
        return float(np.mean(centres))
    x = grid.to_ras(np.argwhere(pieces[0]).astype(float))[:, 0]
    return float((x.min() + x.max()) / 2)


def _sides(grid: Grid, pieces: list[Array], midline: float) -> dict[str, Array]:
    """Left and right lung; a single piece that reaches far over the midline is cut where it is thinnest."""
    if len(pieces) == 1:
        r = grid.to_ras(np.argwhere(pieces[0]).astype(float))[:, 0] - midline
        if min((r > 0).mean(), (r < 0).mean()) > 0.2:
            pieces = _cut(pieces[0], grid, midline)
    empty = np.zeros(pieces[0].shape, dtype=bool)
    out = {"left": empty, "right": empty.copy()}
    for piece in pieces:
        r = grid.to_ras(np.argwhere(piece).mean(axis=0))[0]
        name = "right" if r > midline else "left"
        out[name] = out[name] | piece
    if len(pieces) == 2 and not (out["left"].any() and out["right"].any()):
        first, second = sorted(pieces, key=lambda p: np.argwhere(p)[:, 0].mean())
        out = {"left": first, "right": second}
    return out


def _cut(joined: Array, grid: Grid, midline: float) -> list[Array]:
    """Two lungs that touch, parted where they are joined thinly, else at the midline."""
    parted = part_joined(joined, grid)
    if parted is not None:
        return list(parted)
    r = grid.to_ras(np.stack(np.meshgrid(*[np.arange(n) for n in joined.shape], indexing="ij"), -1).astype(float))[
        ..., 0
    ]
    return [joined & (r < midline), joined & (r >= midline)]


def part_joined(joined: Array, grid: Grid) -> tuple[Array, Array] | None:
    """Two large parts of a mask that touch, eroded until they fall apart and grown back; None if they do not."""
    spacing = grid.spacing
    depth = ndimage.distance_transform_edt(joined, sampling=spacing)
    for radius in np.arange(2.0, 24.0, 2.0):
        labels, count = ndimage.label(depth > radius)
        if count < 2:
            continue
        sizes = np.bincount(labels.ravel())
        sizes[0] = 0
        one, two = np.argsort(sizes)[::-1][:2]
        if sizes[two] > 0.25 * sizes[one]:
            markers = np.where(labels == one, 1, np.where(labels == two, 2, 0)).astype(np.uint8)
            grown = grow_both(markers, joined, int(np.ceil(4 * radius / spacing.min())))
            return grown == 1, grown == 2
    return None


def grow_both(markers: Array, allowed: Array, steps: int) -> Array:
    """Marked parts (1, 2) grown within `allowed` at one pace, at most `steps` voxels far."""
    grown = markers
    for _ in range(steps):
        new = np.where((grown == 0) & allowed, _greatest_beside(grown), grown)
        if np.array_equal(new, grown):
            break
        grown = new
    return grown


def _greatest_beside(image: Array) -> Array:
    """The greatest of every voxel and the six beside it, ten times as fast as SciPy's filter."""
    greatest = image.copy()
    for axis in range(image.ndim):
        of, to = np.moveaxis(image, axis, 0), np.moveaxis(greatest, axis, 0)
        np.maximum(to[1:], of[:-1], out=to[1:])
        np.maximum(to[:-1], of[1:], out=to[:-1])
    return greatest


def nodule_voxels(grid: Grid, nodule: Mask | None, nodule_ras: Array | None) -> Array | None:
    """Voxels of the nodule on the working grid: the mask, and a small ball about the point."""
    if nodule is None and nodule_ras is None:
        return None
    spots = np.zeros(grid.shape, dtype=bool)
    points = np.empty((0, 3)) if nodule is None else nodule.grid.to_ras(np.argwhere(nodule.inside).astype(float))
    if nodule_ras is not None:
        points = np.vstack([points, np.reshape(nodule_ras, (1, 3))])
    ijk = np.rint(grid.to_ijk(points)).astype(int)
    ijk = ijk[((ijk >= 0) & (ijk < grid.shape)).all(axis=1)]
    spots[tuple(ijk.T)] = True
    return spots


def _finished(lung: Array, other_lung: Array, spots: Array | None, spacing: Array) -> Array:
    """Vessels, hilum and a nodule at the pleura closed by a 10 mm ball, holes filled."""
    if not lung.any():
        return lung
    core = largest(erode(lung, 1.0, spacing))
    lung = lung & dilate(core, 3.0, spacing)
    if spots is not None:
        lung = lung | spots
    closed = ndimage.binary_fill_holes(close(lung, 10.0, spacing))
    return largest(closed & ~(other_lung & ~lung))


def _check_side(
    side: Side, volume_ml: dict[str, float], halves: dict[str, Array], spots: Array | None, spacing: Array
) -> None:
    """Refuse a CT without the operated lung, and a nodule that lies in, or nearer to, the other lung."""
    if volume_ml[side] < LEAST_LUNG_ML:
        raise InputRefused(
            f"The CT shows {volume_ml[side]:.0f} ml of the {side} lung, {LEAST_LUNG_ML:.0f} ml needed; "
            f'give a CT that holds it, or correct side = "{side}" in case.toml.'
        )
    if spots is None:
        return
    if not spots.any():
        raise InputRefused("The nodule lies outside the CT; give it in the CT's frame.")
    away = {
        name: float(distances_to(lung, np.argwhere(spots), spacing).mean()) if lung.any() else np.inf
        for name, lung in halves.items()
    }
    other = _other(side)
    if away[other] + 1.0 < away[side]:
        raise InputRefused(
            f"The nodule lies in the {other} lung, {away[side]:.0f} mm from the {side} one, the operated one; "
            f'set side = "{other}" in case.toml, or mend the orientation of the CT.'
        )
    if away[side] > 15.0:
        raise InputRefused(
            f"The nodule lies {away[side]:.0f} mm outside the {side} lung, 15 mm allowed; give it in the CT's frame."
        )
