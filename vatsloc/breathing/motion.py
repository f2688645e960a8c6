"""What every driver returns: lungs as meshes that keep their tetrahedra while their nodes move from state to state."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from poro.arrays import Array
from poro.mesh import TetMesh, interpolate, locate
from poro.mesh.tetmesh import signed_volumes
from vatsloc.frames import Side

OUT, IN = "inspiration to expiration", "expiration to inspiration"
FULL_DEPTH = 0.98
"""Share of the breath from which on a state stands for the other scan."""


@dataclass(frozen=True)
class LungMotion:
    """One lung. mesh: in the scan the motion starts from; states: nodes (n, 3) RAS mm in every state."""

    side: Side
    mesh: TetMesh
    states: tuple[Array, ...]

    def volume_ml(self, state: int) -> float:
        """Volume in a state."""
        return float(signed_volumes(self.states[state], self.mesh.tets).sum()) / 1000


@dataclass(frozen=True)
class Motion:
    """States of a breath. direction: from which scan to which; end: state that stands for the other scan, None where
    there is none; pressure_pa: of the lung's recoil, one per state; details: of the driver, for the page and the JSON;
    registered: what two images told, as a motion of its own that drove this one.
    """

    driver: str
    direction: str
    lungs: tuple[LungMotion, ...]
    pressure_pa: tuple[float, ...]
    end: int | None
    warnings: tuple[str, ...] = ()
    details: dict[str, Any] = field(default_factory=dict)
    registered: Motion | None = None

    @property
    def count(self) -> int:
        """Number of states."""
        return len(self.lungs[0].states)

    @property
    def farthest(self) -> int:
        """State in which tissue is farthest from where the motion starts, in mean."""
        far = [
            np.mean([np.linalg.norm(lung.states[n] - lung.mesh.points, axis=1).mean() for lung in self.lungs])
            for n in range(self.count)
        ]
        return int(np.argmax(far))

    def volume_ml(self, state: int) -> float:
        """Volume of all lungs in a state."""
        return sum(lung.volume_ml(state) for lung in self.lungs)

    def moved(self, points: Array, state: int) -> Array:
        """Where points (k, 3) of the first scan are in a state; each moves with the lung it lies in or nearest to."""
        best = np.full(len(points), np.inf)
        out = np.array(points, float)
        for lung in self.lungs:
            where = locate(lung.mesh, points)
            near = where.distance < best
            motion = interpolate(where, lung.states[state] - lung.mesh.points)
            out[near], best[near] = (points + motion)[near], where.distance[near]
        return out

    def whole_mesh(self, state: int) -> tuple[Array, Array]:
        """Nodes (n, 3) and tetrahedra (m, 4) of all lungs together in a state."""
        starts = np.cumsum([0, *(len(lung.mesh.points) for lung in self.lungs)])
        tets = [lung.mesh.tets + start for lung, start in zip(self.lungs, starts, strict=False)]
        return np.concatenate([lung.states[state] for lung in self.lungs]), np.concatenate(tets)


def between(u: Array, knots: Array, share: float) -> Array:
    """Displacement (n, 3) at a share of the way, linear between those (k, n, 3) at the knots (k,)."""
    k = min(int(np.searchsorted(knots, share, "right")) - 1, len(knots) - 2)
    part = (share - knots[k]) / (knots[k + 1] - knots[k])
    return np.asarray((1 - part) * u[k] + part * u[k + 1])


def along(motion: Motion, volume: Array) -> Motion:
    """The same way, from the first scan to the other, in states at volumes (k,), 0 expiration to 1 inspiration, of a
    breath: what the lungs hold together tells how far they are on it.
    """
    held = np.array([motion.volume_ml(n) for n in range(motion.count)])
    done = np.maximum.accumulate((held - held[0]) / (held[-1] - held[0]))
    knots = shares(motion.count)
    progress = volume if motion.direction == IN else 1 - volume
    at = np.interp(progress, done, knots)
    lungs = tuple(
        LungMotion(lung.side, lung.mesh, tuple(between(np.stack(lung.states), knots, s) for s in at))
        for lung in motion.lungs
    )
    pressure = tuple(float(p) for p in np.interp(at, knots, motion.pressure_pa))
    deepest = int(np.argmax(progress))
    end = deepest if motion.end is not None and progress[deepest] > FULL_DEPTH else None
    return replace(motion, lungs=lungs, pressure_pa=pressure, end=end)


def shares(count: int) -> Array:
    """Progress (count,) of the motion, 0 at the first scan and 1 at the other one."""
    return np.linspace(0.0, 1.0, count)
