"""The rigid wall around the lung: the chest wall, and the diaphragm that moves along an axis."""

from __future__ import annotations

from dataclasses import dataclass

from poro.arrays import Array
from poro.contact.levelset import LevelSet


@dataclass(frozen=True)
class ChestWall:
    """Rigid wall around the lung, a part of which moves along an axis.

    level: distance to the wall, positive inside; rest: (nc, 3) mm contact nodes at rest; moving: (nc,) bool, nodes that
    face the moving part; axis: (3,) unit vector; offset: (nc,) mm subtracted so that no node starts behind the wall.
    """

    level: LevelSet
    rest: Array
    moving: Array
    axis: Array
    offset: Array

    def gap(self, u: Array, travel_mm: float) -> tuple[Array, Array, Array]:
        """Gap (nc,) mm, its gradient (nc, 3) and Hessian (nc, 3, 3) at displacements u (nc, 3)."""
        value, gradient, hessian = self.level.evaluate(self.rest + u - travel_mm * self.moving[:, None] * self.axis)
        return value - self.offset, gradient, hessian
