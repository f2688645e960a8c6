"""One person's lungs at two breath-holds: masks, parted into lungs and meshed, and the landmarks that score them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy import ndimage

from poro.arrays import Array
from poro.breathing.elastic import Lung
from poro.mesh import TetMesh, stuff
from registration.volume import Mask
from vatsloc.breathing.masks import to_the_back
from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.guard import reading
from vatsloc.formats.images import read_mask
from vatsloc.imaging.lungs import Side, split_lungs

INSPIRATION, EXPIRATION, LANDMARKS = "lungs_inspiration.nii.gz", "lungs_expiration.nii.gz", "landmarks_ras_mm.csv"
_COLUMNS = ["insp_x", "insp_y", "insp_z", "exp_x", "exp_y", "exp_z"]


@dataclass(frozen=True)
class Breath:
    """Lungs at one breath-hold. lungs: side -> mask in RAS; landmarks: (n, 3) RAS mm."""

    lungs: dict[Side, Mask]
    landmarks: Array

    @cached_property
    def sides(self) -> list[Side]:
        """Lung that each landmark lies in or is nearest to."""
        distances = np.stack([_distance(self.lungs[side], self.landmarks) for side in ("left", "right")])
        return ["right" if right else "left" for right in distances[1] < distances[0]]


@dataclass(frozen=True)
class Marks:
    """Landmarks of one lung, (k, 3) mm each, row by row the same points. They score, and are shown to no prediction."""

    inspired: Array
    expired: Array


@dataclass(frozen=True)
class Person:
    """A person's two breath-holds, landmark by landmark the same points."""

    name: str
    inspiration: Breath
    expiration: Breath

    def lungs(self, edge_mm: float) -> list[Lung]:
        """Both lungs at both breath-holds, as meshes of edge `edge_mm`, made of the masks alone."""
        return [
            Lung(side, _mesh(inspired, edge_mm), _mesh(to_the_back(self.expiration.lungs[side], inspired), edge_mm))
            for side, inspired in self.inspiration.lungs.items()
        ]

    def marks(self, side: Side) -> Marks:
        """Landmarks of the lung on `side`, by where they lie at inspiration."""
        here = np.array(self.inspiration.sides) == side
        return Marks(self.inspiration.landmarks[here], self.expiration.landmarks[here])


def read_person(folder: Path) -> Person:
    """Masks and landmarks of a folder with `lungs_inspiration.nii.gz`, `lungs_expiration.nii.gz` and
    `landmarks_ras_mm.csv` (header insp_x ... exp_z, RAS mm).

    Raises CaseError for a missing file or another header, InputRefused for masks without two lungs or bad numbers.
    """
    missing = [name for name in (INSPIRATION, EXPIRATION, LANDMARKS) if not (folder / name).is_file()]
    if missing:
        raise CaseError(
            f"{folder} lacks {' and '.join(missing)}; give a folder with {INSPIRATION}, {EXPIRATION} and {LANDMARKS}."
        )
    points = _landmarks(folder / LANDMARKS)
    inspiration, expiration = (split_lungs(read_mask(folder / name)) for name in (INSPIRATION, EXPIRATION))
    return Person(folder.resolve().name, Breath(inspiration, points[:, :3]), Breath(expiration, points[:, 3:]))


def _landmarks(path: Path) -> Array:
    with reading(path, "table of numbers", "write six numbers per line"):
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    if not lines or [name.strip() for name in lines[0].split(",")] != _COLUMNS:
        raise CaseError(f"{path} starts with {lines[0] if lines else 'nothing'!r}; write {','.join(_COLUMNS)}.")
    try:
        points = np.array([[float(value) for value in line.split(",")] for line in lines[1:] if line.strip()])
    except ValueError as error:
        raise InputRefused(f"{path} holds what is no number ({error}); write six numbers per line.") from error
    if points.ndim != 2 or points.shape[1] != 6 or not np.isfinite(points).all():
        raise InputRefused(f"{path} has rows that are not six finite numbers; write {','.join(_COLUMNS)} in RAS mm.")
    return points


def _distance(lung: Mask, points: Array) -> Array:
    """Distance (n,) mm from points to the lung's voxels, points beyond the image taken at its border."""
    outside = ndimage.distance_transform_edt(~lung.inside, sampling=lung.grid.spacing)
    ijk = np.clip(np.rint(lung.grid.to_ijk(points)), 0, np.array(lung.grid.shape) - 1).astype(int)
    return np.asarray(outside[tuple(ijk.T)])


def _mesh(lung: Mask, edge_mm: float) -> TetMesh:
    return stuff(lung.inside, lung.ras_from_ijk, edge_mm)
