"""One person's lungs at two breath-holds: masks as they come, mended and meshed, and the landmarks that score them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy import ndimage

from poro.arrays import Array
from poro.breathing.elastic import Lung
from registration.volume import Mask
from vatsloc.breathing.case import LANDMARKS, BreathCase, read_breath
from vatsloc.breathing.lungs import EDGE_MM, Pair, both_scans
from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.guard import reading
from vatsloc.imaging.lungs import Side
from vatsloc.study.bench.spoilt_masks import spoilt

_COLUMNS = ["insp_x", "insp_y", "insp_z", "exp_x", "exp_y", "exp_z"]
_OTHER_COLUMNS = ["first_x", "first_y", "first_z", "second_x", "second_y", "second_z"]
"""The same, in the words of folders that call their states first and second."""


@dataclass(frozen=True)
class Marks:
    """Landmarks of one lung, (k, 3) mm each, row by row the same points. They score, and are shown to no prediction."""

    inspired: Array
    expired: Array


@dataclass(frozen=True)
class Person:
    """A person's two breath-holds. case: masks and images as they came; notes: what was mended; inspired, expired:
    landmarks (n, 3) RAS mm, one by one the same points."""

    name: str
    case: BreathCase
    pairs: tuple[Pair, ...]
    notes: tuple[str, ...]
    inspired: Array
    expired: Array

    @property
    def lungs(self) -> list[Lung]:
        """Lungs at both breath-holds as meshes, made of the masks alone."""
        return [pair.lung for pair in self.pairs]

    @cached_property
    def sides(self) -> list[Side]:
        """Lung that each landmark lies in or is nearest to, at inspiration."""
        distances = np.stack([_distance(pair.inspired, self.inspired) for pair in self.pairs])
        return [self.pairs[n].side for n in distances.argmin(axis=0)]

    def marks(self, side: Side) -> Marks:
        """Landmarks of the lung on `side`, by where they lie at inspiration."""
        here = np.array(self.sides) == side
        return Marks(self.inspired[here], self.expired[here])


def read_person(folder: Path, edge_mm: float = EDGE_MM, way: str | None = None) -> Person:
    """The person of a breathing case's folder (masks, or images, of two states) with `landmarks_ras_mm.csv` (header
    insp_x ... exp_z, RAS mm), meshed with edges of `edge_mm`; way: in which its masks are spoilt first (`SPOILT`).

    Raises CaseError for a missing file or another header, InputRefused for masks without lungs or bad numbers.
    """
    case = read_breath(folder)
    if case.landmarks is None:
        raise CaseError(f"{folder} lacks {LANDMARKS}; write {','.join(_COLUMNS)} in RAS mm.")
    points = _landmarks(case.landmarks)
    case = case if way is None else spoilt(case, way)
    pairs, notes = both_scans(case, edge_mm)
    return Person(case.name, case, tuple(pairs), tuple(notes), points[:, :3], points[:, 3:])


def _landmarks(path: Path) -> Array:
    with reading(path, "table of numbers", "write six numbers per line"):
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    if not lines or [name.strip() for name in lines[0].split(",")] not in (_COLUMNS, _OTHER_COLUMNS):
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
