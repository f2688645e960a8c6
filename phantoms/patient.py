"""What the collapse of a lung needs to know of its owner, be he drawn from a seed or scanned."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phantoms.anatomy import Build
from phantoms.fields import Lattice
from phantoms.lobes import Lobes
from phantoms.nodule import Nodule
from phantoms.trees import LungTrees

Array = NDArray[Any]


@dataclass(frozen=True)
class Patient:
    """A person and the operated lung, in the frame of `anatomy`. lung: signed distance (mm); lobes: of that lung;
    hilum: (3,) mm; parenchyma: HU of the lung in the CT, without its fissures and, if `trees` are given, those."""

    side: str
    seed: int
    build: Build
    lung: Lattice
    lobes: Lobes
    hilum: Array
    nodule: Nodule
    parenchyma: Lattice
    trees: LungTrees | None

    @property
    def sign(self) -> int:
        """1 for the right, -1 for the left side."""
        return 1 if self.side == "right" else -1

    @property
    def scanned_centre(self) -> Array:
        """Middle of the cone-beam scanner's field of view, (3,) mm."""
        return np.array([self.sign * 56.0, -6.0, -42.0])

    def tissue(self, points: Array) -> Array:
        """HU (n,) of the lung at points (n, 3) in the CT, without trees and nodule."""
        return np.asarray(self.parenchyma.sample(points) + self.lobes.fissures.density(points))
