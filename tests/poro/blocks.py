"""Two bodies that touch across meshes that do not match, for tests of contact between pieces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from hertz import half_block, half_space
from shapes import box, compliance_of

from poro.arrays import Array
from poro.contact import ChestWall, ContactState, Facing, LevelSet, solve_contact
from poro.fem import Solid, Tissue, solid
from poro.mesh import TetMesh

OPEN = LevelSet(np.full((4, 4, 4), 1e3), np.zeros(3), 1e3)
"""A wall out of reach."""


@dataclass(frozen=True)
class Pair:
    """Two bodies in one mesh. lower: (n,) bool nodes of the first; nodes: (nc,) contact nodes; below, above: (t, 3)
    triangles of them that may touch, by contact node.
    """

    mesh: TetMesh
    lower: Array
    nodes: Array
    below: Array
    above: Array

    @staticmethod
    def of(first: TetMesh, second: TetMesh, touching: Array) -> Pair:
        """Two meshes, and which nodes (n,) bool of both may touch."""
        count = len(first.points)
        mesh = TetMesh(np.concatenate([first.points, second.points]), np.concatenate([first.tets, second.tets + count]))
        faces = mesh.boundary.nodes[mesh.boundary.triangles]
        faces = faces[touching[faces].all(axis=1)]
        place = np.full(len(mesh.points), -1)
        place[np.flatnonzero(touching)] = np.arange(touching.sum())
        lower = np.arange(len(mesh.points)) < count
        below = lower[faces[:, 0]]
        return Pair(mesh, lower, np.flatnonzero(touching), place[faces[below]], place[faces[~below]])

    def facing(self, swapped: bool = False) -> Facing:
        """Gaps at the lower body's nodes; at the upper one's when swapped."""
        sides = (self.above, self.below) if swapped else (self.below, self.above)
        return Facing.of(self.mesh.points[self.nodes], *sides)

    def wall(self, level: LevelSet = OPEN) -> ChestWall:
        """A wall that does not move."""
        count = len(self.nodes)
        return ChestWall(level, self.mesh.points[self.nodes], np.zeros(count, bool), np.eye(3)[2], np.zeros(count))

    def solve(
        self, body: Solid, free: Array, swapped: bool = False, level: LevelSet = OPEN
    ) -> tuple[ContactState, Array]:
        """Contact, and the displacement (n, 3) with it, for the one without, `free` (n, 3)."""
        state = solve_contact(
            compliance_of(body, self.nodes), self.wall(level), free[self.nodes], 0.0, facing=self.facing(swapped)
        )
        force = np.zeros_like(free)
        force[self.nodes] = state.nodal_force
        return state, free + body.solve(force)


def stacked(cells: tuple[tuple[int, int, int], ...], width: float, heights: tuple[float, float], turn: Array) -> Pair:
    """A box of some cells on top of another one, both of one width, mm, turned by `turn` (3, 3)."""
    first, second = (box(c, (width, width, h)) for c, h in zip(cells, heights, strict=True))
    raised = second.points + heights[0] * np.eye(3)[2]
    touching = np.concatenate([first.points[:, 2], raised[:, 2]]) == heights[0]
    return Pair.of(TetMesh(first.points @ turn.T, first.tets), TetMesh(raised @ turn.T, second.tets), touching)


@dataclass(frozen=True)
class Spheres:
    """Hertz's problem of two bodies of one tissue: radii, contact radius mm, and what Hertz says."""

    tissue: Tissue
    radii: tuple[float, float]
    contact: float

    @property
    def radius(self) -> float:
        """Of the equivalent sphere, mm."""
        return 1 / (1 / self.radii[0] + 1 / self.radii[1])

    @property
    def modulus(self) -> float:
        """Of both bodies together, kPa."""
        return self.tissue.young_kpa / (1 - self.tissue.poisson**2) / 2

    @property
    def approach(self) -> float:
        """Of points far from the contact, mm."""
        return self.contact**2 / self.radius

    @property
    def force(self) -> float:
        """kPa mm2."""
        return float(4 / 3 * self.modulus * np.sqrt(self.radius) * self.approach**1.5)

    @property
    def peak(self) -> float:
        """Pressure in the middle, kPa."""
        return 2 * self.modulus * self.contact / (np.pi * self.radius)

    def pair(self, cells: tuple[int, int], finest: tuple[float, float]) -> tuple[Pair, Array, Array]:
        """Both bodies about the contact, the upper one turned by 30 degrees so that no node meets another; their held
        nodes, and how these move (k, 3) mm.
        """
        turn = np.array([[np.cos(np.pi / 6), np.sin(np.pi / 6), 0], [np.sin(np.pi / 6), -np.cos(np.pi / 6), 0]])
        turn = np.concatenate([turn, [[0, 0, -1.0]]])
        bodies, held, motion, touching = [], [], [], []
        for number, frame in enumerate((np.eye(3), turn)):
            block = half_block(cells[number], finest[number], self.contact)
            x, far = block.points, 4 * self.contact * (1 - 1e-9)
            outer = (np.abs(x[:, :2]).max(axis=1) >= far) | (x[:, 2] <= -far)
            bowed = x - np.outer((x[:, :2] ** 2).sum(axis=1) / (2 * self.radii[number]), [0, 0, 1.0])
            moved = half_space(x[outer], self.contact, self.peak, self.tissue) + self.approach / 2 * np.eye(3)[2]
            bodies.append(TetMesh(bowed @ frame.T, block.tets))
            held.append(outer)
            motion.append(moved @ frame.T)
            touching.append((x[:, 2] == 0) & ~outer & (np.hypot(*x[:, :2].T) < 1.8 * self.contact))
        pair = Pair.of(*bodies, np.concatenate(touching))
        return pair, np.flatnonzero(np.concatenate(held)), np.concatenate(motion)

    def pressed(
        self, cells: tuple[int, int], finest: tuple[float, float], swapped: bool = False
    ) -> tuple[Pair, ContactState, Array]:
        """Both bodies pressed together."""
        pair, held, motion = self.pair(cells, finest)
        body = solid(pair.mesh, self.tissue, held)
        return pair, *pair.solve(body, body.solve(np.zeros_like(pair.mesh.points), motion), swapped)
